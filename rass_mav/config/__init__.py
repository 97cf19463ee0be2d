"""Sections of settings, their bounds, and how they are read from YAML: what every room's settings are made of."""
