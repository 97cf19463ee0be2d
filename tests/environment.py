"""The environment of processes that tests start."""

from __future__ import annotations

import os


def unmeasured(**variables: str) -> dict[str, str]:
    """For a process whose coverage is not measured: that takes long, and others reach the same."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COV")} | variables
