"""The autopilot's parameters: files of them, and the vehicle that is compared with a file or set from it."""
