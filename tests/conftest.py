"""What holds for all tests."""

from __future__ import annotations

from hypothesis import settings

# How long an example takes says something about the machine and its load, not about the code.
settings.register_profile("rass", deadline=None)
settings.load_profile("rass")
