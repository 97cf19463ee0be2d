"""The environment of processes that tests start."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]


def environment(**variables: str) -> dict[str, str]:
    """That of the tests, where this checkout is imported, with more variables."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **variables}
