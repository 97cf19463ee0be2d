"""Drivers whose ports are pseudo-terminals: pulled out and plugged in again in the middle of everything."""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rass_mav.agent.settings import GroundSettings
from rass_mav.app.clock import Clock
from rass_mav.app.driver import Driver
from rass_mav.app.status import status
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.base import Link
from rass_mav.link.settings import AirtimeSection, LinkSection, RNodeSection
from rass_mav.link.vehicle import VehiclePort, open_vehicle
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.messages import COMMAND_LONG, HEARTBEAT, NAMED_VALUE_FLOAT, TUNNEL
from rass_mav.station.node import build_node
from rass_mav.station.rates import MessageRates, message_ids
from rass_mav.store.memory import MemoryStore
from tests.link.rnode_modem import Modem, join
from tests.patience import PATIENCE_S
from tests.ptys import SerialDevice
from tests.telemetry import named_value_float

from .app_drivers import Arrivals, settings

#: Fast enough for a test.
AIRTIME = AirtimeSection(bytes_s=100_000.0, duty=1.0, frames_s=1000.0)


class Cable:
    """Two serial devices joined: what one says, the other hears. A test may spoil what passes."""

    def __init__(self, directory: Path, names: tuple[str, str]) -> None:
        self.ends = tuple(SerialDevice(directory / name) for name in names)
        self.carries = True
        self._rng = random.Random(4)

    def plug_in(self) -> None:
        for end in self.ends:
            end.plug()
        loop = asyncio.get_running_loop()
        a, b = self.ends
        loop.add_reader(a.far, self._pass, a, b)
        loop.add_reader(b.far, self._pass, b, a)

    def pull_out(self) -> None:
        for end in self.ends:
            asyncio.get_running_loop().remove_reader(end.far)
            end.unplug()

    def _pass(self, source: SerialDevice, sink: SerialDevice) -> None:
        try:
            data = os.read(source.far, 4096)
            if self.carries:
                # In pieces that end anywhere, and with garbage between.
                cut = self._rng.randrange(len(data) + 1)
                os.write(sink.far, data[:cut])
                os.write(sink.far, data[cut:] + (b"\xfd\x55noise" if self._rng.random() < 0.2 else b""))
        except OSError:
            pass  # the other side has not opened its end, or has just closed it


class Running:
    """A driver on its task."""

    def __init__(
        self, node_id: int, links: list[Link], vehicle: VehiclePort | None = None, *, base: bool = False,
        arrivals: Arrivals | None = None, ground: GroundSettings | None = None,
    ) -> None:  # fmt: skip
        clock = Clock()
        self.agent = build_node(
            settings(node_id, base=base, ground=ground), MemoryStore(1000 + node_id), random.Random(node_id),
            now=clock.now(), observer=arrivals, newborn=True,
        )  # fmt: skip
        if vehicle is not None:
            rates = MessageRates(self.agent, message_ids({"GLOBAL_POSITION_INT": 1.0}))
            self.agent.listeners.append(rates)
            self.agent.services.append(rates)
        self.executor = ThreadPoolExecutor(1)
        self.driver = Driver(self.agent, links, vehicle, clock.now, self.executor, random.Random(node_id))
        self.ports: list[Link | VehiclePort] = [*links, *([vehicle] if vehicle is not None else [])]
        self.task = asyncio.create_task(self.driver.run())

    async def end(self) -> None:
        self.driver.stop()
        await asyncio.wait_for(self.task, PATIENCE_S)
        for port in self.ports:
            port.close()
        self.executor.shutdown()


async def until(condition: Callable[[], bool]) -> None:
    async def wait() -> None:
        while not condition():
            await asyncio.sleep(0)  # lets the others run

    await asyncio.wait_for(wait(), PATIENCE_S)


def reads(node: Running) -> float | None:
    reading = node.agent.telemetry.reading
    return None if reading is None else reading.value


def serial(device: SerialDevice) -> Link:
    return LinkSection(type="serial", device=f"{device.path},57600", airtime=AIRTIME).open(None)


async def test_data_arrive_over_a_serial_radio_that_is_pulled_out_in_the_middle(tmp_path: Path) -> None:
    cable = Cable(tmp_path, ("ttyUSB0", "ttyUSB1"))
    cable.plug_in()
    arrivals = Arrivals()
    base = Running(1, [serial(cable.ends[0])], base=True, arrivals=arrivals)
    drone = Running(2, [serial(cable.ends[1])])
    ids = [await drone.driver.put(b"before %d" % n, 0) for n in range(5)]
    await arrivals.until(5)
    cable.pull_out()
    # Storage goes on.
    ids += [await drone.driver.put(bytes([n]) * 3000, 0) for n in range(1, 3)]
    ids += [await drone.driver.put(b"meanwhile %d" % n, 0) for n in range(5)]
    cable.plug_in()
    # One more, while all of it is on its way.
    ids.append(await drone.driver.put(b"x" * 5000, 0))
    await arrivals.until(9)
    cable.pull_out()
    cable.plug_in()
    await arrivals.until(13)
    assert set(arrivals.data) == set(ids)
    assert {len(datum.payload) for datum in arrivals.data.values()} >= {3000, 5000}
    for node in (base, drone):
        await node.end()
    cable.pull_out()


async def test_data_arrive_over_two_lora_modems_of_which_one_restarts(tmp_path: Path) -> None:
    modems = [Modem(tmp_path / "ttyACM0").plug(), Modem(tmp_path / "ttyACM1").plug()]
    join(*modems)
    radio = RNodeSection(frequency_mhz=869.525, region="none")
    links = [
        LinkSection(type="rnode", device=f"{modem.device.path},115200", rnode=radio, airtime=AIRTIME).open(None)
        for modem in modems
    ]
    arrivals = Arrivals()
    base = Running(1, links[:1], base=True, arrivals=arrivals)
    drone = Running(2, links[1:])
    ids = [await drone.driver.put(b"before %d" % n, 0) for n in range(5)]
    await arrivals.until(5)
    modems[1].restart()
    ids += [await drone.driver.put(bytes([n]) * 2000, 0) for n in range(3)]
    await arrivals.until(8)
    assert set(ids) == set(arrivals.data)
    # Frames shared packets: beacons and answers, and chunks of what is large.
    assert max(len(packet) for packet in modems[1].sent) > 158
    assert status(drone.driver, 0.0)["links"][0]["modem"]["rssi_dbm"] == -80
    await drone.end()
    await base.end()
    for modem in modems:
        modem.unplug()


class Autopilot:
    """The far end of the vehicle's port. Answers nothing, but listens."""

    def __init__(self, device: SerialDevice) -> None:
        self.device = device
        self.writer = FrameWriter(7, 1)
        self.heard: list[Frame] = []
        self._reader = FrameReader()

    def say(self, *frames: bytes) -> None:
        self.device.say(b"".join(frames))

    async def until(self, message_id: int) -> None:
        """Wait for a message after those heard so far."""
        loop = asyncio.get_running_loop()
        came = loop.create_future()

        def readable() -> None:
            self.heard += self._reader.feed(os.read(self.device.far, 4096))
            if any(frame.message_id == message_id for frame in self.heard) and not came.done():
                came.set_result(None)

        loop.add_reader(self.device.far, readable)
        try:
            await asyncio.wait_for(came, PATIENCE_S)
        finally:
            loop.remove_reader(self.device.far)


@pytest.mark.parametrize("garbage", [b"", b"\xfd\x09\x00\x00", bytes(range(256)) * 8], ids=["none", "half", "baud"])
async def test_an_autopilot_that_comes_back_is_greeted_and_heard_within_five_seconds(
    tmp_path: Path, garbage: bytes
) -> None:
    device = SerialDevice(tmp_path / "serial0")
    vehicle = open_vehicle(parse_vehicle_url(f"{device.path},921600"))
    node = Running(3, [], vehicle)
    loop = asyncio.get_running_loop()
    for value in (1.5, 2.5, 3.5):
        autopilot = Autopilot(device.plug())
        began = loop.time()
        await autopilot.until(HEARTBEAT)
        assert autopilot.heard[0].message_id == HEARTBEAT
        reading = autopilot.writer.message(named_value_float("RAD", value, 1))
        autopilot.say(garbage, autopilot.writer.message(autopilot_heartbeat()), reading[:9])
        autopilot.say(reading[9:])

        def value_read(value: float = value) -> bool:
            return reads(node) == value

        await until(value_read)
        if value == 1.5:
            await autopilot.until(COMMAND_LONG)
        assert loop.time() - began < 5.0
        # In the middle of a frame.
        autopilot.say(autopilot.writer.message(named_value_float("RAD", 99.0, 1))[:15])
        device.unplug()
        # The node goes on without it.
        goal = node.agent.steps + 3

        def goes_on(goal: int = goal) -> bool:
            return node.agent.steps >= goal and bool(vehicle.trouble)

        await node.driver.put(b"stored", 0)
        await until(goes_on)
    await node.end()


async def test_peers_through_the_autopilots_port(tmp_path: Path) -> None:
    """Two nodes, each at the port of its autopilot; the autopilots' radio is the cable."""
    cable = Cable(tmp_path, ("fc0", "fc1"))
    cable.plug_in()
    arrivals = Arrivals()
    nodes = []
    for n, end in enumerate(cable.ends):
        vehicle = open_vehicle(parse_vehicle_url(f"serial:{end.path}:921600"))
        link = LinkSection(type="autopilot", airtime=AIRTIME).open(vehicle)
        assert not link.one_hop
        nodes.append(Running(n + 1, [link], vehicle, base=n == 0, arrivals=arrivals if n == 0 else None))
    await nodes[1].driver.put(b"through", 0)
    await nodes[1].driver.put(b"and a long one" * 100, 0)
    await arrivals.until(2)
    assert nodes[1].agent.vehicle_writer is nodes[1].agent.peers.writer, "one port, one sequence"
    assert nodes[1].driver.channels[0].link.counters().received > 0
    for node in nodes:
        await node.end()
    cable.pull_out()


async def test_what_the_autopilot_is_told_keeps_to_the_budget_of_the_radio_behind_it(tmp_path: Path) -> None:
    """Values ten times a second would be 1,000 bytes a second: the autopilot passes them on like all that it hears."""
    airtime = AirtimeSection(bytes_s=1000.0, duty=0.2)
    device = SerialDevice(tmp_path / "serial0")
    vehicle = open_vehicle(parse_vehicle_url(f"{device.path},921600"))
    link = LinkSection(type="autopilot", airtime=airtime).open(vehicle)
    autopilot = Autopilot(device.plug())
    node = Running(3, [link], vehicle, ground=GroundSettings(values_s=0.1))
    began = asyncio.get_running_loop().time()
    for _ in range(3):
        # The first frame on the port, and then one in two seconds.
        autopilot.heard, heard = [], autopilot.heard
        await autopilot.until(HEARTBEAT)
        autopilot.heard = heard + autopilot.heard
    seconds = asyncio.get_running_loop().time() - began
    assert autopilot.heard[0].message_id == HEARTBEAT
    assert {frame.message_id for frame in autopilot.heard} >= {HEARTBEAT, NAMED_VALUE_FLOAT, TUNNEL}
    # 12 bytes around each payload; its trailing zeros do not travel.
    said = sum(12 + len(frame.payload.rstrip(b"\0")) for frame in autopilot.heard)
    assert said <= airtime.burst_bytes + seconds * 1000.0 * 0.2
    told = node.driver.channels[0].link_queue.report()["airtime"]["sent"]
    assert told["vehicle"] >= 3
    await node.end()
    device.unplug()
