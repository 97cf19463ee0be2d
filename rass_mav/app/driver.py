"""The asyncio driver: brings time, links and commits to an `Agent`.

Commit, THEN send. All that came in within one turn of the event loop is one batch; the store writes it on a worker
thread, one batch at a time, while the next one gathers. Frames that promise something leave when the write that covers
them has returned; beacons and what goes to the autopilot leave at once. So a slow disk delays answers, not heartbeats.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import MAX_WAITING, CommitGate
from rass_mav.agent.duplicates import Duplicates
from rass_mav.agent.lane import Lane, common_pace, slowest_turn
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.core.datum import DatumId
from rass_mav.errors import RassError, StoreDamagedError, StoreError, StoreFullError
from rass_mav.link.base import Address, Link
from rass_mav.link.radio import AutopilotLink
from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.messages import RADIO_STATUS, TUNNEL
from rass_mav.sensor.base import Sensor

from .notify import Notifier

log = logging.getLogger(__name__)

#: After a failed commit the next try comes so much later, seconds.
RETRY_S = 1.0
#: The ground is told of a failing disk at most this often, seconds.
ALARM_S = 30.0
#: The ground is told of a sensor that falls silent, or reads again, at most this often, seconds.
SENSOR_REPORT_S = 30.0
_CRITICAL = 2
_WARNING = 4
_INFO = 6


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
    ) -> None:
        """`now`: the agent's timeline. `executor`: one thread, for the store's writes. The caller closes everything.

        `rng`: decides how long a node listens before it speaks on a shared radio. `sensor`: the node's own; None:
        readings are those of the autopilot. `ground`: straight to a ground station. `mute`: say nothing to neighbours.
        """
        self.agent = agent
        self.links = list(links)
        self.vehicle = vehicle
        self.sensor = sensor
        self.ground = ground
        self._mute = mute
        self.skipped_steps = 0
        """Steps left out because the machine was late."""
        self.gate = CommitGate(agent.store)
        """What waits for which commit."""
        self.notifier = Notifier()
        """Hears that the loop goes round; the caller may set one that tells others."""
        self.now = now
        self.duplicates = Duplicates()
        rng = rng or random.Random()
        self.lanes = [
            Lane(
                agent, self.duplicates, budget=link.budget, stream=link.stream, only=link.only, rng=rng, now=now()
            )
            for link in self.links
        ]  # fmt: skip
        """The node's side of each link."""
        self._alarms: dict[Lane, asyncio.TimerHandle] = {}
        self._through = next(
            (
                (link, lane)
                for link, lane in zip(self.links, self.lanes, strict=True)
                if isinstance(link, AutopilotLink)
            ),
            None,
        )
        if self._through is not None:
            agent.share_port()
        self._vehicle_generation = 0
        self._store = agent.store
        self._executor = executor
        self._wake = asyncio.Event()
        self._stopping = False
        self._bug: BaseException | None = None
        self._tend_at = math.inf
        self._commit: asyncio.Future[None] | None = None
        self._retry_at: float | None = None
        self._next_alarm = now()
        self._sensor_reads = True
        self._next_sensor_report = now() + SENSOR_REPORT_S

    # -- from outside --------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop stepping, commit everything, and let `run` return."""
        self._stopping = True
        self._wake.set()

    def fail(self, error: BaseException) -> None:
        """Let `run` raise this error: something went wrong in a task that nobody waits for."""
        self._bug = self._bug or error
        self._wake.set()

    async def put(self, payload: bytes, kind: int) -> DatumId:
        """Create a datum; returns when it is on disk. Raises `StoreFullError` or `DatumError`; `StoreError` if the
        disk does not take it now (it is kept, and written as soon as possible)."""
        if self._stopping:
            raise StoreError("the node is stopping")
        now = self.now()
        id = self.agent.node.put(payload, now, kind)
        self._hand_out(self.agent.forward(now))
        durable: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def tell(error: RassError | None) -> None:
            if durable.done():
                return
            if error is None:
                durable.set_result(None)
            else:
                durable.set_exception(error)

        self.gate.ask(tell)
        self._wake.set()
        await durable
        return id

    @property
    def committing(self) -> bool:
        """Whether a commit is under way, or has to be tried again."""
        return self._commit is not None or self._retry_at is not None

    # -- the loop ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Until `stop`. Raises `StoreDamagedError`: nothing more can be stored; and whatever is our own bug."""
        loop = asyncio.get_running_loop()
        for link in self.links:
            link.start(self._wake.set)
        for way in (self.vehicle, self.ground, self.sensor):
            if way is not None:
                way.start(self._wake.set)
        last = loop.time() - self.agent.settings.step_s
        try:
            while not self._stopping:
                self._take_in()
                # The length of a step may have been set anew from the ground.
                step_s = self.agent.settings.step_s
                behind = loop.time() - (last + step_s)
                if behind >= 0:
                    self._set_pace()
                    self._hand_out(self.agent.step(self.now()))
                    # On an absolute schedule: no drift. What was missed is skipped, for a burst would help nobody.
                    missed = int(behind / step_s)
                    self.skipped_steps += missed
                    last += (missed + 1) * step_s
                self._tend()
                self._drive_commit()
                until = min(last + step_s, loop.time() + self._tend_at - self.now())
                await self._sleep(min(until, self.notifier.alive(loop.time())))
            await self._finish()
        finally:
            for alarm in self._alarms.values():
                alarm.cancel()
            self.gate.give_up(StoreError("the node is stopping"))

    async def _sleep(self, until: float) -> None:
        if self._retry_at is not None:
            until = min(until, self._retry_at)
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
            self._watch(self.sensor, now)
        for link, lane in zip(self.links, self.lanes, strict=True):
            # With too much waiting for the disk, what arrives stays in the kernel's buffer, and is lost beyond it. On a
            # disk that has failed this would not end, and beacons must be heard: then answers are dropped instead.
            if self.gate.waiting >= MAX_WAITING // 2 and self._retry_at is None:
                break
            lane.opened(link.generation)
            for data, source in link.receive():
                out = lane.take(data, now, partial(_learn, link, source))
                if out:
                    self._hand_out(out)

    def _take_in_vehicle(self, vehicle: VehiclePort, now: float) -> None:
        agent = self.agent
        reader = agent.vehicle_reader
        arrived = vehicle.receive()
        if vehicle.generation != self._vehicle_generation:
            self._vehicle_generation = vehicle.generation
            reader.flush()
            self._send(agent.greet_vehicle(), first=True)
        for data in arrived:
            frames = reader.feed(data)
            if not vehicle.stream and reader.pending:
                frames += reader.flush()
            for frame in frames:
                if self._through is not None and frame.message_id in (TUNNEL, RADIO_STATUS):
                    link, lane = self._through
                    link.took()
                    self._hand_out(lane.frame(frame, now, partial(_learn, link, (link.name, 0))))
                else:
                    agent.vehicle_frame(frame, now)

    def _set_pace(self) -> None:
        """So many beacons and data as the links bear, with the neighbours that there are."""
        node = self.agent.node
        for link, lane in zip(self.links, self.lanes, strict=True):
            if lane.pacer is not None:
                # The length of a step may have been set anew from the ground.
                lane.pacer.step_s = self.agent.settings.step_s
                lane.pacer.neighbours = sum(map(link.reaches, node.routing.neighbours))
        if self._through is not None and (pacer := self._through[1].pacer) is not None:
            self.agent.pace_vehicle(pacer.vehicle_rate)
        step_s = self.agent.settings.step_s
        turn_s, items = common_pace(self.lanes, step_s, node.settings.bandwidth_items)
        node.pace(turn_s, items, self.now(), slowest_turn(self.lanes, step_s))

    def _watch(self, sensor: Sensor, now: float) -> None:
        """Tell the ground when the sensor falls silent, and when it reads again."""
        reads = self.agent.node.risk.known(now)
        if reads == self._sensor_reads or now < self._next_sensor_report:
            return
        self._sensor_reads = reads
        # A cable with a loose contact must not fill the ground station's screen. At the start a sensor gets this time.
        self._next_sensor_report = now + SENSOR_REPORT_S
        if reads:
            self.agent.tell_ground(_INFO, "RASS: the radiation sensor reads again")
        else:
            trouble = sensor.state().trouble
            self.agent.tell_ground(
                _WARNING, f"RASS: no radiation reading, risk counts as the worst{': ' + trouble if trouble else ''}"
            )

    def _hand_out(self, frames: Sequence[Outgoing]) -> None:
        for outgoing in self.gate.say(frames):
            self._send(outgoing)

    def _send(self, outgoing: Outgoing, *, first: bool = False) -> None:
        if outgoing.way is Way.GROUND:
            if self.ground is not None:
                self.ground.send(outgoing.frame)
        elif outgoing.way is Way.NEIGHBOURS:
            self._send_to_neighbours(outgoing)
        elif self.vehicle is not None:
            if self._through is None:
                self.vehicle.send(outgoing.frame)
            else:
                # What the autopilot is told it may pass on over the neighbours' radio, so it counts there.
                self._send_on(*self._through, outgoing, first=first)

    def _send_to_neighbours(self, outgoing: Outgoing) -> None:
        if self._mute:
            return
        now = self.now()
        target = outgoing.target
        self.duplicates.said(outgoing.frame, now)
        ways = list(zip(self.links, self.lanes, strict=True))
        reaching = [way for way in ways if way[0].reaches(target)]
        for link, lane in reaching or ways:
            self._send_on(link, lane, outgoing)

    def _send_on(self, link: Link, lane: Lane, outgoing: Outgoing, *, first: bool = False) -> None:
        if lane.pacer is None:
            link.send(outgoing.frame, outgoing.target)
        else:
            lane.push(outgoing, self.now(), first=first)
            self._pump(link, lane)

    def _pump(self, link: Link, lane: Lane) -> None:
        """Send what may leave now, and come back when more may."""
        pacer = lane.pacer
        assert pacer is not None
        if self._greeting(link):
            self._wake.set()
            return
        now = self.now()
        while (queued := pacer.pop(now)) is not None:
            link.send(queued.frame, queued.target)
        alarm = self._alarms.pop(lane, None)
        if alarm is not None:
            alarm.cancel()
        due = pacer.next_at(now)
        if due is not None:
            loop = asyncio.get_running_loop()
            self._alarms[lane] = loop.call_later(due - now, self._pump, link, lane)

    def _tend(self) -> None:
        """Say to the autopilot and to the ground what is due."""
        frames, self._tend_at = self.agent.tend(self.now())
        self._hand_out(frames)

    def _greeting(self, link: Link) -> bool:
        """Whether the autopilot's port was opened and waits for its first heartbeat."""
        through = self._through is not None and link is self._through[0]
        return through and self.vehicle is not None and self.vehicle.generation != self._vehicle_generation

    # -- commits -------------------------------------------------------------------------------------------------------

    def _drive_commit(self, *, force: bool = False) -> None:
        """Take note of a finished commit, and begin the next one."""
        if self._commit is not None:
            if not self._commit.done():
                return
            self._finish_commit()
        loop = asyncio.get_running_loop()
        if self._retry_at is not None and loop.time() < self._retry_at and not force:
            return
        batch = self.gate.begin(force=force)
        if batch is None:
            self._retry_at = None
            self._release()
            return
        self._commit = loop.run_in_executor(self._executor, self._store.write, batch)
        self._commit.add_done_callback(lambda _: self._wake.set())

    def _finish_commit(self) -> None:
        assert self._commit is not None
        commit, self._commit = self._commit, None
        try:
            commit.result()
        except StoreDamagedError:
            raise
        except StoreError as error:
            self._retry_at = asyncio.get_running_loop().time() + RETRY_S
            self.gate.failed(StoreError(f"not on disk yet, kept in memory until it can be written: {error}"))
            self._alarm(error)
            return
        if self._retry_at is not None:
            self._retry_at = None
            log.warning("the store can be written again")
        self._release()

    def _release(self) -> None:
        for outgoing in self.gate.written():
            self._send(outgoing)

    def _alarm(self, error: StoreError) -> None:
        now = self.now()
        if now >= self._next_alarm:
            self._next_alarm = now + ALARM_S
            what = "disk full" if isinstance(error, StoreFullError) else "cannot write to disk"
            log.error("%s", error)
            self.agent.tell_ground(_CRITICAL, f"RASS: {what}, data are not confirmed; trying again")
            self._tend()

    async def _finish(self) -> None:
        """Commit what there is, and send what it covers: last words, as far as the sockets take them."""
        if self._commit is not None:
            await asyncio.wait([self._commit])
        self._drive_commit(force=True)
        if self._commit is not None:
            await asyncio.wait([self._commit])
            self._finish_commit()
            if self._retry_at is not None:
                raise StoreError("stopped, but the last data could not be written to disk")
        self._tend()


def _learn(link: Link, source: Address, node_id: int) -> None:
    link.learn(node_id, source)
