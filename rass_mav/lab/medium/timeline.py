"""The events of a run in virtual time, in one queue."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from heapq import heappop, heappush

#: Called with its time, seconds.
Event = Callable[[float], None]


class Order(IntEnum):
    """What comes first among events of the same time."""

    STRIKE = 0
    TURN = 1
    AIR = 2


class Timeline:
    """Events by time; those of the same time by their order, then in the order in which they were added."""

    def __init__(self) -> None:
        self._events: list[tuple[float, int, int, Event]] = []
        self._count = 0

    def at(self, time: float, order: Order, event: Event) -> None:
        """Let `event` happen at `time`, seconds; not before what is happening now."""
        self._count += 1
        heappush(self._events, (time, order, self._count, event))

    def run(self, until: float) -> None:
        """Let all events before `until` happen, and those that they add."""
        events = self._events
        while events and events[0][0] < until:
            time, _, _, event = heappop(events)
            event(time)
