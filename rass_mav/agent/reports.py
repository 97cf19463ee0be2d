"""What the people at the ground are told of trouble, and how often."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.core.alarms import Alarm
from rass_mav.core.participant import Participant

#: The same trouble is told at most this often, seconds.
REPORT_S = 30.0
_CRITICAL = 2
_WARNING = 4

#: Tells the ground; MAV_SEVERITY and a text.
Tell = Callable[[int, str], None]


class Reports:
    """What was told, and when it may be told again."""

    __slots__ = ("_alarms_at", "_fault_at", "_full_at", "_refused", "_rivals_at", "_told")

    def __init__(self, now: float) -> None:
        self._rivals_at = self._alarms_at = self._full_at = self._fault_at = now
        self._told: dict[Alarm, int] = {}
        self._refused = 0

    def look(self, node: Participant, now: float, tell: Tell) -> None:
        """Once a step: is there anything that people should know?"""
        alarms = node.alarms
        if alarms.rivals and now >= self._rivals_at:
            self._rivals_at = now + REPORT_S
            recent = [life for life, at in alarms.rivals.items() if now - at <= REPORT_S]
            if recent:
                tell(
                    _CRITICAL,
                    f"RASS: another node with node id {node.id} on the air (life {recent[0]:08x}), change one",
                )
        if alarms.counts and now >= self._alarms_at:
            self._alarms_at = now + REPORT_S
            for alarm, count in alarms.counts.items():
                if count != self._told.get(alarm):
                    self._told[alarm] = count
                    tell(_CRITICAL, f"RASS: {alarm.value} ({alarms.about[alarm]})")

    def full(self, now: float, tell: Tell) -> None:
        """A measurement was refused for want of room."""
        self._refused += 1
        if now >= self._full_at:
            self._full_at = now + REPORT_S
            tell(_WARNING, f"RASS: store full, {self._refused} measurements refused so far")

    def fault(self, sender: str, now: float, tell: Tell) -> None:
        """A frame hit a fault."""
        if now >= self._fault_at:
            self._fault_at = now + REPORT_S
            tell(_CRITICAL, f"RASS: a frame from {sender} hit a fault in this program and was dropped; please report")
