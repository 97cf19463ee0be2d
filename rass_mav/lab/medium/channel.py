"""An air that takes time: its events in one queue, frames in flight and in the radios, and when a radio may send."""

from __future__ import annotations

import math
import random
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from heapq import heappop, heappush
from typing import Any

from rass_mav.core.messages import BROADCAST

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

    __slots__ = ("at", "frames", "heard", "missed", "size", "target", "tries")

    def __init__(self, at: float, target: int) -> None:
        self.at = at
        """When they were handed to the radio, seconds."""
        self.target = target
        """The node that acknowledges them; BROADCAST: none does."""
        self.tries = 0
        """How often that node has not acknowledged them."""
        self.heard: set[int] = set()
        """Nodes that have heard them: these do not hear them again (duplicate detection, IEEE 802.11-2020, 10.3.2)."""
        self.missed: dict[int, bool] = {}
        """Nodes that have missed them once or more, and whether they collided there the last time."""
        self.frames: list[tuple[bytes, float]] = []
        """And since when each has waited, seconds."""
        self.size = 0
        """Their bytes."""

    def add(self, frame: bytes, since: float) -> None:
        """Put a frame behind the others."""
        self.frames.append((frame, since))
        self.size += len(frame)


class Flight:
    """A datagram on the air, or the acknowledgement of one."""

    __slots__ = ("acknowledges", "began", "datagram", "hearers", "lost", "need_db", "noticed", "only", "sender")

    def __init__(
        self, sender: int, datagram: Datagram, reach: Reach, now: float, *, only: int | None, acknowledges: bool = False
    ) -> None:
        self.sender = sender
        self.datagram = datagram
        self.acknowledges = acknowledges
        self.hearers: Sequence[int] = reach.hearers[sender]
        """The nodes in reach when it began."""
        self.noticed: Sequence[int] = reach.noticed[sender]
        self.only = only
        """The only one of the hearers that takes it in; None: all do."""
        self.began = now
        """Seconds."""
        self.need_db = 0.0
        """How much stronger it must arrive than at the usual bitrate."""
        self.lost: set[int] = set()
        """Hearers at which it overlaps with another one."""


class Station:
    """The radio of a node."""

    __slots__ = ("awaits", "busy", "busy_since", "heard", "off", "sends", "serves", "waiting", "waiting_bytes")

    def __init__(self) -> None:
        self.waiting: deque[Datagram] = deque()
        self.waiting_bytes = 0
        self.serves: Datagram | None = None
        """What it sends, or will send again."""
        self.awaits = False
        """Whether an acknowledgement is due."""
        self.sends: Flight | None = None
        """What it has on the air."""
        self.heard: list[Flight] = []
        """What is on the air and reaches it."""
        self.busy = 0
        """How much is on the air that it sends or notices."""
        self.busy_since = 0.0
        """When the first of them began, seconds."""
        self.off = False

    @property
    def ready(self) -> bool:
        """Whether it has something to send and may try to."""
        return self.sends is None and not self.awaits and (bool(self.waiting) or self.serves is not None)


class Medium(Tally):
    """The air, and all radios. A radio that sends hears nothing (half-duplex). Where two frames overlap at a hearer,
    both are lost, or only the later one (`capture`)."""

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
        self._overhear = settings.overhear
        # Not a whole one: two frames that are a slot apart may differ by less because of rounding.
        self._capture_s = 0.999 * self.channel.slot_s if self.channel.capture == "first" else math.inf
        self._step_s = step_s

    def send(self, sender: int, frame: bytes, since: float, now: float, target: int = BROADCAST) -> None:
        """Hand a frame to a node's radio. `since`: from when on it has waited in the driver, seconds. `target`: the
        node that it is for."""
        station = self.stations[sender]
        if station.waiting_bytes + len(frame) > self.channel.queue_bytes:
            self.overflow += 1
            return
        if self.channel.mac == "broadcast" or target >= len(self.stations):
            target = BROADCAST
        self._open(station, target, len(frame), now).add(frame, since)
        station.waiting_bytes += len(frame)
        if station.sends is None:
            self._wants(sender, now)

    def _open(self, station: Station, target: int, size: int, now: float) -> Datagram:
        """The datagram that takes so many bytes more: as on a link, what is sent at once to the same node goes
        together."""
        for datagram in reversed(station.waiting):
            if datagram.at < now:
                break
            if datagram.target == target:
                if datagram.size + size <= self.channel.datagram_bytes:
                    return datagram
                break
        datagram = Datagram(now, target)
        station.waiting.append(datagram)
        return datagram

    def switch_off(self, node: int) -> None:
        """A node goes off. What waits in its radio is gone, and a frame on the air breaks off."""
        station = self.stations[node]
        station.off = True
        station.waiting.clear()
        station.waiting_bytes = 0
        if station.sends is not None:
            station.sends.lost.update(station.sends.hearers)
        if station.serves is not None and (station.sends is None or station.sends.acknowledges):
            self._settle(station.serves)
        station.serves = None
        station.awaits = False

    def switch_on(self, node: int) -> None:
        """A node goes on."""
        self.stations[node].off = False

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
        """Send the first datagram that waits, or again the one that has not been acknowledged."""
        station = self.stations[sender]
        datagram = station.serves
        if datagram is None:
            datagram = station.serves = station.waiting.popleft()
            station.waiting_bytes -= datagram.size
            for frame, _ in datagram.frames:
                self.count(frame, int(now / self._step_s))
        only = None if self._overhear or datagram.target == BROADCAST else datagram.target
        flight = Flight(sender, datagram, self.reach, now, only=only)
        bitrate = None
        if self.reach.fades and datagram.target != BROADCAST and self.channel.rates:
            bitrate, flight.need_db = self._best_rate(sender, datagram.target)
        self._fly(flight, self.channel.airtime(datagram.size, bitrate), now)

    def _best_rate(self, sender: int, target: int) -> tuple[float, float]:
        """The rate of a link: the one that carries most, as the rate control of a driver finds it."""
        return max(self.channel.rates, key=lambda rate: rate[0] * self.reach.chance(sender, target, rate[1]))

    def _fly(self, flight: Flight, airtime_s: float, now: float) -> None:
        stations, sender = self.stations, flight.sender
        station = stations[sender]
        station.sends = flight
        for other in station.heard:
            other.lost.add(sender)
        for hearer in flight.hearers:
            there = stations[hearer]
            if there.sends is not None:
                flight.lost.add(hearer)
            if there.heard:
                flight.lost.add(hearer)
                for other in there.heard:
                    if now - other.began < self._capture_s:
                        other.lost.add(hearer)
            there.heard.append(flight)
        for node in (sender, *flight.noticed):
            there = stations[node]
            if not there.busy:
                there.busy_since = now
            there.busy += 1
        self._begun(flight, now)
        self._timeline.at(now + airtime_s, Order.AIR, lambda now: self._end(flight, now))

    def _end(self, flight: Flight, now: float) -> None:
        stations, lost = self.stations, flight.lost
        sender = flight.sender
        station = stations[sender]
        station.sends = None
        if flight.datagram.target == BROADCAST:
            station.serves = None
        for hearer in flight.hearers:
            stations[hearer].heard.remove(flight)
        for node in (sender, *flight.noticed):
            there = stations[node]
            there.busy -= 1
            if not there.busy:
                self.busy_s += now - there.busy_since
        self._ended(flight, now)
        hearers = flight.hearers
        if flight.only is not None:
            hearers = [flight.only] if flight.only in hearers else []
        received = [hearer for hearer in hearers if hearer not in lost] if lost else hearers
        if self._loss or self.reach.fades:
            received = self._arrives(flight, received)
        self._landed(flight, hearers, received, now)

    def _landed(self, flight: Flight, hearers: Sequence[int], received: Sequence[int], now: float) -> None:
        """A frame that was for all these hearers has been received by some of them."""
        frames = flight.datagram.frames
        self.collided += len(flight.lost) * len(frames)
        self.dropped += (len(hearers) - len(flight.lost) - len(received)) * len(frames)
        self._hand_up(flight, received, now)

    def _hand_up(self, flight: Flight, received: Sequence[int], now: float) -> None:
        frames = flight.datagram.frames
        self.heard += len(received) * len(frames)
        for frame, since in frames:
            self._hear(received, flight.sender, frame, since, now)

    def _settle(self, datagram: Datagram) -> None:
        """A datagram is not sent again: count who has never heard it."""
        for node, collided in datagram.missed.items():
            if node not in datagram.heard:
                if collided:
                    self.collided += len(datagram.frames)
                else:
                    self.dropped += len(datagram.frames)

    def _arrives(self, flight: Flight, hearers: Sequence[int]) -> list[int]:
        rng, loss, reach = self._rng, self._loss, self.reach
        heard = []
        for hearer in hearers:
            if loss and rng.random() < loss:
                continue
            if reach.fades and rng.random() >= reach.chance(flight.sender, hearer, flight.need_db):
                continue
            heard.append(hearer)
        return heard


#: Two radios whose waits end within this part of a slot do not notice each other in time.
_BLIND = 0.5

#: The largest window (IEEE 802.11-2020, Tables 15-5 and 17-21), slots.
_MOST_WINDOW = 1023
#: How often a datagram is sent if nobody acknowledges it: once, and seven times more.
_TRIES = 8


class _Ear:
    """What a radio notices, and its wait."""

    __slots__ = ("attempt", "busy", "free_at", "slots", "ticket")

    def __init__(self) -> None:
        self.busy = 0
        """Other radios that send now."""
        self.free_at = -1.0
        """When the air became free, seconds."""
        self.slots: int | None = None
        """Slots of the backoff that are left; None: there is none."""
        self.attempt: float | None = None
        """When it will send, seconds."""
        self.ticket = 0
        """Number of its last attempt: earlier ones are cancelled."""


class Csma(Medium):
    """Carrier sense: a radio counts its backoff slots `channel.gap_s` after the air has become free; when none is left,
    it sends. A datagram that comes when the air has been free for long is sent at once. After each one a radio draws a
    new backoff. This is the distributed coordination function of IEEE 802.11-2020, 10.3, without RTS and CTS.

    A datagram with a target is acknowledged after SIFS, whatever the target notices then. Without an acknowledgement
    it is sent again; each time the window doubles (10.3.3). Those that notice it leave the air to the acknowledgement:
    the frame announces it (NAV), and who could not read the frame waits as long (EIFS, 10.3.2).
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As for a `Medium`."""
        super().__init__(*arguments, **options)
        self._ears = [_Ear() for _ in self.stations]
        self._timeout_s = self.channel.sifs_s + self.channel.slot_s + self.channel.overhead_s
        """How long the beginning of an acknowledgement is waited for (ACKTimeout, 10.3.2), seconds."""
        self.repeats = 0
        """How often datagrams were sent again."""
        self.given_up = 0
        """Datagrams that were never acknowledged."""

    def figures(self, seconds: float) -> dict[str, float]:
        """For the summary, after so many seconds."""
        figures = super().figures(seconds)
        if self.channel.mac == "unicast":
            figures |= {"repeats": self.repeats, "given_up": self.given_up}
        return figures

    def _wants(self, node: int, now: float) -> None:
        ear = self._ears[node]
        if ear.attempt is not None or not self.stations[node].ready:
            return
        channel = self.channel
        if ear.slots is None and (ear.busy or now < ear.free_at + channel.gap_s):
            ear.slots = self._draw(node)
        if not ear.busy:
            self._try_at(node, max(now, ear.free_at + channel.gap_s + (ear.slots or 0) * channel.slot_s))

    def _draw(self, node: int) -> int:
        """A backoff, slots."""
        window, serves = self.channel.window, self.stations[node].serves
        if serves is not None and serves.tries:
            window = max(window, min(((window + 1) << serves.tries) - 1, _MOST_WINDOW))
        return self._rng.randint(0, window)

    def _try_at(self, node: int, time: float) -> None:
        ear = self._ears[node]
        ear.attempt = time
        ear.ticket += 1
        ticket = ear.ticket

        def attempt(now: float) -> None:
            if ear.ticket == ticket and ear.attempt is not None:
                ear.attempt = ear.slots = None
                if self.stations[node].ready:
                    self._begin(node, now)

        self._timeline.at(time, Order.AIR, attempt)

    def _begun(self, flight: Flight, now: float) -> None:
        channel = self.channel
        for node in flight.noticed:
            ear = self._ears[node]
            ear.busy += 1
            if ear.busy > 1:
                continue
            if ear.slots is not None:
                counted = math.floor((now - ear.free_at - channel.gap_s) / channel.slot_s + 1e-6)
                if counted >= ear.slots and ear.attempt is None:
                    ear.slots = None  # It was over before there was something to send.
                elif counted > 0:
                    ear.slots = max(0, ear.slots - counted)
            if ear.attempt is not None and ear.attempt - now > _BLIND * channel.slot_s:
                ear.attempt = None
                ear.ticket += 1

    def _ended(self, flight: Flight, now: float) -> None:
        own, station = self._ears[flight.sender], self.stations[flight.sender]
        own.free_at = now
        reserved_s = 0.0
        if not flight.acknowledges:
            if flight.datagram.target == BROADCAST:
                own.slots = self._draw(flight.sender)
            else:
                reserved_s = self.channel.answer_s
                station.awaits = station.serves is flight.datagram
        for node in flight.noticed:
            ear = self._ears[node]
            ear.busy -= 1
            if reserved_s or not ear.busy:
                ear.free_at = max(ear.free_at, now + reserved_s)
            if not ear.busy:
                self._wants(node, now)
        self._wants(flight.sender, now)

    def _landed(self, flight: Flight, hearers: Sequence[int], received: Sequence[int], now: float) -> None:
        sender, datagram = flight.sender, flight.datagram
        if flight.acknowledges:
            assert flight.only is not None
            self._judge(flight.only, datagram, flight.only in received, now)
            return
        if datagram.target == BROADCAST:
            super()._landed(flight, hearers, received, now)
            return
        arrived = set(received)
        datagram.missed.update((node, node in flight.lost) for node in hearers if node not in arrived)
        new = [node for node in received if node not in datagram.heard]
        datagram.heard.update(new)
        if self.stations[sender].serves is not datagram:
            self._settle(datagram)
        elif datagram.target in arrived:
            self._timeline.at(
                now + self.channel.sifs_s, Order.AIR, lambda now: self._acknowledge(sender, datagram, now)
            )
        else:
            self._timeline.at(now + self._timeout_s, Order.AIR, lambda now: self._judge(sender, datagram, False, now))
        self._hand_up(flight, new, now)

    def _acknowledge(self, sender: int, datagram: Datagram, now: float) -> None:
        station = self.stations[datagram.target]
        if station.off or station.sends is not None:
            rest_s = self._timeout_s - self.channel.sifs_s
            self._timeline.at(now + rest_s, Order.AIR, lambda now: self._judge(sender, datagram, False, now))
            return
        flight = Flight(datagram.target, datagram, self.reach, now, only=sender, acknowledges=True)
        self._fly(flight, self.channel.ack_s, now)

    def _judge(self, node: int, datagram: Datagram, acknowledged: bool, now: float) -> None:
        """It is known whether a datagram has been acknowledged."""
        station, ear = self.stations[node], self._ears[node]
        if station.serves is not datagram:
            return  # It was switched off.
        station.awaits = False
        if not acknowledged:
            datagram.tries += 1
        if acknowledged or datagram.tries == _TRIES:
            station.serves = None
            self.given_up += not acknowledged
            self._settle(datagram)
        else:
            self.repeats += 1
        ear.slots = self._draw(node)
        ear.free_at = max(ear.free_at, now)
        self._wants(node, now)


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
        if self.stations[flight.sender].ready:
            self._wants(flight.sender, now)
