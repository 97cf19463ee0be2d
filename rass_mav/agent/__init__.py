"""One whole node without input and output: autopilot bytes and neighbours' bytes in, frames out."""
