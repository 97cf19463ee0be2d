"""Running drivers and a ground station of our own, over UDP."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rass_mav.agent.settings import GroundSettings
from rass_mav.app.clock import Clock
from rass_mav.app.config import load_config
from rass_mav.app.driver import Driver
from rass_mav.core.store import Store
from rass_mav.errors import ConfigError
from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.vehicle_udp import VehicleLink
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT, NAMED_VALUE_FLOAT
from rass_mav.policy.settings import PolicySettings
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.store.sqlite import SqliteStore
from tests.patience import PATIENCE_S

from .app_drivers import HeldExecutor, settings


class GroundStation(asyncio.DatagramProtocol):
    """Hears and asks on a UDP port of its own."""

    def __init__(self) -> None:
        self.heard: list[Any] = []
        self._parser = common.MAVLink(None)
        self._writer = FrameWriter(255, 190)
        self._node: tuple[str, int] | None = None
        self._changed = asyncio.Event()

    async def open(self) -> str:
        loop = asyncio.get_running_loop()
        self.transport, _ = await loop.create_datagram_endpoint(lambda: self, ("127.0.0.1", 0))
        return f"udpout:127.0.0.1:{self.transport.get_extra_info('sockname')[1]}"

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._node = addr
        self.heard += self._parser.parse_buffer(data) or []
        self._changed.set()

    def ask(self, message: MavlinkMessage) -> None:
        self.transport.sendto(self._writer.message(message), self._node)

    async def until(self, done: Callable[[Any], bool]) -> Any:
        """The first message, from those heard, that is so; it and those before are taken off."""
        while True:
            for index, message in enumerate(self.heard):
                if done(message):
                    del self.heard[: index + 1]
                    return message
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), PATIENCE_S)

    async def value(self, name: str) -> float:
        message = await self.until(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == name)
        return float(message.param_value)


def setting(name: str, value: float) -> MavlinkMessage:
    return common.MAVLink_param_set_message(7, 191, name.encode(), value, mav.REAL32)


@asynccontextmanager
async def node(
    store: Store, *, step_s: float = 0.1, executor: Executor | None = None, values_s: float = 0.0
) -> AsyncIterator[tuple[Driver, GroundStation]]:
    """A node that runs, and the ground station that it speaks to."""
    station = GroundStation()
    link = VehicleLink(parse_vehicle_url(await station.open()))
    about = replace(
        settings(7, step_s=step_s),
        policy=PolicySettings(name="rass"),
        ground=GroundSettings(values_s=values_s, computer_s=0),
    )
    clock = Clock()
    own = ThreadPoolExecutor(1)
    driver = Driver(
        build_node(about, store, random.Random(1), now=clock.now()), [], None, clock.now, executor or own, ground=link
    )
    task = asyncio.create_task(driver.run())
    try:
        await station.until(lambda m: m.get_msgId() == HEARTBEAT)
        yield driver, station
    finally:
        driver.stop()
        if isinstance(executor, HeldExecutor):
            while executor.submitted:
                executor.release()
        try:
            await asyncio.wait_for(task, PATIENCE_S)
        finally:
            link.close()
            station.transport.close()
            own.shutdown()


async def test_a_value_set_over_udp_is_there_after_a_restart(tmp_path: Path) -> None:
    for expected in (1.0, 2.5):
        with SqliteStore.open(tmp_path / "n.db", node_id=7, draw_epoch=lambda: 5) as store:
            async with node(store) as (driver, station):
                station.ask(common.MAVLink_param_request_read_message(7, 191, b"RASS_ALPHA", -1))
                assert await station.value("RASS_ALPHA") == expected
                station.ask(setting("RASS_ALPHA", 2.5))
                assert await station.value("RASS_ALPHA") == 2.5
                assert driver.agent.settings.policy.alpha == 2.5


async def test_the_answer_waits_for_the_disk_and_nothing_else_does(tmp_path: Path) -> None:
    disk = HeldExecutor()
    with SqliteStore.open(tmp_path / "n.db", node_id=7, draw_epoch=lambda: 5) as store:
        async with node(store, executor=disk) as (_, station):
            station.ask(setting("RASS_ALPHA", 2.5))
            await asyncio.wait_for(disk.arrived.wait(), PATIENCE_S)
            station.ask(setting("RASS_BETA", -1.0))
            assert await station.value("RASS_BETA") == 10.0, "a refusal rests on nothing"
            await station.until(lambda m: m.get_msgId() == HEARTBEAT)
            assert not [m for m in station.heard if m.get_type() == "PARAM_VALUE"]
            disk.release()
            assert await station.value("RASS_ALPHA") == 2.5


async def test_the_length_of_a_step_changes_while_it_waits_for_the_next() -> None:
    async with node(MemoryStore(1), step_s=60.0) as (driver, station):
        assert driver.agent.steps == 1
        await station.until(lambda m: m.get_msgId() == HEARTBEAT)
        station.ask(setting("RASS_STEP_S", 0.05))
        assert await station.value("RASS_STEP_S") == pytest.approx(0.05)
        before = driver.agent.steps
        station.ask(common.MAVLink_command_long_message(7, 191, 511, 0, NAMED_VALUE_FLOAT, 5e5, 0, 0, 0, 0, 0))
        for _ in range(3):
            await station.until(lambda m: m.get_msgId() == NAMED_VALUE_FLOAT and m.name == "RASS_HOPS")
        # One second has passed.
        assert driver.agent.steps - before >= 10


async def test_a_listing_is_complete_over_udp() -> None:
    async with node(MemoryStore(1), values_s=0.5) as (driver, station):
        station.ask(common.MAVLink_param_request_list_message(0, 0))
        assert driver.agent.ground is not None
        listed = {name: await station.value(name) for name in driver.agent.ground.report()["parameters"]}
        assert listed["RASS_NODE_ID"] == 7.0


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("ground: {url: nonsense}", "ground.url: expected udpin:host:port"),
        ("ground: {values_s: -1}", "ground.values_s: expected a number >= 0"),
        ("mavlink: {reading_name: RASS_RISK}", "mavlink.reading_name: expected a name other than RASS_PHI"),
    ],
)
def test_what_cannot_be_configured(tmp_path: Path, lines: str, said: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(f"node: {{id: 7, role: base}}\n{lines}\n")
    with pytest.raises(ConfigError, match="node.yaml: " + said):
        load_config(path)
