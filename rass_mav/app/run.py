"""One node from start to stop: opens store, links and control socket, runs the driver, and closes everything."""

from __future__ import annotations

import asyncio
import logging
import os
import random
import secrets
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.agent.agent import Agent
from rass_mav.config.keys import in_words
from rass_mav.errors import ControlError, StoreCopiedError, StoreDamagedError
from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.base import Link
from rass_mav.link.vehicle import VehiclePort, open_vehicle
from rass_mav.mavlink.messages import CRITICAL
from rass_mav.sensor.base import Sensor
from rass_mav.station.node import build_node
from rass_mav.station.rates import MessageRates, message_ids
from rass_mav.station.shortages import Shortages
from rass_mav.station.version import VersionQuestion
from rass_mav.store.files import beside
from rass_mav.store.sqlite import SqliteStore

from .clock import LivedClock, TimeSources, possible
from .config import RunConfig
from .control import ControlServer
from .driver import Driver
from .machine import Machine
from .notify import Notifier
from .on_demand import FILES, WATCHED, FilesOnDemand

if TYPE_CHECKING:
    from .companion import Companion
    from .keyed import NodeKeys

log = logging.getLogger(__name__)

#: If a store is damaged this often within `LIFE_S` seconds, its disk cannot be used.
MAX_DAMAGES = 3
LIFE_S = 60.0


class Runtime:
    """Runs a node until SIGTERM or SIGINT; a second signal ends the process at once."""

    def __init__(
        self,
        config: RunConfig,
        ready: Callable[[dict[str, Any]], None] | None = None,
        narrate: Callable[[str], None] | None = None,
        *,
        attended: bool = False,
    ) -> None:
        """
        :param ready: called after each start of the node, with its id, role, epoch and control socket.
        :param narrate: prints a line about the node, and one about its keys.
        :param attended: there is a person at a terminal: also a line whenever something that it observes changes.
        """
        self._config = config
        self._ready = ready
        self._narrate = narrate
        self._attended = attended
        self._keys: NodeKeys | None = None
        if config.keys is not None:
            from .keyed import NodeKeys  # with PyNaCl, which a node without keys does not need

            self._keys = NodeKeys(config)
        self._notifier = Notifier.of(os.environ, os.getpid())
        self._stopped = False
        self._driver: Driver | None = None
        self._companion: Companion | None = None
        if config.outlets:
            from .companion import Companion  # most nodes have none

            self._companion = Companion(config)

    def run(self) -> None:
        """Blocking. Raises `RassError`s: a port in use, a store that another node uses, a disk that fails."""
        try:
            asyncio.run(self._main())
        finally:
            if self._companion is not None:
                self._companion.stop()
            self._notifier.close()

    async def _main(self) -> None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._on_signal, number)
        suspect, doubt = False, ""
        damages = 0
        while not self._stopped:
            begun = loop.time()
            try:
                await self._live(suspect, doubt)
            except StoreCopiedError as error:
                log.error("%s; reopening the store, with a new epoch", error)
                doubt = str(error)
            except StoreDamagedError as error:
                damages = damages + 1 if loop.time() - begun < LIFE_S else 1
                if damages >= MAX_DAMAGES:
                    raise
                log.error("%s; reopening the store", error)
                suspect, doubt = True, ""

    def _on_signal(self, number: int) -> None:
        if self._stopped:
            log.error("second signal: exiting at once")
            os._exit(128 + number)
        log.info("signal %d: stopping", number)
        self._stopped = True
        self._notifier.stopping()
        if self._driver is not None:
            self._driver.stop()

    async def _live(self, suspect: bool, doubt: str) -> None:
        """One life: until the node is stopped, or its store is found damaged."""
        config, keys = self._config, self._keys
        settings = config.agent_settings()
        async with AsyncExitStack() as stack:
            store = SqliteStore.open(
                config.store_path,
                node_id=settings.node_id,
                draw_epoch=lambda: secrets.randbits(32),
                quota_bytes=settings.store.quota_bytes,
                suspect=suspect,
                doubt=doubt,
            )
            stack.callback(store.abandon)  # does nothing after `close`
            clock = LivedClock(store, _sources(config))
            if not clock.off_known:
                log.warning("it is unknown how long the node was off: the ages of its data are lower bounds")
            vehicle, ground = (_opened(url, stack) for url in (config.autopilot.url, config.ground.url))
            links: list[Link] = []
            for section in config.links:
                links.append(section.open(vehicle))
                stack.callback(links[-1].close)
            for warning in config.warnings():
                log.warning("%s", warning)
            # One thread: one write at a time.
            executor = stack.enter_context(ThreadPoolExecutor(1, "store"))
            rng = random.Random(secrets.randbits(128))
            trust = None if keys is None else keys.trust
            agent = build_node(
                settings, store, rng, now=clock.now(), forgiving=True, keys=trust,
                computer=Machine(config.store_path).status,
            )  # fmt: skip
            if keys is not None:
                keys.join(agent, vehicle, executor)
            if store.report.reason:
                log.error("%s: %s", config.store_path, store.report.reason)
            for remark in store.report.remarks:
                agent.tell_ground(CRITICAL, f"RASS: {remark}")
            sensor = config.sensor.open(clock.now)
            if sensor is not None:
                stack.callback(sensor.close)
            self._equip(agent, vehicle, sensor, clock.now())
            driver = Driver(agent, links, vehicle, clock.now, executor, rng, sensor, ground=ground, lived=clock)
            driver.notifier = self._notifier
            if keys is not None:
                keys.watch_numbers(driver)
            files = FilesOnDemand(driver, beside(config.store_path, FILES), config.data.part_bytes)
            stack.callback(files.close)
            if config.watch is not None:
                watched = beside(config.store_path, WATCHED)
                files.watch(Path(config.watch.folder), config.watch.settle_s, watched)
            control = ControlServer(driver, config.socket_path, files, self._around, config.sensor)
            try:
                await control.start()
            except ControlError as error:
                # By default the socket is beside the store.
                if not store.report.unwritable:
                    raise
                log.error("%s; this node cannot be queried", error)
            self._driver = driver
            if self._stopped:
                driver.stop()
            self._announce(store, vehicle, links)
            try:
                try:
                    with files.running():
                        await driver.run()
                finally:
                    await control.close()
            except StoreDamagedError:
                raise
            except BaseException:
                # Save what can be saved, whatever the error.
                clock.note()
                self._close(store)
                raise
            self._close(store)

    def _close(self, store: SqliteStore) -> None:
        if self._keys is not None:
            self._keys.note()
        store.close()

    def _around(self) -> dict[str, Any]:
        """For `status`, what the driver does not know."""
        keys, driver = self._keys, self._driver
        key_updates = None if keys is None or driver is None else keys.key_updates(driver.now())
        outputs = None if self._companion is None else self._companion.report()
        return {"keys": None if keys is None else keys.about(), "key_updates": key_updates, "outputs": outputs}

    def _announce(self, store: SqliteStore, vehicle: VehiclePort | None, links: Sequence[Link]) -> None:
        if self._companion is not None:
            self._companion.start()
        config = self._config
        node_id, role = config.agent_settings().node_id, config.node.role
        log.info("node %d (%s) is running, store %s", node_id, role, config.store_path)
        keys = in_words(None if self._keys is None else self._keys.about())
        log.info("%s", keys)
        self._notifier.ready(f"node {node_id} ({role})")
        if self._narrate is not None:
            ending = "; Ctrl-C stops it" if self._attended else ""
            self._narrate(_introduction(config, vehicle, links) + ending)
            self._narrate(keys)
        if self._ready is not None:
            about = {"node_id": node_id, "role": role, "life": f"{store.life:08x}", "epoch": f"{store.epoch:08x}"}
            self._ready({**about, "socket": str(config.socket_path)})

    def _equip(self, agent: Agent, vehicle: VehiclePort | None, sensor: Sensor | None, now: float) -> None:
        """Ask the autopilot for what the node needs of it, and report changes to people, at the ground station and on
        the terminal."""
        config = self._config
        if vehicle is not None:
            agent.services.append(VersionQuestion(agent))
        if vehicle is not None and config.autopilot.messages:
            rates = MessageRates(agent, message_ids(config.autopilot.messages))
            agent.listeners.append(rates)
            agent.services.append(rates)
        flies = vehicle is not None and not agent.node.base
        reads = flies or config.sensor.own
        agent.services.append(
            Shortages(
                agent, now, position=flies, reading=reads,
                trouble=lambda: self._why_unread(sensor),
            )
        )  # fmt: skip
        if self._narrate is not None and self._attended:
            from .narration import Narration  # most nodes have nobody at a terminal

            agent.services.append(Narration(agent, self._narrate, now, autopilot=vehicle is not None, reading=reads))

    def _why_unread(self, sensor: Sensor | None) -> str:
        """Why there are no readings; empty: nobody knows."""
        if self._config.sensor.kind.handed_in:
            return "no program submits readings"
        return "" if sensor is None else sensor.state().trouble


def _introduction(config: RunConfig, vehicle: VehiclePort | None, links: Sequence[Link]) -> str:
    """One line that describes the node."""
    parts = [] if vehicle is None else [f"autopilot {vehicle.name}"]
    parts.append(f"{'links' if len(links) > 1 else 'link'} {', '.join(link.name for link in links) or 'none'}")
    parts.append(f"store {config.store_path}")
    return f"node {config.node_id} ({config.node.role}): {', '.join(parts)}"


def _sources(config: RunConfig) -> TimeSources:
    """This computer's sources of time, with the configured trust in its date."""
    if config.node.clock == "auto":
        return TimeSources()
    return TimeSources(trusted=lambda: config.node.clock == "trusted" and possible())


def _opened(url: str | None, stack: AsyncExitStack) -> VehiclePort | None:
    """Open the port of a connection string; None: there is none. The `stack` closes it."""
    if url is None:
        return None
    port = open_vehicle(parse_vehicle_url(url))
    stack.callback(port.close)
    return port
