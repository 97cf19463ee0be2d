"""Protection against floods: requests pass at a bounded rate; if rare messages come too often, none is believed."""

from __future__ import annotations

from collections import deque


class Allowance:
    """Lets `count` requests through in `seconds` seconds. The others are refused and do not count."""

    __slots__ = ("_seconds", "_taken")

    def __init__(self, count: int, seconds: float) -> None:
        """`count`: 1 or more."""
        self._seconds = seconds
        self._taken: deque[float] = deque(maxlen=count)

    def would(self, now: float) -> bool:
        """Whether one more would pass now."""
        taken = self._taken
        return len(taken) != taken.maxlen or now - taken[0] >= self._seconds

    def due(self, now: float) -> float:
        """Seconds until one more would pass."""
        return 0.0 if self.would(now) else self._taken[0] + self._seconds - now

    def take(self, now: float) -> bool:
        """Let one more pass, if possible. Returns whether it did."""
        if not self.would(now):
            return False
        self._taken.append(now)
        return True


class Flood:
    """Notices when more messages come than can be genuine. Until that stops, none can be told from a forged one."""

    __slots__ = ("_heard", "_seconds", "active")

    def __init__(self, count: int, seconds: float) -> None:
        """More than `count` in `seconds` seconds are a flood."""
        self._seconds = seconds
        self._heard: deque[float] = deque(maxlen=count + 1)
        self.active = False
        """Whether the last message was part of a flood."""

    def hear(self, now: float) -> bool:
        """Count a message. Returns whether a flood starts with it."""
        heard, before = self._heard, self.active
        heard.append(now)
        self.active = len(heard) == heard.maxlen and now - heard[0] < self._seconds
        return self.active and not before
