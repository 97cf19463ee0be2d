"""The mock swarm as real processes in real time: one `rass-mav run` a node, one for the radio, UDP between them.

docs/simulation-udp.md describes what this shows that virtual time cannot, and how each figure is obtained.
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
from typing import Any, TypeVar

import msgspec

from rass_mav.agent.settings import AgentSettings
from rass_mav.app.client import ControlClient
from rass_mav.app.clock import Clock
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
from rass_mav.core.settings import Mechanism
from rass_mav.errors import ConfigError, ControlError, SwarmError
from rass_mav.lab.fleet.air_server import AirOrder, Figures, Ports
from rass_mav.lab.fleet.children import Child, Children
from rass_mav.lab.fleet.ledger import Census
from rass_mav.lab.fleet.running import RunningNode
from rass_mav.lab.fleet.workplace import workplace
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
#: Until a process has to be ready, seconds; the nodes get some more for each of them.
START_S = 20.0
_START_EACH_S = 2.0
# Seconds between two looks at the drones' stores and next hops.
_SAMPLE_S = 1.0
# The longest time that an answer of a node may take, seconds.
_ANSWER_S = 5.0
# Looks at the bases' stores take at most this part of the time.
_LOOK_SHARE = 0.1

P = TypeVar("P", bound=Ports)


class NodeProcess(RunningNode):
    """One node of a scenario: its orders, and its last status."""

    def __init__(self, node_id: int, directory: Path, socket: Path) -> None:
        """`directory`: for configuration, store and log. `socket`: of the control socket, at most 107 bytes."""
        super().__init__(node_id, directory, socket, f"node-{node_id}")
        self.until_step = 0
        """Steps in which this life of the node creates data."""
        self.status: dict[str, Any] = {}
        """Last answer to `status` in this life."""
        self.earlier = {"malformed": 0, "skipped_steps": 0}
        """Sums over earlier lives, as far as they were read."""
        self._config: RunConfig
        self._without: tuple[Mechanism, ...] = ()
        self._client: ControlClient | None = None

    def configure(self, scenario: Scenario, ports: Ports, until_step: int, keys: KeysSection | None = None) -> None:
        """Write the configuration of the next life. Raises `ConfigError`."""
        settings = scenario.agent_settings(self.node_id)
        self.until_step = until_step
        self._without = settings.without
        vehicle, link = self._wiring(settings, ports)
        self._config = RunConfig(
            node=NodeSection(
                id=self.node_id,
                role="base" if settings.base else "drone",
                step_s=settings.step_s,
                forward=settings.forward,
            ),
            autopilot=AutopilotSection(url=vehicle),
            links=(link,),
            policy=settings.policy,
            risk=settings.risk,
            routing=settings.routing,
            custody=settings.custody,
            store=RunStoreSettings(**{**asdict(settings.store), "path": str(self.store)}),
            data=RunDataSettings(**{**asdict(settings.data), "until_step": until_step}),
            mavlink=settings.mavlink,
            keys=keys,
            control=ControlSection(socket=str(self.socket)),
        )
        self._write_config()

    def _arguments(self) -> list[str]:
        if self._without:
            return ["-m", "rass_mav.lab.fleet.node", str(self.config), *self._without]
        return super()._arguments()

    def _write_config(self) -> None:
        self._config.check()
        self.config.write_text(dump_yaml(self._config), encoding="utf-8")

    def bequeath(self, ports: range) -> None:
        """Write a configuration with which the node can be run again later, when there is neither radio nor autopilot.

        It hears all nodes of the swarm, which are listened to on these ports by node id.
        """
        peers = [PeerSection(address=f"127.0.0.1:{port}", id=n) for n, port in enumerate(ports)]
        listen = peers.pop(self.node_id).address
        links = (LinkSection(listen=listen, peers=tuple(peers)),) if peers else ()
        socket = self.store.with_suffix(".sock")
        if len(os.fsencode(socket)) > MAX_SOCKET_PATH:
            socket = Path(tempfile.gettempdir(), f"rass-{listen.rpartition(':')[2]}.sock")
        self._config = replace(
            self._config, autopilot=AutopilotSection(), links=links, control=ControlSection(socket=str(socket))
        )
        self._write_config()

    def _wiring(self, settings: AgentSettings, ports: Ports) -> tuple[str | None, LinkSection]:
        """The autopilot's URL, and the link to the neighbours."""
        # The node sends first, from any free port: so the radio learns its address, and no port can be in use.
        radio = PeerSection(address=f"127.0.0.1:{ports.air[self.node_id]}")
        link = LinkSection(listen="127.0.0.1:0", peers=(radio,))
        return f"udpout:127.0.0.1:{ports.vehicle[self.node_id]}", link

    def ask(self) -> int | None:
        """Ask for its status. Returns its next hop. Raises `SwarmError`, also if a frame hit a fault in the node."""
        try:
            if self._client is None:
                self._client = ControlClient(self.socket, timeout_s=_ANSWER_S)
            self.status = self._client.ask("status")["status"]
        except ControlError as error:
            raise self.child.failed(str(error)) from error
        if self.status["faults"]["count"]:
            raise self.child.failed("a frame hit a fault in this program, see its log")
        next_hop: int | None = self.status["next_hop"]
        return next_hop

    def total(self, key: str) -> int:
        """A figure of `status`, summed over all lives."""
        return int(self.earlier[key] + self.status.get(key, 0))

    @property
    def creates(self) -> bool:
        """Whether it may still create data, as of its last status."""
        return not self.status or bool(self.status["steps"] < self.until_step)

    @property
    def empty(self) -> bool:
        """Whether it held nothing at its last status."""
        return bool(self.status) and not self.status["store"]["items"]

    def hang_up(self) -> None:
        """End the connection: the life is over."""
        for key in self.earlier:
            self.earlier[key] = self.total(key)
        self.status = {}
        if self._client is not None:
            self._client.close()
            self._client = None


class ProcessSwarm:
    """A swarm of processes from start to end. `run` does everything; see there."""

    _figures_kind: type[Figures] = Figures

    def __init__(self, scenario: Scenario, directory: Path, sockets: Path, children: Children) -> None:
        """`directory`: where everything is written. `sockets`: where control sockets are."""
        self._scenario = scenario
        self._step_s = scenario.node.step_s
        self._directory = directory
        self._children = children
        self._clock = Clock(time.time())
        self._keys = write_files(scenario, directory)
        self._nodes = [self._node(n, directory, sockets / f"{n}.sock") for n in range(scenario.nodes)]
        self._drones = self._nodes[scenario.bases :]
        self._census = Census([node.store for node in self._nodes], scenario.bases, self._step_s)
        self._kill_rng = random.Random(f"{scenario.seed}:kills")
        self._radio: Child
        self._world: Child
        """The process that advances the world."""
        self._ports: Ports
        self._begun = 0.0
        self._next_look = self._next_sample = 0.0
        self._next_kill = math.inf
        self._loops = 0
        self.kills = 0
        """Processes killed with SIGKILL and started again."""

    def _node(self, node_id: int, directory: Path, socket: Path) -> NodeProcess:
        return NodeProcess(node_id, directory, socket)

    # -- the phases ----------------------------------------------------------------------------------------------------

    def start(self, record: Path | None) -> None:
        """Start the radio, then the nodes; returns when all are ready and the world runs."""
        self._surround(None if record is None else str(record.absolute()))
        until = self._until_step()
        for node in self._nodes:
            node.configure(self._scenario, self._ports, until, self._keys[node.node_id])
            node.start(self._children)
        self._await(
            lambda: [node.name for node in self._nodes if not node.ready], START_S + _START_EACH_S * len(self._nodes)
        )
        self._set_off()
        self._begun = time.monotonic()

    def _set_off(self) -> None:
        """Let the world begin; returns when it has."""
        self._world.tell("start")

    def _surround(self, record: str | None) -> None:
        """Start what the nodes need. `record`: see `AirOrder`."""
        self._ports = self._start_radio("rass_mav.lab.fleet.mock_air", AirOrder(self._scenario, record), Ports)
        self._world = self._radio

    def fly(self, progress: Callable[[int], None] | None) -> None:
        """Run the scenario's steps, in real time, with its failures."""
        every = self._scenario.failures.kill_every_s
        end = self._begun + self._scenario.steps * self._step_s
        if every is not None and self._drones:
            self._next_kill = self._begun + every
        while (now := time.monotonic()) < end:
            next_failure = self._fail(now)
            self._look(now)
            if progress is not None:
                progress(int((now - self._begun) / self._step_s))
            self._children.wait(min(end, next_failure, self._next_look))

    def _fail(self, now: float) -> float:
        """Let happen what is due of the scenario's failures. Returns when to come again; infinity: never."""
        if now >= self._next_kill:
            self._kill(self._kill_rng.choice(self._drones))
            self._next_kill += self._scenario.failures.kill_every_s or 0.0
        return self._next_kill

    def drain(self) -> None:
        """Let data in transit arrive, until all have or nothing is left; at most `DRAIN_S` and some steps."""
        deadline = time.monotonic() + DRAIN_S + _DRAIN_STEPS_A_NODE * self._scenario.nodes * self._step_s
        complete = 0
        # Twice in a row: what was created in the last step may not have been durable yet at the first look.
        while complete < 2 and (now := time.monotonic()) < deadline:
            self._ask_all()
            self._census.look_at_all(self._clock.now())
            done = not any(node.creates for node in self._drones) and (
                self._census.complete or all(node.empty for node in self._drones)
            )
            complete = complete + 1 if done else 0
            self._children.wait(min(deadline, now + max(self._step_s, 0.1)))

    def stop(self) -> Figures:
        """End the nodes with SIGTERM, then the radio, and read the ledger. Raises `SwarmError` for a node that does not
        end."""
        self._ask_all()
        self.hang_up()
        for node in self._nodes:
            node.child.terminate()
        for node in self._nodes:
            node.child.wait_stopped()
        self._radio.tell("stop")
        figures = msgspec.json.decode(self._radio.wait_line(START_S), type=self._figures_kind)
        self._radio.wait_stopped()
        self._census.close(self._clock.now())
        return figures

    def hang_up(self) -> None:
        """Close all connections to nodes."""
        for node in self._nodes:
            node.hang_up()

    def bequeath(self) -> None:
        """Leave configurations that can be run again, of all nodes that have had one."""
        # Swarms that were kept in two directories can be run at the same time.
        begin = KEPT_PORT + zlib.crc32(os.fsencode(self._directory)) % _KEPT_RANGES * MAX_NODES
        for node in self._nodes:
            if node.config.exists():
                node.bequeath(range(begin, begin + len(self._nodes)))

    # -- meanwhile -----------------------------------------------------------------------------------------------------

    def _process(self, name: str, module: str, order: msgspec.Struct, heard: Callable[[], None] | None = None) -> Child:
        """Start a module that reads its order from a file; `heard`: see `Children.start`."""
        path = self._directory / f"{name}.json"
        path.write_bytes(msgspec.json.encode(order))
        return self._children.start(name, ["-m", module, str(path)], self._directory / f"{name}.log", heard)

    def _start_radio(self, module: str, order: AirOrder, kind: type[P]) -> P:
        self._radio = self._process("radio", module, order)
        return msgspec.json.decode(self._radio.wait_line(START_S), type=kind)

    def _await(self, missing: Callable[[], list[str]], within_s: float) -> None:
        """Wait until nothing is missing. Raises `SwarmError` that names what still is."""
        deadline = time.monotonic() + within_s
        while names := missing():
            if time.monotonic() > deadline:
                raise SwarmError(f"{', '.join(names)}: not ready within {within_s:g} s")
            self._children.wait(deadline)

    def _until_step(self) -> int:
        until = self._scenario.data.until_step
        return self._scenario.steps if until is None else min(until, self._scenario.steps)

    def _kill(self, node: NodeProcess) -> None:
        """SIGKILL, and a new life on the same store at once."""
        log.info("killing node %d", node.node_id)
        self._children.kill(node.child)
        node.hang_up()
        self._radio.tell(f"off {node.node_id}")
        # The new life counts its steps from 0 again; it creates data as long as the others do.
        gone = int((time.monotonic() - self._begun) / self._step_s)
        until = max(0, self._until_step() - gone)
        node.configure(self._scenario, self._ports, until, self._keys[node.node_id])
        node.start(self._children)
        self.kills += 1

    def _look(self, now: float) -> None:
        """Check the bases' stores about once a step, and the drones and their next hops about once a second."""
        if now < self._next_look:
            return
        if now >= self._next_sample:
            self._next_sample = now + _SAMPLE_S
            self._sample()
        begun = time.monotonic()
        self._census.look_at_bases(self._clock.now())
        took = time.monotonic() - begun
        self._next_look = max(self._next_look + self._step_s, begun + took / _LOOK_SHARE)

    def _sample(self) -> None:
        self._census.sample()
        before = self._ask_all()
        if count_loops(before):
            # Not all were asked at the same moment. A next hop that is the same before and after was the same in
            # between.
            after = self._ask_all()
            self._loops += count_loops([b if b == a else None for b, a in zip(before, after, strict=True)])

    def _ask_all(self) -> list[int | None]:
        """Ask all nodes for their status. Returns their next hops; None also for a node that is just starting."""
        return [node.ask() if node.ready else None for node in self._nodes]

    # -- the end -------------------------------------------------------------------------------------------------------

    def summary(self, radio: Figures) -> dict[str, Any]:
        """What `swarm --json` prints, except the wall times (docs/simulation-udp.md)."""
        scenario, census = self._scenario, self._census
        created = census.created
        lost = census.losses()
        kept = created - sum(count for fate, count in lost.items() if fate != "vanished")
        room = len(self._drones) * census.samples * scenario.store.most_items
        return {
            "nodes": scenario.nodes,
            "bases": scenario.bases,
            "steps": scenario.steps,
            "seed": scenario.seed,
            "policy": scenario.policy.name,
            "topology": scenario.topology,
            "created": created,
            "delivered": census.delivered,
            "held": census.held,
            "lost": lost,
            "altered": census.altered,
            "reliability": round(kept / created, 6) if created else 1.0,
            "delivered_share": round(census.delivered / created, 6) if created else 1.0,
            "delay_steps": spread(list(census.delays.values())),
            "hops": spread(list(census.hops.values())),
            "memory_used_percent": round(100 * census.stored / room, 4) if room else 0.0,
            "copies_mean": round(census.waiting_copies / census.waiting, 4) if census.waiting else 0.0,
            "transmissions_per_datum": round(radio.data_sent / created, 4) if created else 0.0,
            "frames": {
                "sent": radio.sent,
                "received": radio.received,
                "dropped": radio.dropped,
                "malformed": radio.malformed + sum(node.total("malformed") for node in self._nodes),
            },
            "bytes_sent": radio.bytes_sent,
            "bytes_per_node_s": rate(radio.bytes_sent, scenario.nodes, scenario.steps * scenario.node.step_s),
            "air_sha256": radio.sha256,
            "routing": {"max_hop_count": radio.max_hop_count, "loops": self._loops},
            "transport": {
                "name": "udp",
                "corruption": False,
                "kills": self.kills,
                "heartbeats": radio.heartbeats,
                "late_steps": radio.late_steps,
                "skipped_steps": sum(node.total("skipped_steps") for node in self._nodes),
                "samples": census.samples,
            },
        }


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
    return conduct(scenario, lambda *where: ProcessSwarm(scenario, *where), keep, record, progress)


def conduct(
    scenario: Scenario,
    make: Callable[[Path, Path, Children], ProcessSwarm],
    keep: Path | None,
    record: Path | None,
    progress: Callable[[int], None] | None,
) -> dict[str, Any]:
    """Start a swarm of processes, let it run, and end it in any case. The rest as in `run`.

    `make`: creates the swarm from its directory, that of its control sockets, and its children.
    """
    watch = Stopwatch()
    with contextlib.ExitStack() as stack:
        directory, sockets, children = stack.enter_context(workplace(keep))
        swarm = make(directory, sockets, children)
        if keep is not None:
            stack.callback(swarm.bequeath)
        stack.callback(swarm.hang_up)
        swarm.start(record)
        swarm.fly(progress)
        swarm.drain()
        summary = swarm.summary(swarm.stop())
    # All processes have ended, so that their time is known.
    return {**summary, **watch.figures(scenario.nodes * scenario.steps)}
