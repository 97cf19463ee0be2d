"""A trial: runs the node's own agent with its configured ports for a few seconds, when the node is not running.

It stores nothing and sends nothing to the neighbours, which must not mistake it for the node. To the autopilot it sends
what the node sends: its heartbeat, without which an autopilot sends nothing, and its requests for messages.
"""

from __future__ import annotations

import asyncio
import random
import secrets
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial

from rass_mav.agent.agent import Agent
from rass_mav.agent.settings import AgentSettings
from rass_mav.app.clock import Clock
from rass_mav.app.config import RunConfig
from rass_mav.app.driver import Driver
from rass_mav.app.status import status
from rass_mav.core.messages import BROADCAST
from rass_mav.errors import ConfigError, KeysError, LinkError, LogError, StoreError
from rass_mav.link.address import parse_address, parse_vehicle_url
from rass_mav.link.base import Link
from rass_mav.link.vehicle import VehiclePort, open_vehicle
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.mavlink.messages import HEARTBEAT, parse
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.params.exchange import Autopilot, Exchange, Patience, reading
from rass_mav.params.ports import telling_names
from rass_mav.params.streams import stream_names
from rass_mav.sensor.base import Sensor
from rass_mav.station.node import build_node
from rass_mav.station.rates import MessageRates, message_ids
from rass_mav.station.version import VersionQuestion
from rass_mav.store.memory import MemoryStore
from rass_mav.store.reader import SqliteReader

from .network import is_known
from .radio import DRONEBRIDGE, RadioQuestions
from .watch import LOOK_S, Ear, Evidence, seen_enough

_NO_AUTOPILOT: int = common.MAV_AUTOPILOT_INVALID
#: An autopilot may not answer about parameters that it does not have, and there is not much time.
_PATIENCE = Patience(answer_s=0.7, tries=2, window=10)


class Listener:
    """A service of the agent. It notes which autopilots are heard, and reads the parameters that the checks need."""

    def __init__(self, agent: Agent, *, streams: bool) -> None:
        """`streams`: whether the rates of the autopilot's telemetry matter."""
        self.ear = Ear()
        self._agent = agent
        self._streams = streams
        self._talk: Exchange | None = None

    @property
    def busy(self) -> bool:
        """Whether answers from an autopilot that was heard are still missing."""
        heard = self._agent.telemetry.heartbeat_at is not None
        return heard and (self._talk is None or not self._talk.done)

    def hear(self, frame: Frame, now: float) -> None:
        """Take heartbeats and parameters."""
        self.ear.frames += 1
        if frame.component_id == AUTOPILOT_COMPONENT and frame.message_id == HEARTBEAT:
            autopilot = parse(frame).autopilot
            if autopilot != _NO_AUTOPILOT:
                self.ear.autopilots[frame.system_id] = autopilot
        if self._talk is not None:
            self._talk.hear(frame, now)
            self._ask(self._talk, now)

    def step(self, now: float) -> None:
        """Once a step. Questions start when the autopilot's version is known, because parameter names depend on it."""
        telemetry = self._agent.telemetry
        if self._talk is None and telemetry.version is not None and telemetry.firmware is not None:
            autopilot = Autopilot(telemetry.system_id, telemetry.firmware.autopilot, armed=telemetry.armed)
            autopilot.version = telemetry.version
            names = telling_names(telemetry.firmware) + (stream_names(telemetry.firmware) if self._streams else [])
            questions = {name: reading(autopilot, name) for name in names}
            self._talk = Exchange(autopilot, questions, _PATIENCE)
        if self._talk is not None:
            self._ask(self._talk, now)

    def _ask(self, talk: Exchange, now: float) -> None:
        for message_id, payload in talk.say(now):
            self._agent.tell_vehicle(self._agent.vehicle_writer.frame(message_id, payload))
        if talk.values:
            self.ear.parameters = {name: value.value for name, value in talk.values.items()}


async def try_out(config: RunConfig, most_s: float) -> Evidence:
    """Open the configured ports, observe them for at most `most_s` seconds, and close them. Opens no store."""
    clock = Clock(elapsed=asyncio.get_running_loop().time)
    evidence = Evidence(False, [])
    async with AsyncExitStack() as stack:
        vehicle = _open_vehicle(config, evidence)
        if vehicle is not None:
            stack.callback(vehicle.close)
        links: dict[int, Link] = {}
        for index in range(len(config.links)):
            link = _open_link(config, index, vehicle, evidence)
            if link is not None:
                links[index] = link
                stack.callback(link.close)
        sensor = _open_sensor(config, clock, evidence)
        if sensor is not None:
            stack.callback(sensor.close)
        executor = stack.enter_context(ThreadPoolExecutor(1, "trial"))
        rng = random.Random(secrets.randbits(128))
        agent = build_node(_settings(config), MemoryStore(secrets.randbits(32)), rng, now=clock.now())
        if vehicle is not None and config.autopilot.signing:
            _sign(config, agent, vehicle)
        listener = Listener(agent, streams=any(section.kind.through for section in config.links))
        if vehicle is not None:
            rates = MessageRates(agent, message_ids(config.autopilot.messages))
            agent.listeners += [rates, listener]
            agent.services += [VersionQuestion(agent), rates, listener]
        driver = Driver(agent, list(links.values()), vehicle, clock.now, executor, rng, sensor, mute=True)
        asked = _ask_radios(config, driver, list(links))
        started = clock.now()
        task = asyncio.create_task(driver.run())
        samples = evidence.samples

        def busy() -> bool:
            return listener.busy or any(questions.busy for questions in asked.values())

        while not samples or (clock.now() - started < most_s and (busy() or not seen_enough(config, samples))):
            # A bug that ends the driver raises here.
            await asyncio.wait({task}, timeout=LOOK_S)
            if task.done():
                break
            samples.append(status(driver, started))
        driver.stop()
        await task
        evidence.opened, evidence.ear = list(links), listener.ear
        listener.ear.radios = {index: questions.answers for index, questions in asked.items()}
        return evidence


def _settings(config: RunConfig) -> AgentSettings:
    settings = config.agent_settings()
    mavlink = settings.mavlink
    if mavlink.system_id is None and not mavlink.autopilot_id:
        # Like the node: autopilots never forget a sender, so use the right id from the first frame on.
        try:
            with SqliteReader(config.store_path) as reader:
                mavlink = replace(mavlink, system_id=reader.meta().get("system_id"))
        except StoreError:
            pass  # there is no store yet, or a damaged one, which another check reports
    return replace(
        settings,
        ground=None,
        mavlink=mavlink,
        data=replace(settings.data, interval_steps=0),
        # Shorter steps would not find more. With longer ones the heartbeat would be late.
        step_s=min(settings.step_s, 1.0),
    )


def _open_vehicle(config: RunConfig, evidence: Evidence) -> VehiclePort | None:
    if config.autopilot.url is None:
        return None
    url = parse_vehicle_url(config.autopilot.url)
    if url.mode != "serial" and not is_known(url.address[0]):
        evidence.note("autopilot.url", LinkError(f"unknown host name {url.address[0]}"))
        return None
    try:
        return open_vehicle(url)
    except LinkError as error:
        evidence.note("autopilot.url", error)
        return None


def _sign(config: RunConfig, agent: Agent, vehicle: VehiclePort) -> None:
    """Sign as the node does, if it has usable keys; another check reports if it has not."""
    from rass_mav.app.signing import last_timestamp, sign, signing_key  # with PyNaCl, which few nodes need

    try:
        keyring = config.open_keys()
    except KeysError:
        return
    assert keyring is not None
    sign(agent, vehicle, SignedPort(signing_key(keyring), last_timestamp(config.store_path)))


def _open_link(config: RunConfig, index: int, vehicle: VehiclePort | None, evidence: Evidence) -> Link | None:
    section = config.links[index]
    key = f"links[{index}]"
    if section.kind.through and vehicle is None:
        evidence.note(key, LinkError("the autopilot's port is not open"))
        return None
    if not section.kind.shared:
        texts = [section.listen, section.broadcast, *(peer.address for peer in section.peers)]
        for text in filter(None, texts):
            host = parse_address(text, any_port=True)[0]
            if not is_known(host):
                evidence.note(key, LinkError(f"unknown host name {host}"))
                return None
    try:
        return section.open(vehicle)
    except LinkError as error:
        evidence.note(key, error)
        return None


def _ask_radios(config: RunConfig, driver: Driver, opened: Sequence[int]) -> dict[int, RadioQuestions]:
    """Ask the radios that answer, by the index of their link. With keys, the node does not listen to what they say."""
    asked = {}
    for index, channel in zip(opened, driver.channels, strict=True):
        section = config.links[index]
        if section.radio == DRONEBRIDGE and not section.kind.through and config.keys is None:
            send = partial(channel.link.send, target=BROADCAST)
            asked[index] = RadioQuestions(send, driver.agent.peers.writer.frame, partial(_is_open, channel.link))
            channel.link_queue.hear_frame = asked[index].hear
            driver.agent.services.append(asked[index])
    return asked


def _is_open(link: Link) -> bool:
    return not link.trouble


def _open_sensor(config: RunConfig, clock: Clock, evidence: Evidence) -> Sensor | None:
    try:
        return config.sensor.open(clock.now)
    except (ConfigError, LogError) as error:
        evidence.note("sensor", error)
        return None
