"""Texts for people at the ground station, few enough to read."""

from __future__ import annotations

import logging
import math
from collections import deque
from typing import NamedTuple

log = logging.getLogger(__name__)

#: How many texts may leave at once.
BURST = 5
#: Seconds between two texts after such a burst.
EVERY_S = 5.0
#: Seconds before the same text may be sent again.
REPEAT_S = 30.0
#: Texts that may wait. When there are more, the least important one is dropped.
MAX_WAITING = 16


class Text(NamedTuple):
    """A text and its importance."""

    severity: int
    """MAV_SEVERITY: 0 (emergency) .. 7 (debug)."""
    text: str


class Texts:
    """Takes texts at any time, and returns them at a rate that a person can follow, the most important first."""

    __slots__ = ("_last", "_rested_at", "_waiting", "dropped")

    def __init__(self) -> None:
        self._waiting: deque[Text] = deque()
        self._last: dict[Text, float] = {}
        self._rested_at = -math.inf
        """When a whole burst may be sent again. A time, not a growing allowance: a text must be ready at the time that
        `due` returned, however sums are rounded."""
        self.dropped = 0
        """Texts that were not sent: too many, or a repeat."""

    def add(self, severity: int, text: str) -> None:
        """Queue a text; `severity` as MAV_SEVERITY."""
        new = Text(severity, text)
        if new in self._waiting:
            self.dropped += 1
            return
        self._waiting.append(new)
        if len(self._waiting) > MAX_WAITING:
            # Drop the newest of the least important ones: the first text about a failure says most.
            worst = max(text.severity for text in self._waiting)
            newest = max(index for index, text in enumerate(self._waiting) if text.severity == worst)
            del self._waiting[newest]
            self.dropped += 1

    def take(self, now: float) -> Text | None:
        """The text to send now, if any."""
        self._last = {text: at for text, at in self._last.items() if now - at < REPEAT_S}
        while now >= self.due():
            text = min(self._waiting, key=lambda waiting: waiting.severity)
            self._waiting.remove(text)
            if text in self._last:
                self.dropped += 1
                continue
            self._last[text] = now
            self._rested_at = max(self._rested_at, now) + EVERY_S
            return text
        return None

    def due(self) -> float:
        """When the next text may be sent; infinity: none waits."""
        return self._rested_at - (BURST - 1) * EVERY_S if self._waiting else math.inf
