"""A half-duplex radio that all nodes share, in virtual time: 57,600 bit/s, and the vehicles' telemetry on it too.

What it does not simulate: collisions, losses, the time slots of real radios. Who has waited longest speaks next, one
frame at a time, and everybody hears it when it has ended. So whatever is sent too much shows as waiting time.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.app.duplicates import Duplicates
from rass_mav.app.linkqueue import LinkQueue, common_pace, slowest_turn
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Urgency
from rass_mav.core.observer import Observer
from rass_mav.link.budget import Budget
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from tests.agent.build import settings_of
from tests.some import some
from tests.telemetry import global_position_int, named_value_float

BYTES_S = 5760.0


class Simulation:
    """Things that happen at times."""

    def __init__(self) -> None:
        self.now = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def at(self, when: float, do: Callable[[], None]) -> None:
        heapq.heappush(self._events, (max(when, self.now), next(self._order), do))

    def run(self, until: float) -> None:
        while self._events and self._events[0][0] <= until:
            self.now, _, do = heapq.heappop(self._events)
            do()
        self.now = until


class Air:
    """The channel."""

    def __init__(self, simulation: Simulation, bytes_s: float = BYTES_S) -> None:
        self._simulation = simulation
        self._bytes_s = bytes_s
        self._queue: deque[tuple[float, int | None, bytes, Urgency | None]] = deque()
        self._busy = False
        self.hearers: list[tuple[int, Callable[[bytes], None]]] = []
        self.used: dict[Urgency | None, float] = dict.fromkeys([*Urgency, None], 0.0)
        """Seconds of airtime by kind; None: telemetry."""
        self.telemetry_waits: list[float] = []
        """How long each telemetry frame waited for the channel, seconds."""
        self.beacons: list[tuple[int | None, float]] = []
        """Sender of each beacon, and when it was heard."""

    def send(self, sender: int | None, frame: bytes, urgency: Urgency | None) -> None:
        """`urgency` None: telemetry."""
        self._queue.append((self._simulation.now, sender, frame, urgency))
        if not self._busy:
            self._begin()

    def _begin(self) -> None:
        since, sender, frame, urgency = self._queue.popleft()
        self._busy = True
        now = self._simulation.now
        takes = len(frame) / self._bytes_s
        self.used[urgency] += takes
        if urgency is None:
            self.telemetry_waits.append(now - since)

        def end() -> None:
            self._busy = False
            if urgency is Urgency.BEACON:
                self.beacons.append((sender, self._simulation.now))
            for hearer, hear in self.hearers:
                if hearer != sender:
                    hear(frame)
            if self._queue and not self._busy:
                self._begin()

        self._simulation.at(now + takes, end)


class Arrivals(Observer):
    """What was made, and what has arrived at the base."""

    def __init__(self) -> None:
        self.made: set[DatumId] = set()
        self.ids: set[DatumId] = set()

    def created(self, datum: Any) -> None:
        self.made.add(datum.id)

    def delivered(self, datum: Any) -> None:
        self.ids.add(datum.id)


class RadioNode:
    """A node on the shared radio: the real agent and the real lane."""

    def __init__(
        self, simulation: Simulation, air: Air, node_id: int, budget: Budget, *, base: bool, observer: Observer | None,
        rng: random.Random, **sections: Any,
    ) -> None:  # fmt: skip
        settings = settings_of(node_id, base=base, **{"ground": None, **sections})
        self.simulation = simulation
        self.air = air
        self.id = node_id
        self.begins = rng.random()
        self.agent = build_node(
            settings, MemoryStore(1000 + node_id), random.Random(node_id), now=self.begins, observer=observer,
            newborn=True,
        )  # fmt: skip
        self.link_queue = LinkQueue(
            self.agent, Duplicates(), budget=budget, stream=True, rng=random.Random(-node_id), now=self.begins
        )
        self._alarm: float | None = None
        air.hearers.append((node_id, self.hear))
        simulation.at(self.begins, self.step)

    def step(self) -> None:
        now = self.simulation.now
        agent, link_queue = self.agent, self.link_queue
        assert link_queue.pacer is not None
        link_queue.pacer.neighbours = len(agent.node.routing.neighbours)
        turn_s, items = common_pace([link_queue], 1.0, agent.settings.store.bandwidth_items)
        agent.node.keep_pace(turn_s, items, now, slowest_turn([link_queue], 1.0))
        agent.pace_vehicle(link_queue.pacer.vehicle_rate)
        if not agent.settings.base:
            agent.reading(0.5, now)  # of its own sensor
        ways = {Way.NEIGHBOURS} if agent.ground is None else {Way.NEIGHBOURS, Way.VEHICLE}
        self.say([outgoing for outgoing in agent.step(now) if outgoing.way in ways])
        if agent.ground is not None:
            self.tend()
        self.simulation.at(now + 1.0, self.step)

    def put(self, payload: bytes) -> None:
        """Create a datum."""
        now = self.simulation.now
        self.agent.node.put(payload, now)
        self.say(self.agent.forward(now))

    def tend(self) -> None:
        """What goes to the autopilot and the ground, over the same radio; as the driver does it."""
        now = self.simulation.now
        frames, due = self.agent.tend(now)
        self.say([outgoing for outgoing in frames if outgoing.way is Way.VEHICLE])
        # Beyond it, the next step comes first.
        if due < now + 1.0:
            self.simulation.at(due, self.tend)

    def say(self, frames: Any) -> None:
        for outgoing in frames:
            assert isinstance(outgoing, Outgoing)
            if outgoing.way is Way.NEIGHBOURS:
                self.link_queue.duplicates.sent(outgoing.frame, self.simulation.now)
            self.link_queue.push(outgoing, self.simulation.now)
        self.pump()

    def pump(self) -> None:
        now = self.simulation.now
        pacer = some(self.link_queue.pacer)
        while True:
            before = list(pacer.sent)
            queued = self.link_queue.pop(now)
            if queued is None:
                break
            (urgency,) = (u for u in Urgency if pacer.sent[u] != before[u])
            self.air.send(self.id, queued.frame, urgency)
        due = pacer.next_at(now)
        if due is not None and (self._alarm is None or due < self._alarm - 1e-9 or self._alarm <= now):
            self._alarm = due
            self.simulation.at(due, partial(self._wake, due))

    def _wake(self, alarm: float) -> None:
        # One that was set earlier and for later has been replaced.
        if alarm == self._alarm:
            self._alarm = None
            self.pump()

    def hear(self, frame: bytes) -> None:
        for answers in self.link_queue.take(frame, self.simulation.now, lambda sender: None):
            self.say(answers)


class Vehicle:
    """An autopilot that tells the ground about its flight over the same radio."""

    def __init__(self, simulation: Simulation, air: Air, system_id: int, bytes_s: float, rng: random.Random) -> None:
        self._simulation = simulation
        self._air = air
        self._writer = FrameWriter(system_id, 1)
        self._messages = itertools.cycle(
            [global_position_int(45.0, -73.0, 100.0, 10.0, 1), named_value_float("RAD", 1.0, 1)]
        )
        self._bytes_s = bytes_s
        simulation.at(rng.random() * 40 / bytes_s, self._say)

    def _say(self) -> None:
        frame = self._writer.message(next(self._messages))
        self._air.send(None, frame, None)
        self._simulation.at(self._simulation.now + len(frame) / self._bytes_s, self._say)
