"""The mock swarm as real processes in real time: one `rass-mav run` a node, one for the radio, UDP between them.

docs/contribute/sitl-and-replay.md describes what this shows that virtual time cannot, and how each figure is obtained.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import random
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec

from rass_mav.agent.settings import AgentSettings
from rass_mav.app.config import (
    MAX_SOCKET_PATH,
    AutopilotSection,
    ControlSection,
    NodeSection,
    RunConfig,
    RunDataSettings,
    RunStoreSettings,
)
from rass_mav.config.keys import KeysSection
from rass_mav.config.loading import dump_yaml
from rass_mav.errors import ConfigError
from rass_mav.lab.fleet.air_server import AirOrder, Figures, Ports
from rass_mav.lab.fleet.children import Child, Children, workplace
from rass_mav.lab.fleet.fleet import START_S, Autopilots, Fleet, NodeProcess
from rass_mav.lab.fleet.wires import LOCALHOST
from rass_mav.lab.swarm.mission import write_files
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.statistics import Stopwatch, count_loops, rate, spread
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.link.settings import LinkSection, PeerSection

log = logging.getLogger(__name__)

#: More processes than this test nothing but the machine.
MAX_NODES = 64
#: Kept configurations listen on ports from here on, below those that systems assign themselves.
KEPT_PORT = 14600
# Each directory has one of so many ranges of `MAX_NODES` ports.
_KEPT_RANGES = 128
#: The time that data in transit get to arrive after the scenario's steps, seconds, at least.
DRAIN_S = 10.0
# Further steps for each node: with loss, a hop takes more than one.
_DRAIN_STEPS_A_NODE = 5
# Seconds between two looks at the drones' stores and next hops.
_SAMPLE_S = 1.0


class AirAutopilots(Autopilots):
    """The process that simulates the air, and with it a mock flight controller for each node."""

    name = "udp"
    """The transport in the summary."""
    module = "rass_mav.lab.fleet.air_server"
    """What the process runs."""

    def __init__(self, scenario: Scenario, record: Path | None) -> None:
        """`record`: a .tlog of all frames put on the air."""
        self.order = AirOrder(scenario, None if record is None else str(record.absolute()))
        self.ports: Ports
        self.figures = Figures()
        """After `stop`."""
        self.directory: Path
        self.children: Children
        self._air: Child

    def start(self, directory: Path, children: Children) -> None:
        """Start the process."""
        self.directory, self.children = directory, children
        self._air = self.process("radio", self.module, self.order)
        self.ports = msgspec.json.decode(self._air.wait_line(START_S), type=Ports)

    def process(self, name: str, module: str, order: msgspec.Struct, heard: Callable[[], None] | None = None) -> Child:
        """Start a module that reads its order from a file; `heard`: see `Children.start`."""
        path = self.directory / f"{name}.json"
        path.write_bytes(msgspec.json.encode(order))
        return self.children.start(name, ["-m", module, str(path)], self.directory / f"{name}.log", heard)

    def url(self, node_id: int) -> str | None:
        """Where a node finds its autopilot; None: it has none."""
        return f"udpout:{LOCALHOST}:{self.ports.vehicle[node_id]}"

    def link(self, node_id: int) -> LinkSection:
        """A node's link to its neighbours."""
        # The node sends first, from any free port: so the radio learns its address, and no port can be in use.
        radio = PeerSection(address=f"{LOCALHOST}:{self.ports.air[node_id]}")
        return LinkSection(listen=f"{LOCALHOST}:0", peers=(radio,), data="broadcast")

    def set_off(self) -> None:
        """The mock world starts."""
        self.tell("start")

    def tell(self, order: str) -> None:
        """Give the air an order (see `air_server`)."""
        self._air.tell(order)

    def stop(self) -> None:
        """End the process, and read its figures."""
        self.tell("stop")
        self.figures = msgspec.json.decode(self._air.wait_line(START_S), type=Figures)
        self._air.wait_stopped()

    def summary(self, fleet: Fleet) -> dict[str, Any]:
        """What the summary says beside what every swarm of processes does."""
        return {}


class ScenarioFleet(Fleet):
    """A scenario as processes; see `run`."""

    autopilots: AirAutopilots

    def __init__(
        self, scenario: Scenario, directory: Path, sockets: Path, children: Children, autopilots: AirAutopilots
    ) -> None:
        """`directory`: for all files. `sockets`: for the control sockets."""
        nodes = [NodeProcess(n, directory, sockets / f"{n}.sock", f"node-{n}") for n in range(scenario.nodes)]
        super().__init__(nodes, scenario.bases, scenario.node.step_s, directory, children, autopilots)
        self._scenario = scenario
        self._keys = write_files(scenario, directory)
        self._until = scenario.steps if scenario.data.until_step is None else scenario.data.until_step
        self._until = min(self._until, scenario.steps)
        self._configs: dict[int, RunConfig] = {}
        self._kill_rng = random.Random(f"{scenario.seed}:kills")
        self._next_kill = self._next_sample = 0.0
        self._loops = 0
        self.kills = 0
        """Processes killed with SIGKILL and started again."""

    # -- configurations ------------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Write the nodes' configurations. Raises `ConfigError`."""
        for node in self.nodes:
            settings = self._scenario.agent_settings(node.node_id)
            node.without = settings.without
            url, link = self.autopilots.url(node.node_id), self.autopilots.link(node.node_id)
            self._write(node, configuration(node, settings, url, link, self._until, self._keys[node.node_id]))

    def _write(self, node: NodeProcess, config: RunConfig) -> None:
        self._configs[node.node_id] = config
        config.check()
        node.config.write_text(dump_yaml(config), encoding="utf-8")

    def bequeath(self) -> None:
        """Leave configurations that can be run again later, when there is neither radio nor autopilot, of all nodes
        that have had one. The nodes then hear each other directly."""
        # Swarms that were kept in two directories can be run at the same time.
        begin = KEPT_PORT + zlib.crc32(os.fsencode(self.directory)) % _KEPT_RANGES * MAX_NODES
        addresses = {node.node_id: f"{LOCALHOST}:{port}" for port, node in enumerate(self.nodes, begin)}
        for node in self.nodes:
            if (config := self._configs.get(node.node_id)) is None:
                continue
            listen = addresses[node.node_id]
            peers = tuple(PeerSection(address=a, id=n) for n, a in addresses.items() if n != node.node_id)
            socket = node.store.with_suffix(".sock")
            if len(os.fsencode(socket)) > MAX_SOCKET_PATH:
                socket = Path(tempfile.gettempdir(), f"rass-{listen.rpartition(':')[2]}.sock")
            links = (LinkSection(listen=listen, peers=peers),)
            control = ControlSection(socket=str(socket))
            self._write(node, replace(config, autopilot=AutopilotSection(), links=links, control=control))

    # -- the phases ----------------------------------------------------------------------------------------------------

    def fly(self, progress: Callable[[int], None] | None) -> None:
        """Run the scenario's steps, in real time, with its failures."""
        every = self._scenario.failures.kill_every_s
        self._next_kill = math.inf if every is None or not self.drones else self.begun + every

        def show(now: float) -> None:
            if progress is not None:
                progress(int((now - self.begun) / self._step_s))

        self.run(self.begun + self._scenario.steps * self._step_s, show)

    def _fail(self, now: float) -> float:
        """SIGKILL for a drone, and a new life on the same store at once."""
        if now >= self._next_kill:
            self._next_kill += self._scenario.failures.kill_every_s or 0.0
            node = self._kill_rng.choice(self.drones)
            log.info("killing node %d", node.node_id)
            self._children.kill(node.child)
            node.hang_up()
            self.autopilots.tell(f"off {node.node_id}")
            # The new life counts its steps from 0 again; it creates data as long as the others do.
            gone = int((time.monotonic() - self.begun) / self._step_s)
            config = self._configs[node.node_id]
            until = max(0, self._until - gone)
            self._write(node, replace(config, data=replace(config.data, until_step=until)))
            node.start(self._children)
            self.kills += 1
        return self._next_kill

    def _look(self, now: float) -> None:
        """Also look at the drones and their next hops, about once a second."""
        if now >= self._next_sample:
            self._next_sample = now + _SAMPLE_S
            self.ledger.sample()
            before = self._ask_all()
            if count_loops(before):
                # Not all were asked at the same moment. A next hop that is the same before and after was the same in
                # between.
                after = self._ask_all()
                self._loops += count_loops([b if b == a else None for b, a in zip(before, after, strict=True)])
        super()._look(now)

    def _ask_all(self) -> list[int | None]:
        """Ask all nodes for their status. Returns their next hops; None also for a node that is just starting."""
        return [node.ask() if node.ready else None for node in self.nodes]

    def drain(self) -> None:
        """Let data in transit arrive, until all have or nothing is left; at most `DRAIN_S` and some steps."""
        deadline = time.monotonic() + DRAIN_S + _DRAIN_STEPS_A_NODE * self._scenario.nodes * self._step_s
        complete = 0
        # Twice in a row: what was created in the last step may not have been durable yet at the first look.
        while complete < 2 and (now := time.monotonic()) < deadline:
            self._ask_all()
            self.ledger.look_at_all(self._clock.now())
            done = not any(map(self._creates, self.drones)) and (
                self.ledger.complete or all(node.status and not node.status["store"]["items"] for node in self.drones)
            )
            complete = complete + 1 if done else 0
            self._children.wait(min(deadline, now + max(self._step_s, 0.1)))

    def _creates(self, node: NodeProcess) -> bool:
        """Whether a node may still create data, as of its last status."""
        return not node.status or node.status["steps"] < (self._configs[node.node_id].data.until_step or 0)

    def stop(self) -> None:
        """End everything, and read the ledger."""
        self._ask_all()
        self.hang_up()
        super().stop()

    # -- the end -------------------------------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """What `swarm --json` prints, except the wall times (docs/contribute/sitl-and-replay.md)."""
        scenario, ledger, radio = self._scenario, self.ledger, self.autopilots.figures
        created = ledger.created
        room = len(self.drones) * ledger.samples * scenario.store.most_items
        return {
            "nodes": scenario.nodes,
            "bases": scenario.bases,
            "steps": scenario.steps,
            "seed": scenario.seed,
            "policy": scenario.policy.name,
            "topology": scenario.topology,
            **ledger.figures(),
            "delay_steps": spread(list(ledger.delays.values())),
            "hops": spread(list(ledger.hops.values())),
            "memory_used_percent": round(100 * ledger.stored / room, 4) if room else 0.0,
            "copies_mean": round(ledger.waiting_copies / ledger.waiting, 4) if ledger.waiting else 0.0,
            "transmissions_per_datum": round(radio.data_sent / created, 4) if created else 0.0,
            "frames": {
                "sent": radio.sent,
                "received": radio.received,
                "dropped": radio.dropped,
                "malformed": radio.malformed + sum(node.total("malformed") for node in self.nodes),
            },
            "bytes_sent": radio.bytes_sent,
            "bytes_per_node_s": rate(radio.bytes_sent, scenario.nodes, scenario.steps * scenario.node.step_s),
            "air_sha256": radio.sha256,
            "routing": {"max_hop_count": radio.max_hop_count, "loops": self._loops},
            "transport": {
                "name": self.autopilots.name,
                "corruption": False,
                "kills": self.kills,
                "heartbeats": radio.heartbeats,
                "late_steps": radio.late_steps,
                "skipped_steps": sum(node.total("skipped_steps") for node in self.nodes),
                "samples": ledger.samples,
            },
            **self.autopilots.summary(self),
        }


def configuration(
    node: NodeProcess, settings: AgentSettings, url: str | None, link: LinkSection, until_step: int,
    keys: KeysSection | None,
) -> RunConfig:  # fmt: skip
    """The configuration of a node of a scenario.

    `url`: of its autopilot. `until_step`: steps in which it creates data.
    """
    return RunConfig(
        node=NodeSection(
            id=node.node_id,
            role="base" if settings.base else "drone",
            step_s=settings.step_s,
            forward=settings.forward,
        ),
        autopilot=AutopilotSection(url=url),
        links=(link,),
        policy=settings.policy,
        risk=settings.risk,
        routing=settings.routing,
        custody=settings.custody,
        store=RunStoreSettings(**{**asdict(settings.store), "path": str(node.store)}),
        data=RunDataSettings(**{**asdict(settings.data), "until_step": until_step}),
        mavlink=settings.mavlink,
        keys=keys,
        control=ControlSection(socket=str(node.socket)),
    )


def run(
    scenario: Scenario,
    *,
    keep: Path | None = None,
    record: Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Run a scenario as processes, in real time, and return its summary.

    Takes `steps` * `node.step_s` seconds, some for the start and, at the end, up to `DRAIN_S` and a few steps for each
    node until all data have arrived. On Linux and other POSIX systems; in the main thread SIGTERM is handled too.

    `keep`: a directory, new or empty, for configurations, stores and logs; None: a temporary one. `record`: a .tlog of
    all frames put on the air. `progress` is called with the present step.

    Raises `ConfigError`: more than `MAX_NODES` nodes, failures that only virtual time has, a swarm that cannot be
    placed, a directory that cannot be used; `SwarmError`: a process that ended unexpectedly, with the last lines of its
    log; `StoreError`: a store that cannot be read.
    """
    if scenario.nodes > MAX_NODES:
        raise ConfigError(f"nodes: expected at most {MAX_NODES} with transport udp, got {scenario.nodes}")
    for key in scenario.failures.of_robots:
        raise ConfigError(f"failures.{key}: needs transport loopback; udp supports only failures.kill_every_s")
    Surroundings(scenario)  # `Surroundings(scenario)` reports here, and not in the radio process, what cannot be placed
    return conduct(scenario, AirAutopilots(scenario, record), keep, progress)


def conduct(
    scenario: Scenario, autopilots: AirAutopilots, keep: Path | None, progress: Callable[[int], None] | None
) -> dict[str, Any]:
    """Start a fleet, let it run, and end it in any case. The rest as in `run`."""
    watch = Stopwatch()
    with contextlib.ExitStack() as stack:
        directory, sockets, children = stack.enter_context(workplace(keep))
        fleet = ScenarioFleet(scenario, directory, sockets, children, autopilots)
        if keep is not None:
            stack.callback(fleet.bequeath)
        stack.callback(fleet.hang_up)
        fleet.start()
        fleet.fly(progress)
        fleet.drain()
        fleet.stop()
        summary = fleet.summary()
    # All processes have ended, so that their time is known.
    return {**summary, **watch.figures(scenario.nodes * scenario.steps)}
