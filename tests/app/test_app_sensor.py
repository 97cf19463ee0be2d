"""A node with a sensor of its own: in the driver, and as a process with a counter on a pseudo-terminal."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rass_mav.app.driver import Driver
from rass_mav.sensor.base import Sensor, SensorReading, SensorState
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from tests.patience import PATIENCE_S
from tests.ptys import SerialDevice
from tests.sensor.sentences import sentence

from .app_drivers import settings
from .app_nodes import RunningNode, command, free_ports


class HandSensor(Sensor):
    """Says what the test says."""

    def __init__(self) -> None:
        super().__init__("hand")
        self.readings: list[SensorReading] = []
        self.wake: Callable[[], None] | None = None

    def start(self, wake: Callable[[], None]) -> None:
        self.wake = wake

    def say(self, value: float, at: float) -> None:
        assert self.wake is not None
        self.readings.append(SensorReading(value, at))
        self.wake()

    def receive(self) -> list[SensorReading]:
        readings, self.readings = self.readings, []
        return readings

    def state(self) -> SensorState:
        return SensorState(True, 0, 0, 0, 0, 1, "the cable is loose")

    def close(self) -> None:
        pass


class Driven:
    """A driver with a sensor, on a timeline that the test moves."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.sensor = HandSensor()
        about = replace(settings(7), sensor_unit="usvh")
        self.agent = build_node(about, MemoryStore(1), random.Random(1), now=self.now)
        self._executor = ThreadPoolExecutor(1)
        self.driver = Driver(self.agent, [], None, lambda: self.now, self._executor, sensor=self.sensor)

    async def steps(self, count: int = 2) -> None:
        """Until so many more steps have been done."""
        aim = self.agent.steps + count

        async def look() -> None:
            while self.agent.steps < aim:
                await asyncio.sleep(0)

        await asyncio.wait_for(look(), PATIENCE_S)

    async def __aenter__(self) -> Driven:
        self._task = asyncio.create_task(self.driver.run())
        await self.steps()
        return self

    async def __aexit__(self, *failure: object) -> None:
        self.driver.stop()
        await asyncio.wait_for(self._task, PATIENCE_S)
        self._executor.shutdown()


async def test_readings_reach_the_agent_and_grow_stale() -> None:
    async with Driven() as driven:
        risk = driven.agent.node.risk
        driven.sensor.say(0.25, driven.now - 1.0)
        await driven.steps()
        assert (risk.risk(driven.now), risk.known(driven.now)) == (0.25, True)
        assert driven.agent.last_reading == (0.25, 999.0, None)
        driven.now += 30.0
        await driven.steps()
        assert (risk.risk(driven.now), risk.known(driven.now)) == (1.0, False)


@pytest.fixture
def counter(tmp_path: Path) -> Iterator[SerialDevice]:
    device = SerialDevice(tmp_path / "ttyCounter").plug()
    yield device
    device.unplug()


def lonely(directory: Path, **sections: Any) -> RunningNode:
    (port,) = free_ports(1)
    link = {"listen": f"127.0.0.1:{port}", "peers": [{"address": "127.0.0.1:9"}]}
    return RunningNode(directory, 7, links=[link], **sections)


def test_a_process_reads_a_counter_that_is_unplugged_and_plugged_in_again(
    tmp_path: Path, counter: SerialDevice
) -> None:
    node = lonely(
        tmp_path,
        sensor={"type": "mightyohm", "port": str(counter.path), "dead_time_us": 0},
        risk={"low": 0, "high": 10, "stale_s": 0.5},
        data={"interval_steps": 4},
    ).start()

    def reads(cpm: int) -> bool:
        counter.say(b"CPS, 1, CPM, %d, uSv/hr, 0.07, SLOW\r\n" % cpm)
        reading = node.status()["reading"]
        return reading is not None and reading["value"] == pytest.approx(cpm / 106)

    try:
        node.until(lambda: reads(212))
        status = node.status()
        assert status["risk"] == pytest.approx(0.2)
        assert status["sensor"]["name"] == f"{counter.path}:9600"
        assert (status["sensor"]["connected"], status["sensor"]["trouble"]) == (True, "")
        human = command(tmp_path, "status", "n7.yaml").stdout.decode()
        assert f"sensor {counter.path}:9600: open, " in human
        assert status["reading"]["unit"] == "usvh"
        assert "reading 2 uSv/h, " in human
        node.until(lambda: reads(212) and any(m["reading"] == pytest.approx(2.0) for m in measurements(node)))
        counter.unplug()
        node.until(lambda: not node.status()["sensor"]["connected"])
        node.until(lambda: node.status()["risk"] == 1.0)
        counter.plug()
        node.until(lambda: reads(106))
        assert node.status()["sensor"]["connections"] == 2
        assert node.signal(15) == 0
    finally:
        node.end()


def measurements(node: RunningNode) -> list[dict[str, float]]:
    return [entry.measurement._asdict() for entry in node.listing().values() if entry.measurement is not None]


def test_a_process_plays_a_log(tmp_path: Path) -> None:
    lines = [sentence(time=b"2012-09-20T15:%02d:%02dZ" % divmod(n, 60), cpm=334 * n) for n in range(600)]
    (tmp_path / "a.LOG").write_bytes(b"\n".join(lines) + b"\n")
    node = lonely(tmp_path, sensor={"type": "log", "path": "a.LOG", "speed": 20.0}).start()
    try:
        node.until(lambda: (reading := node.status()["reading"]) is not None and reading["value"] > 10.0)
        assert node.status()["sensor"]["readings"] > 10
        assert node.signal(15) == 0
    finally:
        node.end()


def test_a_log_that_cannot_be_read_is_said_in_one_line(tmp_path: Path) -> None:
    lonely(tmp_path, sensor={"type": "log", "path": "none.LOG"})
    said = command(tmp_path, "run", "n7.yaml")
    line = f"sensor.path: {tmp_path}/none.LOG: no such file or directory\n"
    assert (said.returncode, said.stderr.decode()) == (2, line)
