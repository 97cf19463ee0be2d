"""The autopilot's parameters: reads parameter files, compares them with a vehicle, and writes them to it."""
