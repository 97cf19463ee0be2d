"""When the next heartbeat is due, to the autopilot and to the ground (https://mavlink.io/en/services/heartbeat.html)."""

from __future__ import annotations

import math

#: Seconds between two heartbeats.
HEARTBEAT_S = 1.0
#: Size of a heartbeat on the air, bytes.
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
