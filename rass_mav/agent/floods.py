"""Too many of a kind: what is asked for is let through at a bounded rate, what should be rare is doubted as a whole."""

from __future__ import annotations

from collections import deque


class Allowance:
    """So many in so many seconds get through; the others do not, and do not count."""

    __slots__ = ("_seconds", "_taken")

    def __init__(self, count: int, seconds: float) -> None:
        """`count`: 1 or more."""
        self._seconds = seconds
        self._taken: deque[float] = deque(maxlen=count)

    def would(self, now: float) -> bool:
        """Whether one more would get through now."""
        taken = self._taken
        return len(taken) != taken.maxlen or now - taken[0] >= self._seconds

    def take(self, now: float) -> bool:
        """Whether one more gets through now."""
        if not self.would(now):
            return False
        self._taken.append(now)
        return True


class Flood:
    """Notices when more come than can be right. Then none can be told from a forged one, until it is quiet again."""

    __slots__ = ("_heard", "_seconds", "active")

    def __init__(self, count: int, seconds: float) -> None:
        """More than `count` in so many seconds are a flood."""
        self._seconds = seconds
        self._heard: deque[float] = deque(maxlen=count + 1)
        self.active = False
        """Whether the last one came in a flood."""

    def hear(self, now: float) -> bool:
        """One has come. Returns whether a flood begins with it."""
        heard, before = self._heard, self.active
        heard.append(now)
        self.active = len(heard) == heard.maxlen and now - heard[0] < self._seconds
        return self.active and not before
