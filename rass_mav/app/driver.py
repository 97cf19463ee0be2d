"""The asyncio driver: provides time, links and commits to an `Agent`.

Commit, THEN send. All input of one turn of the event loop is one batch. The store writes it on a worker thread, one
batch at a time, while the next one gathers. Frames that depend on a batch leave when its write has returned. Beacons
and frames to the autopilot leave at once. So a slow disk delays answers, not heartbeats.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import MAX_WAITING
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.agent.turns import jitter
from rass_mav.app.duplicates import Duplicates
from rass_mav.app.linkqueue import LinkQueue, set_pace
from rass_mav.core.datum import USUAL, DatumId, Terms
from rass_mav.core.exchange import SPREAD_S
from rass_mav.errors import StoreError, StoreFullError
from rass_mav.link.base import Address, Link
from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.messages import CRITICAL, RADIO_STATUS, TUNNEL
from rass_mav.mavlink.telemetry import Position, Reading
from rass_mav.sensor.base import Sensor, TunnelSensor

from .clock import LivedClock
from .notify import Notifier
from .tunnels import TunnelListener
from .writer import Writer

log = logging.getLogger(__name__)

#: Seconds between two reports of a failing disk to the ground, at least.
ALARM_S = 30.0


@dataclass
class Steps:
    """What became of the steps of this run."""

    skipped: int = 0
    """Left out because the machine was late."""
    last: float | None = None
    """When the last one was done, on the driver's timeline; None: none was."""


class Channel:
    """One connection to the neighbours, on the event loop."""

    def __init__(self, link: Link, link_queue: LinkQueue, now: Callable[[], float], closed: Callable[[], bool]) -> None:
        """`now`: the agent's timeline. `closed`: returns whether nothing may leave yet; then the caller tries again."""
        self.link = link
        self.link_queue = link_queue
        self._now = now
        self._closed = closed
        self._alarm: asyncio.TimerHandle | None = None

    def send(self, outgoing: Outgoing, *, first: bool = False) -> None:
        """Send a frame as soon as the link can carry it; `first`: before all others of the same urgency."""
        self.link_queue.push(outgoing, self._now(), first=first)
        self._pump()

    def _pump(self) -> None:
        """Send what may leave now, and schedule the next call."""
        if self._closed():
            return
        now = self._now()
        while (queued := self.link_queue.pop(now)) is not None:
            self.link.send(queued.frame, queued.target)
        self.stop()
        due = self.link_queue.next_at(now)
        if due is not None:
            self._alarm = asyncio.get_running_loop().call_later(due - now, self._pump)

    def stop(self) -> None:
        """Cancel the next call."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None


class Driver:
    """Runs one agent on the event loop until `stop`."""

    def __init__(
        self,
        agent: Agent,
        links: Sequence[Link],
        vehicle: VehiclePort | None,
        now: Callable[[], float],
        executor: Executor,
        rng: random.Random | None = None,
        sensor: Sensor | None = None,
        *,
        ground: VehiclePort | None = None,
        mute: bool = False,
        lived: LivedClock | None = None,
    ) -> None:
        """`now`: the agent's timeline. `executor`: one thread, for the store's writes. The caller closes everything.

        `rng`: determines by how much steps are late, and how long a node listens before it sends on a shared radio.
        `sensor`: the node's own; None: readings come from the autopilot. `ground`: a direct connection to a ground
        station. `mute`: send nothing to neighbours. `lived`: the clock behind `now`, if the store keeps the time; None:
        it does not.
        """
        self.agent = agent
        self.vehicle = vehicle
        self.sensor = sensor
        self.ground = ground
        self._mute = mute
        self.steps = Steps()
        self.notifier = Notifier()
        """Notified when the loop goes round. The caller may set one with a receiver."""
        self.now = now
        self.lived = lived
        """Stores the time with the commits."""
        self.duplicates = Duplicates()
        self._rng = rng = rng or random.Random()
        self.channels = [
            Channel(
                link,
                LinkQueue(
                    agent, self.duplicates, budget=link.budget, radio=link.radio, interface=partial(_waiting, link),
                    stream=link.stream, only=link.only, rng=rng, now=now(), name=link.name,
                ),
                now,
                partial(self._greeting, link),
            )
            for link in links
        ]  # fmt: skip
        agent.answers.spread_s = SPREAD_S if any(channel.link_queue.pacer is None for channel in self.channels) else 0.0
        # With several links a neighbour may be in range of the one that the data do not use.
        agent.answers.broadcast = len(links) == 1 and links[0].broadcasts
        self._through = next((c for c in self.channels if c.link.through), None)
        if self._through is not None:
            agent.share_port()
            self._through.link_queue.check = agent.vehicle_reader.check
        if isinstance(sensor, TunnelSensor):
            agent.listeners.append(TunnelListener(sensor))
        self._vehicle_generation = 0
        self._wake = asyncio.Event()
        self.writer = Writer(agent.store, executor, self._wake.set, self._alarm, None if lived is None else lived.note)
        agent.guard.use(self.writer.gate.roll_back)
        self._stopping = False
        self._bug: BaseException | None = None
        self._tend_at = math.inf
        self._next_alarm = now()

    # -- from outside --------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop stepping, commit everything, and let `run` return."""
        self._stopping = True
        self._wake.set()

    def fail(self, error: BaseException) -> None:
        """Let `run` raise this error, from a task that nothing awaits."""
        self._bug = self._bug or error
        self._wake.set()

    async def put(self, payload: bytes, kind: int, terms: Terms = USUAL) -> DatumId:
        """Create a datum. Returns when it is on disk. Raises `StoreFullError` or `DatumError`, and `StoreError` if it
        cannot be written now (it is kept, and written as soon as possible) or was dropped with a frame that hit a
        fault."""
        id = self.create(payload, kind, terms)
        await self.writer.durable()
        return id

    def create(self, payload: bytes, kind: int, terms: Terms = USUAL) -> DatumId:
        """Create a datum, which the next commit writes. Raises `StoreFullError` or `DatumError`, and `StoreError` when
        the node is stopping."""
        return self._create(lambda now: self.agent.node.put(payload, now, kind, terms))

    async def record(self, reading: Reading, position: Position | None, *, own: bool) -> DatumId:
        """As `Agent.record`. Returns when the datum is on disk. Raises `StoreFullError`, and `StoreError` as `put`."""
        id = self._create(lambda now: self.agent.record(reading, position, now, own=own))
        await self.writer.durable()
        return id

    def _create(self, put: Callable[[float], DatumId]) -> DatumId:
        if self._stopping:
            raise StoreError("the node is stopping")
        now = self.now()
        id = put(now)
        self._hand_out(self.agent.forward(now))
        return id

    # -- the loop ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until `stop`. Raises `StoreDamagedError` if nothing more can be stored, and any bug of ours."""
        loop = asyncio.get_running_loop()
        for channel in self.channels:
            channel.link.start(self._wake.set)
        for way in (self.vehicle, self.ground, self.sensor):
            if way is not None:
                way.start(self._wake.set)
        last = loop.time() - self.agent.settings.step_s
        late = 0.0
        try:
            while not self._stopping:
                self._take_in()
                # The ground may have changed the length of a step.
                step_s = self.agent.settings.step_s
                behind = loop.time() - (last + step_s)
                if behind >= late * step_s:
                    self._set_pace()
                    self._hand_out(self.agent.step(self.now()))
                    self.steps.last = self.now()
                    if self.lived is not None:
                        self._keep_time(self.lived)
                    # On an absolute schedule, without drift. Missed steps are skipped: a burst would be of no use.
                    missed = int(behind / step_s)
                    self.steps.skipped += missed
                    last += (missed + 1) * step_s
                    late = jitter(self._rng)
                self._tend()
                # The answers that wait must be there when the commit begins on which they depend.
                for outgoing in self.writer.drive(waits=self.agent.answers.due < math.inf):
                    self._send(outgoing)
                until = min(last + (1.0 + late) * step_s, loop.time() + self._tend_at - self.now())
                await self._sleep(min(until, self.notifier.alive(loop.time())))
            # The last frames, as far as the sockets take them.
            for outgoing in await self.writer.finish():
                self._send(outgoing)
            self._tend()
        finally:
            for channel in self.channels:
                channel.stop()
            self.writer.gate.give_up(StoreError("the node is stopping"))

    async def _sleep(self, until: float) -> None:
        if self.writer.retry_at is not None:
            until = min(until, self.writer.retry_at)
        timer = asyncio.get_running_loop().call_at(until, self._wake.set)
        await self._wake.wait()
        timer.cancel()
        self._wake.clear()
        if self._bug is not None:
            raise self._bug

    def _take_in(self) -> None:
        now = self.now()
        if self.vehicle is not None:
            self._take_in_vehicle(self.vehicle, now)
        if self.ground is not None and self.agent.ground is not None:
            for data in self.ground.receive():
                self.agent.ground.receive(data, now, stream=self.ground.stream)
        if self.sensor is not None:
            for value, at in self.sensor.receive():
                self.agent.reading(value, at)
        for channel in self.channels:
            # If too much waits for the disk, input stays in the kernel's buffer, and is lost when that is full. With a
            # failed disk this would not end, but beacons must be heard. Then answers are dropped instead.
            if self.writer.gate.waiting >= MAX_WAITING // 2 and self.writer.retry_at is None:
                break
            link = channel.link
            channel.link_queue.opened(link.generation)
            for data, source in link.receive():
                for answers in channel.link_queue.take(data, now, partial(_learn, link, source)):
                    self._hand_out(answers)

    def _take_in_vehicle(self, vehicle: VehiclePort, now: float) -> None:
        agent = self.agent
        reader = agent.vehicle_reader
        arrived = vehicle.receive()
        if vehicle.generation != self._vehicle_generation:
            self._vehicle_generation = vehicle.generation
            reader.flush()
            self._send(agent.greet_vehicle(), first=True)
        for data in arrived:
            for frame in reader.feed(data) if vehicle.stream else reader.datagram(data):
                if self._through is not None and frame.message_id in (TUNNEL, RADIO_STATUS):
                    link = self._through.link
                    link.took()
                    self._hand_out(self._through.link_queue.frame(frame, now, partial(_learn, link, (link.name, 0))))
                else:
                    agent.vehicle_frame(frame, now)

    def _keep_time(self, lived: LivedClock) -> None:
        agent = self.agent
        if (date := agent.telemetry.date) is not None:
            lived.hear_date(date.utc, date.at)
        if lived.tend(bool(agent.node.holdings)):
            agent.take_over(agent.settings, self.now(), rebirth=True)

    def _set_pace(self) -> None:
        """Send as many beacons and data as the links can carry with the present neighbours."""
        neighbours = self.agent.node.routing.neighbours
        for channel in self.channels:
            channel.link_queue.meet({id for id in neighbours if channel.link.reaches(id)})
        if self._through is not None and (pacer := self._through.link_queue.pacer) is not None:
            self.agent.pace_vehicle(pacer.vehicle_rate)
        waiting = sum(channel.link.waiting for channel in self.channels if channel.link_queue.pacer is None)
        set_pace(self.agent, [channel.link_queue for channel in self.channels], self.now(), waiting)

    def _hand_out(self, frames: Sequence[Outgoing]) -> None:
        for outgoing in self.writer.gate.say(frames):
            self._send(outgoing)

    def _send(self, outgoing: Outgoing, *, first: bool = False) -> None:
        if outgoing.way is Way.GROUND:
            if self.ground is not None:
                self.ground.send(outgoing.frame)
        elif outgoing.way is Way.NEIGHBOURS:
            self._send_to_neighbours(outgoing)
        elif self._through is not None:
            # The autopilot may forward these frames over the neighbours' radio, so they count there.
            self._through.send(outgoing, first=first)
        elif self.vehicle is not None:
            self.vehicle.send(outgoing.frame)

    def _send_to_neighbours(self, outgoing: Outgoing) -> None:
        if self._mute:
            return
        outgoing = self.agent.peers.leaving(outgoing)
        self.duplicates.sent(outgoing.frame, self.now())
        reaching = [channel for channel in self.channels if channel.link.reaches(outgoing.target)]
        for channel in reaching or self.channels:
            channel.send(outgoing)

    def _tend(self) -> None:
        """Send what is due to the autopilot and to the ground, and answers that have waited."""
        frames, self._tend_at = self.agent.tend(self.now())
        self._hand_out(frames)

    def _greeting(self, link: Link) -> bool:
        """Whether the autopilot's port was opened and waits for its first heartbeat."""
        waits = link.through and self.vehicle is not None and self.vehicle.generation != self._vehicle_generation
        if waits:
            self._wake.set()
        return waits

    def _alarm(self, error: StoreError) -> None:
        now = self.now()
        if now >= self._next_alarm:
            self._next_alarm = now + ALARM_S
            what = "disk full" if isinstance(error, StoreFullError) else "cannot write to disk"
            log.error("%s", error)
            self.agent.tell_ground(CRITICAL, f"RASS: {what}, data are not confirmed; trying again")
            self._tend()


def _waiting(link: Link) -> int:
    return link.waiting


def _learn(link: Link, source: Address, node_id: int) -> None:
    link.learn(node_id, source)
