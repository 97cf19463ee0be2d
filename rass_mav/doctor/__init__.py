"""`rass-mav doctor`: is everything there that a node needs? One small function for each check (docs/doctor.md)."""
