"""Time slots: each radio sends only in its own slots of a round, whatever it hears."""

from __future__ import annotations

from typing import Any

from .base import Flight, Medium
from .timeline import Order

#: Slots in a round unless another number is set: the most nodes of a SiK network.
MOST_SLOTS = 30


class Tdma(Medium):
    """Slot k of each round of `channel.slots` belongs to the radios whose number is k modulo `slots`. A frame must end
    `channel.gap_s` before its slot does."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As for a `Medium`."""
        super().__init__(*arguments, **options)
        self._slots = self.channel.slots or min(len(self.stations), MOST_SLOTS)
        self._planned = [False] * len(self.stations)
        """Whether the beginning of a frame is planned, for each radio."""

    def _wants(self, node: int, now: float) -> None:
        if self._planned[node]:
            return
        self._planned[node] = True

        def turn(now: float) -> None:
            self._planned[node] = False
            if self.stations[node].waiting:
                self._begin(node, now)

        self._timeline.at(self._opening(node, now), Order.AIR, turn)

    def _opening(self, node: int, now: float) -> float:
        """When a radio may begin its next frame, seconds."""
        slot_s = self.channel.slot_s
        slot = int(now / slot_s)
        ahead = (node - slot) % self._slots
        need_s = self.channel.airtime(len(self.stations[node].waiting[0][0])) + self.channel.gap_s
        if not ahead:
            if now + need_s <= (slot + 1) * slot_s:
                return now
            ahead = self._slots
        return (slot + ahead) * slot_s

    def _ended(self, flight: Flight, now: float) -> None:
        if self.stations[flight.sender].waiting:
            self._wants(flight.sender, now)
