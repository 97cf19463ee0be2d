"""Drivers within the test's process, over the loopback link."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.settings import AgentSettings, DataSettings, GroundSettings
from rass_mav.app.clock import Clock
from rass_mav.app.driver import Driver
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Beacon, Data, Handover, Message
from rass_mav.core.observer import Observer
from rass_mav.core.settings import CustodySettings, RiskSettings, RoutingSettings, StoreSettings
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import Frame, FrameWriter
from rass_mav.mavlink.settings import MavlinkSettings
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.policy.settings import PolicySettings
from rass_mav.station.node import build_node
from rass_mav.wire import decode, encode
from tests.link.loopback import LoopbackLink
from tests.patience import PATIENCE_S

STEP_S = 0.02
PAYLOAD_TYPE = 33200


def settings(
    node_id: int, *, base: bool = False, step_s: float = STEP_S, ground: GroundSettings | None = None, **store: Any
) -> AgentSettings:
    return AgentSettings(
        node_id=node_id, base=base, step_s=step_s, policy=PolicySettings(), risk=RiskSettings(),
        routing=RoutingSettings(), custody=CustodySettings(), store=StoreSettings(**store),
        data=DataSettings(interval_steps=0), mavlink=MavlinkSettings(), ground=ground,
    )  # fmt: skip


class Arrivals(Observer):
    """Lets a test wait for what arrives at a base."""

    def __init__(self) -> None:
        self.data: dict[DatumId, Datum] = {}
        self._changed = asyncio.Event()

    def delivered(self, datum: Datum) -> None:
        self.data[datum.id] = datum
        self._changed.set()

    async def until(self, count: int) -> None:
        while len(self.data) < count:
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), PATIENCE_S)


class Stepped:
    """A service of an agent. Lets a test wait for what a step brings about."""

    def __init__(self, agent: Agent) -> None:
        agent.services.append(self)
        self._step = asyncio.Event()

    def hear(self, frame: Frame, now: float) -> None:
        """Not this."""

    def step(self, now: float) -> None:
        self._step.set()

    async def until(self, done: Callable[[], bool]) -> None:
        while not done():
            self._step.clear()
            await asyncio.wait_for(self._step.wait(), PATIENCE_S)


class HeldExecutor(Executor):
    """A disk whose writes take as long as the test wants: they run when it says so."""

    def __init__(self) -> None:
        self.submitted: list[tuple[Future[Any], Callable[[], Any]]] = []
        self.arrived = asyncio.Event()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.submitted.append((future, lambda: fn(*args, **kwargs)))
        self.arrived.set()
        return future

    def release(self) -> None:
        """The oldest write is done."""
        future, call = self.submitted.pop(0)
        future.set_result(call())


class NeighbourEnd:
    """A neighbour made by hand: says messages on a loopback endpoint, and hears what the driver sends."""

    def __init__(self, link: LoopbackLink, node_id: int) -> None:
        self.link = link
        self.id = node_id
        self.writer = FrameWriter(200, 191)
        self.heard: list[Message] = []
        self._wake = asyncio.Event()
        link.start(self._wake.set)

    def say(self, message: Message, target: int) -> None:
        for payload in encode(message, 0.0):
            self.link.send(self.writer.tunnel(payload, payload_type=PAYLOAD_TYPE), target)

    def hand_over(self, target: int, number: int, datum: Datum) -> None:
        self.say(Data(self.id, target, (Handover(number, datum),)), target)

    def hear(self) -> list[Message]:
        for datagram in self.link.receive():
            fields = tunnel_from_datagram(datagram.data)
            assert fields is not None
            message = decode(fields[5], 0.0)
            assert message is not None
            self.heard.append(message)
        return self.heard

    async def until(self, done: Callable[[list[Message]], bool]) -> None:
        while not done(self.hear()):
            self._wake.clear()
            await asyncio.wait_for(self._wake.wait(), PATIENCE_S)

    async def beacons(self, count: int) -> None:
        """Wait until so many more beacons have been heard."""
        aim = sum(isinstance(m, Beacon) for m in self.hear()) + count
        await self.until(lambda heard: sum(isinstance(m, Beacon) for m in heard) >= aim)

    def kinds(self) -> list[type]:
        return [type(message) for message in self.hear() if not isinstance(message, Beacon)]


@asynccontextmanager
async def running(
    link: LoopbackLink,
    store: Store,
    about: AgentSettings,
    *,
    observer: Observer | None = None,
    executor: Executor | None = None,
    forgiving: bool = False,
) -> AsyncIterator[Driver]:
    """A driver that runs until the end of the block; what it raises comes out there."""
    clock = Clock()
    agent = build_node(about, store, random.Random(1), now=clock.now(), observer=observer, forgiving=forgiving)
    own = ThreadPoolExecutor(1)
    driver = Driver(agent, [link], None, clock.now, executor or own)
    task = asyncio.create_task(driver.run())
    try:
        yield driver
    finally:
        driver.stop()
        try:
            await asyncio.wait_for(task, PATIENCE_S)
        finally:
            own.shutdown()
