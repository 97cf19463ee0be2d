"""In which steps a node has its turn, where its links cannot carry a beacon in each step."""

from __future__ import annotations

import random

#: The most by which a turn comes later than due, in steps.
MOST_JITTER = 0.25


def jitter(rng: random.Random) -> float:
    """By how much a turn comes later, in steps. The beacons of two nodes that do not hear each other would otherwise
    collide at a third every time (RFC 5148)."""
    return MOST_JITTER * rng.random()


class Turns:
    """Turns of whole steps. Time is an argument."""

    __slots__ = ("_next_at", "_turn_s")

    def __init__(self, turn_s: float, now: float) -> None:
        self._turn_s = turn_s
        self._next_at = now

    def due(self, turn_s: float, step_s: float, now: float, rng: random.Random) -> bool:
        """Whether this step has a turn, with a turn every `turn_s` seconds. If so, the wait for the next one begins.

        After a change of `turn_s` the first wait is random: nodes that were switched on together, or have met, must not
        all send in the same second.
        """
        if turn_s > step_s and now < self._next_at - 0.5 * step_s:
            return False
        changed, self._turn_s = turn_s != self._turn_s, turn_s
        wait_s = turn_s if turn_s <= step_s or not changed else step_s * rng.randint(1, round(turn_s / step_s))
        self._next_at = now + wait_s
        return True
