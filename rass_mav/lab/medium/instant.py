"""The air that takes no time: all that is sent at one time arrives at that time, or whole steps later."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing

from .air import Air, Heard, Record, Tally
from .channel import Order, Timeline
from .settings import RadioSection

#: The most frames that overtake another; if fewer are in transit, it waits for the next step.
_OVERTAKEN_BY = 16

#: A frame, preceded by the nodes that hear it, each as often as it does.
Arrival = tuple[Sequence[int], bytes]


class Radio(Tally):
    """The air. Accepts frames, and determines in order which node hears what. Every frame is heard as bytes."""

    def __init__(self, settings: RadioSection, rng: random.Random, *, record: Record | None) -> None:
        """`record` is called with each frame put on the air and its step, in order."""
        super().__init__(record)
        self._loss = settings.loss
        self._duplicate = settings.duplicate
        self._reorder = settings.reorder
        self._latency = settings.latency_steps
        self._rng = rng
        self._now: deque[tuple[int, bytes, Sequence[int] | None]] = deque()
        self._later: deque[tuple[int, int, bytes, Sequence[int] | None]] = deque()
        self._plain = not (settings.loss or settings.duplicate or settings.reorder)

    def send(self, sender: int, frame: bytes, step: int) -> None:
        """Put a frame on the air at `step`."""
        self.count(frame, step)
        if self._latency:
            self._later.append((step + self._latency, sender, frame, None))
        else:
            self._now.append((sender, frame, None))

    def begin_step(self, step: int) -> None:
        """Move frames that are due at the beginning of this step to the front."""
        later = self._later
        while later and later[0][0] <= step:
            _, sender, frame, hearers = later.popleft()
            self._now.append((sender, frame, hearers))

    def arrivals(self, step: int, neighbours: Sequence[Sequence[int]]) -> Iterator[Arrival]:
        """Which node hears what now, until the air is quiet; frames that are sent meanwhile are heard too (latency 0).

        `neighbours`: for each node the ids in its range.
        """
        air = self._now
        if self._plain:
            while air:
                sender, frame, _ = air.popleft()
                yield neighbours[sender], frame
            return
        rng = self._rng
        while air:
            sender, frame, hearers = air.popleft()
            if hearers is None:
                if self._reorder and rng.random() < self._reorder:
                    # Overtaken: the hearers are those in range now.
                    self._delay(step, sender, frame, neighbours[sender])
                    continue
                hearers = neighbours[sender]
            heard = []
            for hearer in hearers:
                if self._loss and rng.random() < self._loss:
                    self.dropped += 1
                    continue
                heard.append(hearer)
                if self._duplicate and rng.random() < self._duplicate:
                    heard.append(hearer)
            yield heard, frame

    def _delay(self, step: int, sender: int, frame: bytes, hearers: Sequence[int]) -> None:
        places = self._rng.randrange(1, _OVERTAKEN_BY + 1)
        if places > len(self._now):
            self._later.append((step + 1, sender, frame, hearers))
        else:
            self._now.insert(places, (sender, frame, hearers))


class Instant(Air):
    """A `Radio` on the timeline."""

    def __init__(
        self,
        settings: RadioSection,
        timeline: Timeline,
        reach: Callable[[], Sequence[Sequence[int]]],
        heard: Heard,
        *,
        seed: int,
        record: Record | None,
    ) -> None:
        """`reach`: for each node, then for each attacker, the nodes in its range now."""
        self.tally = self._radio = Radio(settings, random.Random(f"{seed}:radio"), record=record)
        self.at_once = not settings.latency_steps
        self._delays = bool(settings.latency_steps or settings.reorder)
        self._timeline = timeline
        self._reach = reach
        self._heard = heard
        self._t = 0
        self._delivers_at = -1.0
        """For which time the delivery is planned, seconds."""

    def arrive(self, t: int, now: float) -> None:
        """Frames that take whole steps, and those that others have overtaken, arrive."""
        self._t = t
        if self._delays:
            self._radio.begin_step(t)
            self._deliver(now)

    def rearrange(self) -> None:
        """A frame is heard where nodes are when it arrives."""

    def send(self, node: int, outgoing: Outgoing, now: float) -> None:
        """There is no driver: the frame is on the air."""
        self.broadcast(node, outgoing.frame, now)

    def broadcast(self, sender: int, frame: bytes, now: float) -> None:
        """It arrives after all that happens at this time."""
        self._radio.send(sender, frame, self._t)
        if self.at_once and self._delivers_at < now:
            self._delivers_at = now
            self._timeline.at(now, Order.AIR, self._deliver)

    def _deliver(self, now: float) -> None:
        """Deliver until the air is quiet."""
        for hearers, frame in self._radio.arrivals(self._t, self._reach()):
            self._heard(hearers, frame, now)

    def start(self, node: int, agent: Agent, now: float) -> None:
        """There is no driver."""

    def stop(self, node: int) -> None:
        """What a node has sent still arrives."""

    def begin_turn(self, node: int, agent: Agent, now: float) -> None:
        """This air has no limit."""

    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """Nothing waits."""

    def figures(self, seconds: float) -> dict[str, float]:
        """There is nothing to say."""
        return {}
