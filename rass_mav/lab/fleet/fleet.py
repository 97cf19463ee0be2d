"""A fleet: nodes as processes of their own, from start to end, with their autopilots.

Each node is a real `rass-mav run`, as on a drone. `try` (`demo`), `swarm --transport udp` (`processes`) and `sitl` have
a fleet each.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

from rass_mav.app.client import ControlClient
from rass_mav.app.clock import Clock
from rass_mav.app.jsonlines import load_line
from rass_mav.core.settings import Mechanism
from rass_mav.errors import ControlError
from rass_mav.lab.fleet.children import Child, Children
from rass_mav.lab.fleet.ledger import StoreLedger

#: Time in which all processes must be ready, seconds, and the time added for each node.
START_S = 20.0
_START_EACH_S = 2.0
# The longest time that an answer of a node may take, seconds.
_ANSWER_S = 5.0
# Looks at the stores take at most this part of the time, however much they hold.
_LOOK_SHARE = 0.1


class NodeProcess:
    """One node: its files, its process, and its last status."""

    def __init__(self, node_id: int, directory: Path, socket: Path, stem: str) -> None:
        """`directory`: for configuration, store and log, whose names begin with `stem`. `socket`: of the control
        socket, at most 107 bytes."""
        self.node_id = node_id
        self.name = f"node {node_id}"
        self.config = directory / f"{stem}.yaml"
        self.store = directory / f"{stem}.db"
        self.log = directory / f"{stem}.log"
        self.socket = socket
        self.without: tuple[Mechanism, ...] = ()
        """Mechanisms that it does not have."""
        self.ready = False
        self.child: Child
        self.status: dict[str, Any] = {}
        """Last answer to `status` in this life."""
        self._earlier = {"malformed": 0, "skipped_steps": 0}
        """Sums over earlier lives, as far as they were read."""
        self._client: ControlClient | None = None

    def start(self, children: Children) -> None:
        """Start the process, with the configuration that has been written. The node runs when it is `ready`."""
        self.ready = False
        arguments = ["-m", "rass_mav.lab.fleet.tether", "run", str(self.config), "--json"]
        if self.without:
            arguments = ["-m", "rass_mav.lab.fleet.node", str(self.config), *self.without]
        self.child = children.start(self.name, arguments, self.log, self.heard)

    def heard(self) -> None:
        """Read its stdout: the line that reports it ready, or the end. Raises `SwarmError`."""
        self.child.read()
        line = self.child.next_line()
        if line is not None:
            # If it could not start, it reports the reason on stderr too, and the end of its output follows.
            self.ready = "error" not in load_line(line)

    def ask(self) -> int | None:
        """Ask for its status. Returns its next hop. Raises `SwarmError`, also if a frame hit a fault in the node."""
        try:
            if self._client is None:
                self._client = ControlClient(self.socket, timeout_s=_ANSWER_S)
            self.status = self._client.ask("status")["status"]
        except ControlError as error:
            raise self.child.failed(str(error)) from error
        if self.status["faults"]["count"]:
            raise self.child.failed("a frame triggered a fault in this program, see its log")
        next_hop: int | None = self.status["next_hop"]
        return next_hop

    def total(self, key: str) -> int:
        """A figure of `status`, summed over all lives."""
        return int(self._earlier[key] + self.status.get(key, 0))

    def hang_up(self) -> None:
        """End the connection: the life is over."""
        for key in self._earlier:
            self._earlier[key] = self.total(key)
        self.status = {}
        if self._client is not None:
            self._client.close()
            self._client = None


class Autopilots:
    """What is at the other end of the nodes' cables: here none; mock vehicles or SITL in subclasses."""

    def start(self, directory: Path, children: Children) -> None:
        """Start them; nodes can be wired to them afterwards. `directory`: for their files. Raises `SwarmError`."""

    def set_off(self) -> None:
        """All nodes are ready: the world begins. Returns when it has."""

    def url(self, node_id: int) -> str | None:
        """Where a node finds its autopilot; None: it has none."""
        return None

    def tick(self, now: float) -> float:
        """Do what is due at a time of `time.monotonic`. Returns when to come again; infinity: never."""
        return inf

    def stop(self) -> None:
        """End them, after the nodes. Raises `SwarmError`."""


class Fleet:
    """Nodes, their autopilots and their ledger. Subclasses know what the nodes' configurations are."""

    def __init__(
        self, nodes: Sequence[NodeProcess], bases: int, step_s: float, directory: Path, children: Children,
        autopilots: Autopilots,
    ) -> None:  # fmt: skip
        """`nodes`: in the order of their ids; the first ones are `bases`. `directory`: for all files."""
        self.directory = directory
        self.nodes = nodes
        self.bases, self.drones = nodes[:bases], nodes[bases:]
        self.autopilots = autopilots
        self.ledger = StoreLedger([node.store for node in nodes], bases, step_s, first=nodes[0].node_id)
        self.begun = 0.0
        """When all were ready, as a time of `time.monotonic`."""
        self._step_s = step_s
        self._children = children
        self._clock = Clock(time.time())
        self._next_look = 0.0

    def configure(self) -> None:
        """Write the nodes' configurations. Raises `ConfigError`."""

    def start(self) -> None:
        """Start autopilots and nodes. Returns when all are ready and the world runs. Raises `SwarmError`."""
        self.autopilots.start(self.directory, self._children)
        self.configure()
        for node in self.nodes:
            node.start(self._children)
        self._children.wait_for(
            lambda: [node.name for node in self.nodes if not node.ready],
            START_S + _START_EACH_S * len(self.nodes),
            self.autopilots.tick,
        )
        self.autopilots.set_off()
        self.begun = time.monotonic()

    def run(self, until: float, progress: Callable[[float], None] | None = None) -> None:
        """Run until a time of `time.monotonic`. `progress` is called with the present time. Raises `SwarmError` if a
        process ends."""
        while (now := time.monotonic()) < until:
            due = min(self.autopilots.tick(now), self._fail(now))
            if now >= self._next_look:
                begun = time.monotonic()
                self._look(now)
                took = time.monotonic() - begun
                self._next_look = max(self._next_look + self._step_s, begun + took / _LOOK_SHARE)
            if progress is not None:
                progress(now)
            self._children.wait(min(until, due, self._next_look))

    def _fail(self, now: float) -> float:
        """Let fail what is due at `now`. Returns when to come again; infinity: never."""
        return inf

    def _look(self, now: float) -> None:
        """About once a step: record what has arrived."""
        self.ledger.look_at_bases(self._clock.now())

    def stop(self) -> None:
        """End the nodes with SIGTERM, the bases last, then the autopilots, and read the ledger.

        Raises `SwarmError` if one does not end.
        """
        for nodes in (self.drones, self.bases):
            for node in nodes:
                node.child.terminate()
            for node in nodes:
                node.child.wait_stopped()
        self.autopilots.stop()
        self.ledger.close(self._clock.now())

    def hang_up(self) -> None:
        """Close all connections to nodes."""
        for node in self.nodes:
            node.hang_up()
