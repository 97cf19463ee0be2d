"""When the next heartbeat is due, to the autopilot and to the ground (https://mavlink.io/en/services/heartbeat.html)."""

from __future__ import annotations

import math

#: A heartbeat every so many seconds.
HEARTBEAT_S = 1.0
#: A heartbeat on the air, bytes.
HEARTBEAT_BYTES = 21


class Heartbeats:
    """Once a second; rarer to an autopilot that passes them on over a slow radio. Time is an argument."""

    __slots__ = ("_left", "every", "next_at")

    def __init__(self, now: float) -> None:
        self.next_at = now
        """When the next second begins."""
        self.every = 1
        """The autopilot gets one in so many seconds."""
        self._left = 0

    def pace(self, rate: float) -> None:
        """Those to the autopilot may take `rate` bytes/s."""
        self.every = max(1, math.ceil(HEARTBEAT_BYTES / (rate * HEARTBEAT_S)))

    def soon(self, now: float) -> None:
        """Let one be due now, both ways."""
        self.next_at = now
        self._left = 0

    def due(self, now: float) -> bool:
        """Whether a second has passed; then the next one begins."""
        if now < self.next_at:
            return False
        self.next_at = max(self.next_at + HEARTBEAT_S, now)
        self._left -= 1
        return True

    def due_to_vehicle(self) -> bool:
        """In such a second: whether the autopilot gets one."""
        return self._left <= 0

    def greeted(self) -> None:
        """The autopilot got one."""
        self._left = self.every
