"""Texts for people at the ground: few enough to be read."""

from __future__ import annotations

import logging
import math
from collections import deque
from typing import NamedTuple

log = logging.getLogger(__name__)

#: So many texts may follow each other at once.
BURST = 5
#: After that one in so many seconds.
EVERY_S = 5.0
#: The same text is not said again for so long, seconds.
REPEAT_S = 30.0
#: Texts that may wait; beyond it the least important one is dropped.
MAX_WAITING = 16


class Text(NamedTuple):
    """A text with its importance."""

    severity: int
    """MAV_SEVERITY: 0 (emergency) .. 7 (debug)."""
    text: str


class Texts:
    """Takes texts at any time and gives them out at a rate that a person can follow, the most important first."""

    __slots__ = ("_rested_at", "_said", "_waiting", "dropped")

    def __init__(self) -> None:
        self._waiting: deque[Text] = deque()
        self._said: dict[Text, float] = {}
        self._rested_at = -math.inf
        """When a whole burst may be said again. A time, not an allowance that grows: what is due at a time must be
        there at that time, however sums are rounded."""
        self.dropped = 0
        """Texts that were not said: too many, or said just before."""

    def add(self, severity: int, text: str) -> None:
        """Say a text when its turn comes; `severity` as MAV_SEVERITY."""
        new = Text(severity, text)
        if new in self._waiting:
            self.dropped += 1
            return
        self._waiting.append(new)
        if len(self._waiting) > MAX_WAITING:
            # Of the least important ones the newest goes: the first words about a failure say most.
            worst = max(text.severity for text in self._waiting)
            newest = max(index for index, text in enumerate(self._waiting) if text.severity == worst)
            del self._waiting[newest]
            self.dropped += 1

    def take(self, now: float) -> Text | None:
        """The text whose turn it is now, if any."""
        self._said = {text: at for text, at in self._said.items() if now - at < REPEAT_S}
        while now >= self.due():
            text = min(self._waiting, key=lambda waiting: waiting.severity)
            self._waiting.remove(text)
            if text in self._said:
                self.dropped += 1
                continue
            self._said[text] = now
            self._rested_at = max(self._rested_at, now) + EVERY_S
            return text
        return None

    def due(self) -> float:
        """When the next text may be said; infinity: there is none."""
        return self._rested_at - (BURST - 1) * EVERY_S if self._waiting else math.inf
