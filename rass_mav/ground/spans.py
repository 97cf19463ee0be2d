"""Lengths of time for people."""

from __future__ import annotations


def span(seconds: float) -> str:
    """So many seconds in words: `45 s`, `32 min`, `14 h`, `3 d`."""
    for size, unit in ((86_400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
