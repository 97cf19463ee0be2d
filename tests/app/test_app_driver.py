"""The asyncio driver: commit, then send; steps on time; bounded whatever happens."""

from __future__ import annotations

import asyncio
import errno
import itertools
import os
import random
import resource
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from rass_mav.agent.commits import MAX_WAITING
from rass_mav.app.clock import Clock
from rass_mav.app.driver import Driver
from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import BEACON_BASE, UNBOUNDED_FREE, Beacon, Committed, Data
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.errors import DatumError, StoreDamagedError, StoreError, StoreFullError
from rass_mav.link.base import LinkCounters
from rass_mav.link.udp import UdpLink
from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.frames import FrameReader
from rass_mav.policy.settings import PolicySettings
from rass_mav.station.node import build_node
from rass_mav.store.disk import BlockFile
from rass_mav.store.memory import MemoryStore
from rass_mav.store.sqlite import SqliteStore
from tests.link.loopback import LoopbackHub
from tests.nodes import node_of
from tests.patience import PATIENCE_S

from .app_drivers import STEP_S, Arrivals, HeldExecutor, NeighbourEnd, running, settings

STATUSTEXT = 253


def a_datum(sequence: int, size: int = 20) -> Datum:
    return make_datum(DatumId(9, 0xABCD, sequence), 0, 0.0, sequence.to_bytes(4, "big") + os.urandom(size - 4))


def open_store(path: Path, epoch: int = 77) -> SqliteStore:
    return SqliteStore.open(path, node_id=7, draw_epoch=lambda: epoch)


async def test_two_agents_over_the_loopback_bring_data_to_the_base() -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("drone"), hub.endpoint("base")
    hub.connect(a, b)
    arrivals = Arrivals()
    sent = {}
    async with (
        running(a, MemoryStore(1), settings(2)) as drone,
        running(b, MemoryStore(2), settings(1, base=True), observer=arrivals),
    ):
        for payload in (b"one", b"two", os.urandom(3000)):
            sent[await drone.put(payload, 0)] = payload
        await asyncio.wait_for(arrivals.until(3), PATIENCE_S)
        assert a.reaches(1), "the base's address was learned from its beacons"
    assert {id: datum.payload for id, datum in arrivals.data.items()} == sent


async def test_the_answer_leaves_after_the_commit_and_beacons_do_not_wait(tmp_path: Path) -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("neighbour"), hub.endpoint("node")
    hub.connect(a, b)
    disk = HeldExecutor()
    store = open_store(tmp_path / "node.db")
    neighbour = NeighbourEnd(a, 9)
    async with running(b, store, settings(1, base=True), executor=disk) as driver:
        # A base stores its announcement number first of all.
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        disk.release()
        await neighbour.beacons(1)
        disk.arrived.clear()
        first = a_datum(0)
        neighbour.hand_over(1, 100, first)
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        # It is held in memory, but not durable: only beacons go out, and what arrives meanwhile is the next batch.
        assert first.id in node_of(driver.agent).custody_store.arrived
        neighbour.hand_over(1, 101, a_datum(1))
        neighbour.hand_over(1, 102, a_datum(2))
        await neighbour.beacons(3)
        assert neighbour.kinds() == []
        assert driver.writer.gate.committing
        assert len(disk.submitted) == 1, "one commit at a time"
        disk.arrived.clear()
        disk.release()
        await neighbour.until(lambda heard: any(isinstance(m, Committed) for m in heard))
        assert [m.committed for m in neighbour.heard if isinstance(m, Committed)] == [((100, first.crc),)]
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        disk.arrived.clear()
        disk.release()
        await neighbour.until(lambda heard: sum(isinstance(m, Committed) for m in heard) == 2)
        assert [n for m in neighbour.heard if isinstance(m, Committed) for n, _ in m.committed] == [100, 101, 102]
        assert driver.writer.gate.commits == 3, "what came in together was committed together"
        driver.stop()
        finish = asyncio.ensure_future(_release_all(disk))
        await driver_done(driver)
        finish.cancel()
    store.close()


async def _release_all(disk: HeldExecutor) -> None:
    while True:
        while disk.submitted:
            disk.release()
        disk.arrived.clear()
        await disk.arrived.wait()


async def driver_done(driver: object) -> None:
    """The loop gets a turn; `running` waits for the end."""
    await asyncio.wait_for(asyncio.get_running_loop().run_in_executor(None, int), PATIENCE_S)


async def test_a_put_is_answered_when_it_is_durable(tmp_path: Path) -> None:
    link = LoopbackHub().endpoint("node")
    disk = HeldExecutor()
    store = open_store(tmp_path / "node.db")
    async with running(link, store, settings(3), executor=disk) as driver:
        putting = asyncio.ensure_future(driver.put(b"hello", 0))
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        assert not putting.done()
        disk.release()
        id = await asyncio.wait_for(putting, PATIENCE_S)
        for wrong in (b"", bytes((1 << 20) + 1)):
            with pytest.raises(DatumError):
                await driver.put(wrong, 0)
    store.abandon()
    with open_store(tmp_path / "node.db") as again:
        found = again.get(id)
        assert found is not None
        assert found.payload == b"hello"


async def test_answers_are_left_out_only_where_all_neighbours_hear_every_frame() -> None:
    """With two links a neighbour may be in range of one alone; unicast reaches its target only."""
    hub = LoopbackHub()
    one, other = hub.endpoint("one"), hub.endpoint("other")
    unicast, broadcast = (UdpLink(("127.0.0.1", 0), data=data) for data in ("unicast", "broadcast"))
    with ThreadPoolExecutor(1) as executor:
        for links, all_hear in (([one], True), ([one, other], False), ([unicast], False), ([broadcast], True)):
            agent = build_node(settings(2), MemoryStore(1), random.Random(1), now=0.0)
            Driver(agent, links, None, Clock().now, executor)
            assert agent.answers.broadcast is all_hear
    unicast.close()
    broadcast.close()


async def test_with_immediate_forwarding_data_leave_after_their_commit_and_not_after_the_next_step(
    tmp_path: Path,
) -> None:
    hub = LoopbackHub()
    link, other = hub.endpoint("node"), hub.endpoint("base")
    hub.connect(link, other)
    base = NeighbourEnd(other, 1)
    disk = HeldExecutor()
    about = replace(settings(3, step_s=3600.0), forward="immediate", policy=PolicySettings(name="rass"))
    store = open_store(tmp_path / "node.db")
    async with running(link, store, about, executor=disk) as driver:
        await base.beacons(1)
        tag = driver.agent.node.policy.tag
        base.say(Beacon(1, 5, 0, BEACON_BASE, 1, 5, 0, 0, 0, 0, 0, UNBOUNDED_FREE, tag, POTENTIAL_BASE, 0), 3)
        base.hand_over(3, 7, a_datum(0))
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        assert base.kinds() == []
        disk.arrived.clear()
        disk.release()
        # The base hears that this node hands its datum on.
        await base.until(lambda heard: base.kinds() == [Data])
        putting = asyncio.ensure_future(driver.put(b"hello", 0))
        await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
        assert base.kinds() == [Data]
        disk.release()
        id = await asyncio.wait_for(putting, PATIENCE_S)
        await base.until(lambda heard: base.kinds() == [Data, Data])
        [said] = [m for m in base.heard[-1:] if isinstance(m, Data)]
        assert [handover.datum.id for handover in said.handovers] == [id]
        assert driver.agent.steps == 1
    store.abandon()


async def test_a_full_node_refuses_a_put() -> None:
    link = LoopbackHub().endpoint("node")
    async with running(link, MemoryStore(1), settings(3, capacity_items=2)) as driver:
        await driver.put(b"1", 0)
        await driver.put(b"2", 0)
        with pytest.raises(StoreFullError):
            await driver.put(b"3", 0)
        assert driver.agent.node.store.counters()["overflow"] == 1


async def test_stopping_commits_what_waits(tmp_path: Path) -> None:
    link = LoopbackHub().endpoint("node")
    store = open_store(tmp_path / "node.db")
    async with running(link, store, settings(3)) as driver:
        putting = [asyncio.ensure_future(driver.put(b"%d" % n, 0)) for n in range(10)]
        await driver_done(driver)
        driver.stop()
        ids = await asyncio.wait_for(asyncio.gather(*putting), PATIENCE_S)
        with pytest.raises(StoreError, match="stopping"):
            await driver.put(b"too late", 0)
    store.abandon()
    with open_store(tmp_path / "node.db") as again:
        assert {i.id for i in again.held()} == set(ids)


def test_missed_steps_are_skipped_and_the_schedule_stays() -> None:
    class JumpingLoop(asyncio.SelectorEventLoop):
        jump = 0.0

        def time(self) -> float:
            return super().time() + self.jump

    loop = JumpingLoop()

    async def scenario() -> None:
        hub = LoopbackHub()
        a, b = hub.endpoint("neighbour"), hub.endpoint("node")
        hub.connect(a, b)
        neighbour = NeighbourEnd(a, 9)
        async with running(b, MemoryStore(1), settings(3)) as driver:
            await neighbour.beacons(2)
            before = driver.agent.steps
            loop.jump += 100 * STEP_S
            await neighbour.beacons(1)
            assert driver.agent.steps == before + 1, "no burst"
            assert driver.steps.skipped >= 99
            await neighbour.beacons(1)
            assert driver.agent.steps == before + 2

    try:
        loop.run_until_complete(scenario())
    finally:
        loop.close()


@pytest.mark.no_cover
async def test_what_waits_for_the_disk_is_bounded_and_the_rest_is_dropped_by_the_link(tmp_path: Path) -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("neighbour"), hub.endpoint("node")
    hub.connect(a, b)
    disk = HeldExecutor()
    store = open_store(tmp_path / "node.db")
    neighbour = NeighbourEnd(a, 9)
    async with running(b, store, settings(1, base=True), executor=disk) as driver:
        numbers = itertools.count(1)
        datum = a_datum(0)
        while driver.writer.gate.waiting < MAX_WAITING // 2 or not b.counters().dropped_in:
            for _ in range(200):
                neighbour.hand_over(1, next(numbers), datum)
            await neighbour.beacons(1)
            assert driver.writer.gate.waiting <= MAX_WAITING
        releasing = asyncio.ensure_future(_release_all(disk))
        await neighbour.until(lambda heard: any(isinstance(m, Committed) for m in heard))
        await neighbour.beacons(2)
        assert driver.writer.gate.waiting < MAX_WAITING // 2, "it goes on"
        driver.stop()
        await driver_done(driver)
        releasing.cancel()
    store.close()


@contextmanager
def disk_that_refuses() -> Iterator[None]:
    """No file of this process may grow: the system refuses, as a disk does that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Autopilot(VehiclePort):
    """Keeps what it is told, and says nothing."""

    name = "autopilot"

    def __init__(self) -> None:
        self.told: list[bytes] = []

    def start(self, wake: Callable[[], None]) -> None:
        pass

    def receive(self) -> list[bytes]:
        return []

    def _send(self, frame: bytes) -> None:
        self.told.append(frame)

    def counters(self) -> LinkCounters:
        return LinkCounters(len(self.told), 0, 0, 0, 0)

    def close(self) -> None:
        pass


def statustexts(frames: list[bytes]) -> list[bytes]:
    reader = FrameReader()
    return [f.payload[1:51] for frame in frames for f in reader.feed(frame) if f.message_id == STATUSTEXT]


async def test_a_disk_that_refuses_holds_promises_back_and_a_later_try_keeps_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rass_mav.app.writer.RETRY_S", 2 * STEP_S)
    hub = LoopbackHub()
    a, b = hub.endpoint("neighbour"), hub.endpoint("node")
    hub.connect(a, b)
    store = open_store(tmp_path / "node.db")
    neighbour = NeighbourEnd(a, 9)
    async with running(b, store, settings(3)) as driver:
        driver.vehicle = autopilot = Autopilot()
        await neighbour.beacons(1)
        with disk_that_refuses():
            neighbour.hand_over(3, 100, a_datum(0))
            with pytest.raises(StoreError, match="not on disk yet"):
                await asyncio.wait_for(driver.put(b"mine", 0), PATIENCE_S)
            while driver.writer.gate.failures < 3:
                await neighbour.beacons(1)
            assert neighbour.kinds() == [], "nothing is promised"
            assert len(statustexts(autopilot.told)) == 2, "told once, in two pieces"
            assert b"trying again" in b"".join(statustexts(autopilot.told))
        await neighbour.until(lambda heard: any(isinstance(m, Committed) for m in heard))
        assert driver.writer.gate.commits >= 1
    store.abandon()
    with open_store(tmp_path / "node.db") as again:
        payloads = {d.payload for i in again.held() if (d := again.get(i.id)) is not None}
    assert b"mine" in payloads
    assert len(payloads) == 2


class FullFile(BlockFile):
    def write(self, offset: int, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FullDisk:
    """It has no space for large payloads."""

    vfs = None

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        return FullFile(path, writable=writable)

    def space(self, folder: Path) -> None:
        """It does not say so beforehand."""


async def test_a_full_disk_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    link = LoopbackHub().endpoint("node")
    store = SqliteStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 5, disk=FullDisk())
    with pytest.raises(StoreError, match="the last data could not be written"):  # noqa: PT012
        async with running(link, store, settings(3, capacity_items=None)) as driver:
            with pytest.raises(StoreError, match="No space left on device"):
                await asyncio.wait_for(driver.put(os.urandom(5000), 0), PATIENCE_S)
    store.abandon()
    assert any("RASS: disk full" in record.message for record in caplog.records)


async def test_damage_ends_the_run(tmp_path: Path) -> None:
    link = LoopbackHub().endpoint("node")
    path = tmp_path / "node.db"
    with open_store(path) as store:
        for sequence in range(50):
            store.put(a_datum(sequence))
    # In their rows, as salvaged ones are.
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE datum SET size = 20000, payload = randomblob(20000)")
        connection.commit()
    store = open_store(path)
    # What opening has not read: the pages that the payloads overflow into.
    with path.open("r+b") as file:
        file.seek(200_000)
        file.write(os.urandom(path.stat().st_size - 200_000))
    clock = Clock()
    with ThreadPoolExecutor(1) as executor:
        agent = build_node(settings(3), store, random.Random(1), now=clock.now())
        driver = Driver(agent, [link], None, clock.now, executor)
        with pytest.raises(StoreDamagedError, match=r"node\.db: "):
            await asyncio.wait_for(driver.run(), PATIENCE_S)
    store.abandon()
