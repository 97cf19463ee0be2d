"""Carrier sense: a radio sends when it has noticed no other for a while, and for a random time more.

For broadcast frames this is the distributed coordination function of IEEE 802.11-2020, 10.3.
"""

from __future__ import annotations

from typing import Any

from .base import Flight, Medium
from .timeline import Order

#: Two radios whose waits end within this part of a slot do not notice each other in time.
_BLIND = 0.5


class _Ear:
    """What a radio notices, and its wait."""

    __slots__ = ("attempt", "busy", "free_at", "slots", "ticket")

    def __init__(self) -> None:
        self.busy = 0
        """Other radios that send now."""
        self.free_at = -1.0
        """When the air became free, seconds."""
        self.slots = 0
        """Slots of the backoff that are left."""
        self.attempt: float | None = None
        """When it will send, seconds."""
        self.ticket = 0
        """Number of its last attempt: earlier ones are cancelled."""


class Csma(Medium):
    """`channel.gap_s` after the air has become free, a radio counts its backoff slots; when none is left, it sends. A
    frame that comes when the air has been free for long is sent at once. After each frame a radio draws a new backoff.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As for a `Medium`."""
        super().__init__(*arguments, **options)
        self._ears = [_Ear() for _ in self.stations]

    def _wants(self, node: int, now: float) -> None:
        ear = self._ears[node]
        if ear.attempt is not None:
            return
        channel = self.channel
        if not ear.slots and (ear.busy or now < ear.free_at + channel.gap_s):
            ear.slots = self._rng.randint(0, channel.window)
        if not ear.busy:
            self._try_at(node, max(now, ear.free_at + channel.gap_s + ear.slots * channel.slot_s))

    def _try_at(self, node: int, time: float) -> None:
        ear = self._ears[node]
        ear.attempt = time
        ear.ticket += 1
        ticket = ear.ticket

        def attempt(now: float) -> None:
            if ear.ticket == ticket and ear.attempt is not None:
                ear.attempt = None
                ear.slots = 0
                if self.stations[node].waiting:
                    self._begin(node, now)

        self._timeline.at(time, Order.AIR, attempt)

    def _begun(self, flight: Flight, now: float) -> None:
        channel = self.channel
        for node in flight.noticed:
            ear = self._ears[node]
            ear.busy += 1
            if ear.busy > 1:
                continue
            if ear.slots:
                counted = int((now - ear.free_at - channel.gap_s) / channel.slot_s + 1e-6)
                if counted > 0:
                    ear.slots = max(0, ear.slots - counted)
            if ear.attempt is not None and ear.attempt - now > _BLIND * channel.slot_s:
                ear.attempt = None
                ear.ticket += 1
                # It has waited for the air, so it draws a backoff if it has none.
                ear.slots = ear.slots or self._rng.randint(0, channel.window)

    def _ended(self, flight: Flight, now: float) -> None:
        own = self._ears[flight.sender]
        own.slots = self._rng.randint(0, self.channel.window)
        own.free_at = now
        for node in flight.noticed:
            ear = self._ears[node]
            ear.busy -= 1
            if not ear.busy:
                ear.free_at = now
                station = self.stations[node]
                if station.waiting and station.sends is None:
                    self._wants(node, now)
        if self.stations[flight.sender].waiting:
            self._wants(flight.sender, now)
