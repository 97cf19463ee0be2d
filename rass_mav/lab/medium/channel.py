"""An air that takes time: its events in one queue, frames in flight and in the radios, and when a radio may send."""

from __future__ import annotations

import random
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from heapq import heappop, heappush
from typing import Any

from .air import Record, Tally
from .neighbours import Reach
from .settings import RadioSection

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


#: Called with the nodes that have heard a frame to its end, the sender, the frame, and two times in seconds: since when
#: it has waited, and now.
Hear = Callable[[Sequence[int], int, bytes, float, float], None]


class Datagram:
    """Frames that travel together."""

    __slots__ = ("at", "frames", "size")

    def __init__(self, at: float) -> None:
        self.at = at
        """When they were handed to the radio, seconds."""
        self.frames: list[tuple[bytes, float]] = []
        """And since when each has waited, seconds."""
        self.size = 0
        """Their bytes."""

    def add(self, frame: bytes, since: float) -> None:
        """Put a frame behind the others."""
        self.frames.append((frame, since))
        self.size += len(frame)


class Flight:
    """A datagram on the air."""

    __slots__ = ("datagram", "hearers", "lost", "noticed", "sender")

    def __init__(self, sender: int, datagram: Datagram, hearers: Sequence[int], noticed: Sequence[int]) -> None:
        self.sender = sender
        self.datagram = datagram
        self.hearers = hearers
        """The nodes in reach when it began."""
        self.noticed = noticed
        self.lost: set[int] = set()
        """Hearers at which it overlaps with another one."""


class Station:
    """The radio of a node."""

    __slots__ = ("busy", "busy_since", "heard", "sends", "waiting", "waiting_bytes")

    def __init__(self) -> None:
        self.waiting: deque[Datagram] = deque()
        self.waiting_bytes = 0
        self.sends: Flight | None = None
        """What it has on the air."""
        self.heard: list[Flight] = []
        """What is on the air and reaches it."""
        self.busy = 0
        """How much is on the air that it sends or notices."""
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
        waiting = station.waiting
        # As a link does: what is sent at once goes together.
        if not waiting or waiting[-1].at < now or waiting[-1].size + len(frame) > self.channel.datagram_bytes:
            waiting.append(Datagram(now))
        waiting[-1].add(frame, since)
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
        """Send the first datagram that waits."""
        stations, reach = self.stations, self.reach
        station = stations[sender]
        datagram = station.waiting.popleft()
        station.waiting_bytes -= datagram.size
        for frame, _ in datagram.frames:
            self.count(frame, int(now / self._step_s))
        flight = station.sends = Flight(sender, datagram, reach.hearers[sender], reach.noticed[sender])
        for other in station.heard:
            other.lost.add(sender)
        for hearer in flight.hearers:
            there = stations[hearer]
            if there.sends is not None:
                flight.lost.add(hearer)
            if there.heard:
                self._overlap(flight, there.heard, hearer)
            there.heard.append(flight)
        airtime = self.channel.airtime(datagram.size)
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
        hearers, frames = flight.hearers, flight.datagram.frames
        if lost:
            self.collided += len(lost) * len(frames)
            hearers = [hearer for hearer in hearers if hearer not in lost]
        if self._loss or self.reach.fades:
            reached = len(hearers)
            hearers = self._arrives(sender, hearers)
            self.dropped += (reached - len(hearers)) * len(frames)
        self.heard += len(hearers) * len(frames)
        for frame, since in frames:
            self._hear(hearers, sender, frame, since, now)

    def _arrives(self, sender: int, hearers: Sequence[int]) -> list[int]:
        rng, loss, fades = self._rng, self._loss, self.reach.fades
        heard = []
        for hearer in hearers:
            if not ((loss and rng.random() < loss) or (fades and rng.random() >= self.reach.chance(sender, hearer))):
                heard.append(hearer)
        return heard


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
    """Carrier sense: a radio counts its backoff slots `channel.gap_s` after the air has become free; when none is left,
    it sends. A datagram that comes when the air has been free for long is sent at once. After each one a radio draws a
    new backoff. For broadcast frames this is the distributed coordination function of IEEE 802.11-2020, 10.3.
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


#: Slots in a round unless another number is set: the most nodes of a SiK network.
MOST_SLOTS = 30


class Tdma(Medium):
    """Time slots: slot k of each round of `channel.slots` belongs to the radios whose number is k modulo `slots`,
    whatever these hear. A frame must end `channel.gap_s` before its slot does."""

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
        need_s = self.channel.airtime(self.stations[node].waiting[0].size) + self.channel.gap_s
        if not ahead:
            if now + need_s <= (slot + 1) * slot_s:
                return now
            ahead = self._slots
        return (slot + ahead) * slot_s

    def _ended(self, flight: Flight, now: float) -> None:
        if self.stations[flight.sender].waiting:
            self._wants(flight.sender, now)
