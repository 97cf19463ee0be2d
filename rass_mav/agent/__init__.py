"""One complete node without input and output: bytes from the autopilot and the neighbours in, frames out."""
