"""An air that takes time: frames in flight, what they do to each other, and what waits in the radios."""

from __future__ import annotations

import random
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence

from .reach import Reach
from .settings import RadioSection
from .tally import Record, Tally
from .timeline import Order, Timeline

#: Called with the nodes that have heard a frame to its end, the sender, the frame, and two times in seconds: since when
#: it has waited, and now.
Hear = Callable[[Sequence[int], int, bytes, float, float], None]


class Flight:
    """A frame on the air."""

    __slots__ = ("frame", "hearers", "lost", "noticed", "sender", "since")

    def __init__(self, sender: int, frame: bytes, since: float, hearers: Sequence[int], noticed: Sequence[int]) -> None:
        self.sender = sender
        self.frame = frame
        self.since = since
        """Since when it has waited, seconds."""
        self.hearers = hearers
        """The nodes in reach when it began."""
        self.noticed = noticed
        self.lost: set[int] = set()
        """Hearers at which it overlaps with another frame."""


class Station:
    """The radio of a node."""

    __slots__ = ("busy", "busy_since", "heard", "sends", "waiting", "waiting_bytes")

    def __init__(self) -> None:
        self.waiting: deque[tuple[bytes, float]] = deque()
        """Frames to send, and since when each has waited."""
        self.waiting_bytes = 0
        self.sends: Flight | None = None
        """Its own frame on the air."""
        self.heard: list[Flight] = []
        """Frames on the air that reach it."""
        self.busy = 0
        """Frames on the air that it sends or notices."""
        self.busy_since = 0.0
        """When the first of them began, seconds."""


class Medium(Tally):
    """The air, and all radios. A radio that sends hears nothing (half-duplex). Where two frames overlap at a hearer,
    both are lost, or the weaker one (`capture_db`)."""

    def __init__(
        self,
        settings: RadioSection,
        timeline: Timeline,
        reach: Reach,
        hear: Hear,
        *,
        stations: int,
        step_s: float,
        rng: random.Random,
        record: Record | None,
    ) -> None:
        """`stations`: nodes and attackers. `hear` is called at the end of each frame."""
        super().__init__(record)
        self.channel = settings.channel
        self.reach = reach
        self.collided = 0
        """Frames lost because they overlapped with another, or because the hearer was sending, one for each hearer."""
        self.heard = 0
        """Frames heard, one for each hearer."""
        self.overflow = 0
        """Frames dropped because too much waited in the radio."""
        self.busy_s = 0.0
        """Time for which a frame was on the air that a radio sent or noticed, summed over all radios, seconds."""
        self.stations = [Station() for _ in range(stations)]
        self._timeline = timeline
        self._hear = hear
        self._rng = rng
        self._loss = settings.loss
        self._capture_db = settings.capture_db
        self._step_s = step_s

    def send(self, sender: int, frame: bytes, since: float, now: float) -> None:
        """Hand a frame to a node's radio. `since`: from when on it has waited in the driver, seconds."""
        station = self.stations[sender]
        if station.waiting_bytes + len(frame) > self.channel.queue_bytes:
            self.overflow += 1
            return
        station.waiting.append((frame, since))
        station.waiting_bytes += len(frame)
        if station.sends is None:
            self._wants(sender, now)

    def switch_off(self, node: int) -> None:
        """A node goes off. What waits in its radio is gone, and a frame on the air breaks off."""
        station = self.stations[node]
        station.waiting.clear()
        station.waiting_bytes = 0
        if station.sends is not None:
            station.sends.lost.update(station.sends.hearers)

    def free_percent(self, node: int) -> int:
        """How much of a radio's buffer is free, 0..100 (RADIO_STATUS.txbuf)."""
        size = self.channel.queue_bytes
        return 100 * (size - self.stations[node].waiting_bytes) // size

    def figures(self, seconds: float) -> dict[str, float]:
        """For the summary, after so many seconds."""
        reached = self.heard + self.collided + self.dropped
        return {
            "collided": round(self.collided / reached, 6) if reached else 0.0,
            "overflow": self.overflow,
            "busy": round(self.busy_s / (len(self.stations) * seconds), 6) if seconds else 0.0,
        }

    # -- access to the air ---------------------------------------------------------------------------------------------

    @abstractmethod
    def _wants(self, node: int, now: float) -> None:
        """A radio that does not send has a frame."""

    def _begun(self, flight: Flight, now: float) -> None:
        """A frame begins."""

    def _ended(self, flight: Flight, now: float) -> None:
        """A frame has ended."""

    # -- frames on the air ---------------------------------------------------------------------------------------------

    def _begin(self, sender: int, now: float) -> None:
        """Send the first frame that waits."""
        stations, reach = self.stations, self.reach
        station = stations[sender]
        frame, since = station.waiting.popleft()
        station.waiting_bytes -= len(frame)
        self.count(frame, int(now / self._step_s))
        flight = station.sends = Flight(sender, frame, since, reach.hearers[sender], reach.noticed[sender])
        for other in station.heard:
            other.lost.add(sender)
        for hearer in flight.hearers:
            there = stations[hearer]
            if there.sends is not None:
                flight.lost.add(hearer)
            if there.heard:
                self._overlap(flight, there.heard, hearer)
            there.heard.append(flight)
        airtime = self.channel.airtime(len(frame))
        for node in (sender, *flight.noticed):
            there = stations[node]
            if not there.busy:
                there.busy_since = now
            there.busy += 1
        self._begun(flight, now)
        self._timeline.at(now + airtime, Order.AIR, lambda now: self._end(flight, now))

    def _overlap(self, flight: Flight, others: Sequence[Flight], hearer: int) -> None:
        capture_db = self._capture_db
        for other in others:
            ahead_db = 0.0
            if capture_db is not None:
                strength_db = self.reach.strength_db
                ahead_db = strength_db(flight.sender, hearer) - strength_db(other.sender, hearer)
            if capture_db is None or ahead_db < capture_db:
                flight.lost.add(hearer)
            if capture_db is None or -ahead_db < capture_db:
                other.lost.add(hearer)

    def _end(self, flight: Flight, now: float) -> None:
        stations, lost = self.stations, flight.lost
        sender = flight.sender
        stations[sender].sends = None
        for hearer in flight.hearers:
            stations[hearer].heard.remove(flight)
        for node in (sender, *flight.noticed):
            there = stations[node]
            there.busy -= 1
            if not there.busy:
                self.busy_s += now - there.busy_since
        self._ended(flight, now)
        hearers = flight.hearers
        if lost:
            self.collided += len(lost)
            hearers = [hearer for hearer in hearers if hearer not in lost]
        if self._loss or self.reach.fades:
            hearers = self._arrives(sender, hearers)
        self.heard += len(hearers)
        self._hear(hearers, sender, flight.frame, flight.since, now)

    def _arrives(self, sender: int, hearers: Sequence[int]) -> list[int]:
        rng, loss, fades = self._rng, self._loss, self.reach.fades
        heard = []
        for hearer in hearers:
            if (loss and rng.random() < loss) or (fades and rng.random() >= self.reach.chance(sender, hearer)):
                self.dropped += 1
            else:
                heard.append(hearer)
        return heard
