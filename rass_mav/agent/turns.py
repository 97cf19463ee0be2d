"""When a node has its turn, where its links cannot carry a beacon in each step; and when its next heartbeat is due, to
the autopilot and to the ground (https://mavlink.io/en/services/heartbeat.html)."""

from __future__ import annotations

import math
import random

#: Fact: Seconds between two heartbeats.
HEARTBEAT_S = 1.0
#: Fact: Size of a heartbeat on the air, bytes.
HEARTBEAT_BYTES = 21


class Heartbeats:
    """Once a second; less often to an autopilot that forwards them over a slow radio. Time is an argument."""

    __slots__ = ("_left", "every", "next_at")

    def __init__(self, now: float) -> None:
        self.next_at = now
        """When the next second begins."""
        self.every = 1
        """Seconds between two heartbeats to the autopilot."""
        self._left = 0

    def pace(self, rate: float) -> None:
        """Let heartbeats to the autopilot take at most `rate` bytes/s."""
        self.every = max(1, math.ceil(HEARTBEAT_BYTES / (rate * HEARTBEAT_S)))

    def soon(self, now: float) -> None:
        """Make a heartbeat due now, to the autopilot and to the ground."""
        self.next_at = now
        self._left = 0

    def due(self, now: float) -> bool:
        """Whether a second has passed. If so, the next one begins."""
        if now < self.next_at:
            return False
        self.next_at = max(self.next_at + HEARTBEAT_S, now)
        self._left -= 1
        return True

    def due_to_vehicle(self) -> bool:
        """Whether the autopilot gets a heartbeat in the second that has just begun."""
        return self._left <= 0

    def greeted(self) -> None:
        """A heartbeat was sent to the autopilot."""
        self._left = self.every


# Tuned: python -m tools.sensitivity agent.turns
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
