"""The timeline of a running node."""

from __future__ import annotations

import time
from collections.abc import Callable


class Clock:
    """Wall time at the start plus monotonic time since: readable as a date, and it never jumps while we run."""

    def __init__(self, wall: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic) -> None:
        """`wall`: seconds since 1970; `monotonic`: seconds since whenever."""
        self._monotonic = monotonic
        self._offset = wall() - monotonic()

    def now(self) -> float:
        """Seconds since 1970, as known at the start."""
        return self._offset + self._monotonic()
