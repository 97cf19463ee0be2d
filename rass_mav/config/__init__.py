"""Sections of settings, their bounds, and how they are read from YAML. Every package's settings use them."""
