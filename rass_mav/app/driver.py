"""The asyncio driver: brings time, links and commits to an `Agent`.

Commit, THEN send. All that came in within one turn of the event loop is one batch; the store writes it on a worker
thread, one batch at a time, while the next one gathers. Frames that promise something leave when the write that covers
them has returned; beacons and what goes to the autopilot leave at once. So a slow disk delays answers, not heartbeats.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor

from rass_mav.agent.agent import Agent, Outgoing
from rass_mav.core.datum import DatumId
from rass_mav.core.errors import RassError, StoreDamagedError, StoreError, StoreFullError
from rass_mav.link.base import Link
from rass_mav.link.vehicle import VehicleLink

log = logging.getLogger(__name__)

#: Frames that may wait for a commit. From half of it on, nothing more is taken in from the neighbours.
MAX_WAITING = 2048
#: After a failed commit the next try comes so much later, seconds.
RETRY_S = 1.0
#: The ground is told of a failing disk at most this often, seconds.
ALARM_S = 30.0
_CRITICAL = 2


class Driver:
    """Runs one agent on the event loop until `stop`."""

    def __init__(
        self,
        agent: Agent,
        links: Sequence[Link],
        vehicle: VehicleLink | None,
        now: Callable[[], float],
        executor: Executor,
        *,
        ground: VehicleLink | None = None,
    ) -> None:
        """`now`: the agent's timeline. `executor`: one thread, for the store's writes. `ground`: straight to a ground
        station. The caller closes everything."""
        self.agent = agent
        self.links = list(links)
        self.vehicle = vehicle
        self.ground = ground
        self.skipped_steps = 0
        """Steps left out because the machine was late."""
        self.held_dropped = 0
        """Frames dropped because too many waited for a commit that failed, or was slow."""
        self.commits = 0
        """Commits done."""
        self.failed_commits = 0
        """Commits that failed and were tried again."""
        self.now = now
        self._store = agent.store
        self._executor = executor
        self._wake = asyncio.Event()
        self._stopping = False
        self._bug: BaseException | None = None
        self._pending: list[Outgoing] = []
        self._pending_puts: list[asyncio.Future[None]] = []
        self._covered_words: list[Callable[[], None]] = []
        self._tend_at = math.inf
        self._covered: list[Outgoing] = []
        self._covered_puts: list[asyncio.Future[None]] = []
        self._commit: asyncio.Future[None] | None = None
        self._retry_at: float | None = None
        self._next_alarm = now()

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
        id = self.agent.node.put(payload, self.now(), kind)
        durable: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._pending_puts.append(durable)
        self._wake.set()
        await durable
        return id

    @property
    def committing(self) -> bool:
        """Whether a commit is under way, or has to be tried again."""
        return self._commit is not None or self._retry_at is not None

    @property
    def waiting(self) -> int:
        """Frames that wait for a commit."""
        return len(self._pending) + len(self._covered)

    # -- the loop ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Until `stop`. Raises `StoreDamagedError`: nothing more can be stored; and whatever is our own bug."""
        loop = asyncio.get_running_loop()
        for link in self.links:
            link.start(self._wake.set)
        for way in (self.vehicle, self.ground):
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
                    self._hand_out(self.agent.step(self.now()))
                    # On an absolute schedule: no drift. What was missed is skipped, for a burst would help nobody.
                    missed = int(behind / step_s)
                    self.skipped_steps += missed
                    last += (missed + 1) * step_s
                self._drive_commit()
                self._to_vehicle()
                await self._sleep(min(last + step_s, loop.time() + self._tend_at - self.now()))
            await self._finish()
        finally:
            self._abort_puts(StoreError("the node is stopping"))

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
        agent = self.agent
        now = self.now()
        if self.vehicle is not None:
            for data in self.vehicle.receive():
                agent.vehicle_bytes(data, now)
        if self.ground is not None and agent.ground is not None:
            for data in self.ground.receive():
                agent.ground.receive(data, now)
        own = agent.node.id
        for link in self.links:
            # With too much waiting for the disk, what arrives stays in the kernel's buffer, and is lost beyond it. On a
            # disk that has failed this would not end, and beacons must be heard: then answers are dropped instead.
            if self.waiting >= MAX_WAITING // 2 and self._retry_at is None:
                break
            for data, source in link.receive():
                agent.beacon_from = None
                out = agent.peer_bytes(data, now)
                if agent.beacon_from is not None and agent.beacon_from != own:
                    link.learn(agent.beacon_from, source)
                if out:
                    self._hand_out(out)

    def _hand_out(self, frames: Sequence[Outgoing]) -> None:
        for outgoing in frames:
            if not outgoing.promises:
                self._send(outgoing)
            elif self.waiting < MAX_WAITING:
                self._pending.append(outgoing)
            else:
                self.held_dropped += 1

    def _send(self, outgoing: Outgoing) -> None:
        frame, target, _ = outgoing
        reaching = [link for link in self.links if link.reaches(target)]
        for link in reaching or self.links:
            link.send(frame, target)

    def _to_vehicle(self) -> None:
        """To the autopilot and to the ground: what is due, and what has gathered."""
        agent = self.agent
        self._tend_at = agent.tend(self.now())
        ways = [(self.vehicle, agent.to_vehicle)]
        if agent.ground is not None:
            ways.append((self.ground, agent.ground.to_ground))
        for way, frames in ways:
            if way is not None:
                for frame in frames:
                    way.send(frame)
            frames.clear()

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
        ground = self.agent.ground
        if ground is not None and ground.promised:
            self._covered_words += ground.promised
            ground.promised.clear()
        batch = self._store.take(force=force)
        self._covered, self._pending = self._covered + self._pending, []
        self._covered_puts, self._pending_puts = self._covered_puts + self._pending_puts, []
        if batch is None:
            # All that these frames promise is on disk already.
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
            # The frames stay: they are covered by the next batch, which holds this one's changes again.
            self._retry_at = asyncio.get_running_loop().time() + RETRY_S
            self.failed_commits += 1
            self._abort_puts(StoreError(f"not on disk yet, kept in memory until it can be written: {error}"))
            self._alarm(error)
            return
        self.commits += 1
        if self._retry_at is not None:
            self._retry_at = None
            log.warning("the store can be written again")
        self._release()

    def _release(self) -> None:
        covered, self._covered = self._covered, []
        puts, self._covered_puts = self._covered_puts, []
        words, self._covered_words = self._covered_words, []
        for word in words:
            word()
        for outgoing in covered:
            self._send(outgoing)
        for durable in puts:
            if not durable.done():
                durable.set_result(None)

    def _abort_puts(self, error: RassError) -> None:
        for durable in self._covered_puts + self._pending_puts:
            if not durable.done():
                durable.set_exception(error)
        self._covered_puts = []
        self._pending_puts = []

    def _alarm(self, error: StoreError) -> None:
        now = self.now()
        if now >= self._next_alarm:
            self._next_alarm = now + ALARM_S
            what = "disk full" if isinstance(error, StoreFullError) else "cannot write to disk"
            log.error("%s", error)
            self.agent.tell_ground(_CRITICAL, f"RASS: {what}, data are not confirmed; trying again")
            self._to_vehicle()

    async def _finish(self) -> None:
        """Commit what there is, and send what it covers: last words, as far as the sockets take them."""
        if self._commit is not None:
            await asyncio.wait([self._commit])
        self._drive_commit(force=True)
        if self._commit is not None:
            await asyncio.wait([self._commit])
            failed = self.failed_commits
            self._finish_commit()
            if self.failed_commits != failed:
                raise StoreError("stopped, but the last data could not be written to disk")
        self._to_vehicle()
