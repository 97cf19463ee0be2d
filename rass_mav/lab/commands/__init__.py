"""The commands that simulate and compare swarms."""
