"""The commands for what a mission has brought."""
