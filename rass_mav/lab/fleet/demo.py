"""A base and some drones on a desk. Each is a real `rass-mav run`, as on a drone.

They hear each other over UDP on 127.0.0.1. This process simulates the vehicles, which fly a circle past a radiation
source.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError, SwarmError, os_errors_as
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.ground.feed import Cursor, Feed
from rass_mav.lab.fleet.children import Children
from rass_mav.lab.fleet.ledger import Census
from rass_mav.lab.fleet.running import RunningNode
from rass_mav.lab.fleet.wires import Wire, Wires
from rass_mav.lab.fleet.workplace import workplace
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.lab.swarm.radiation import RadiationField, Source
from rass_mav.link.sockets import bound_socket

#: Node id of the base; the drones follow.
BASE = 1
MAX_DRONES = 16
#: Length of a step, seconds: short, so that the first datum arrives soon.
STEP_S = 0.2
#: The circle: its radius in metres, and seconds for one round.
RADIUS_M = 30.0
ROUND_S = 60.0
#: On the circle, due east; in microsieverts per hour at its place. With this decay it is half as much 7 m away.
SOURCE = Source(RADIUS_M, 0.0, 200.0)
DECAY = 0.02
#: The scale of risk in the drones' configurations, in the same unit.
RISK = {"unit": "usvh", "low": 0.5, "high": 300}
#: Time in which all nodes must be ready, seconds, and the time added for each node.
START_S = 20.0
_START_EACH_S = 2.0
_LOCALHOST = "127.0.0.1"
# Seconds between two messages of an autopilot, and between two looks at the base.
_TICK_S = 0.2
# Looks at the base take at most this part of the time, however much it holds.
_LOOK_SHARE = 0.1


class MockVehicle:
    """Flies a circle, and has a radiation sensor."""

    def __init__(self, node_id: int, phase: float, wires: Wires) -> None:
        """`phase`: where on the circle it begins, radians from due east."""
        self.wire: Wire = wires.new(self._hear, node_id)
        self._autopilot = MockAutopilot(node_id, position_hz=1 / _TICK_S)
        self._phase = phase
        self._field = RadiationField([SOURCE], decay=DECAY)

    def _hear(self, node_id: int, data: bytes) -> None:
        """Ignore frames from the node. The wire records their source; this autopilot answers nothing."""

    def fly(self, now: float) -> None:
        """Send its position and its reading, `now` seconds since the start."""
        angle = self._phase + 2 * math.pi * now / ROUND_S
        x, y = RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)
        for frame in self._autopilot.frames(now, x, y, self._field.level(x, y)):
            self.wire.send(frame)


class Desk:
    """The nodes, from start to end; see `desk`."""

    def __init__(self, drones: int, directory: Path, sockets: Path, children: Children, wires: Wires) -> None:
        """`directory`: for all files. `sockets`: for the control sockets."""
        self.directory = directory
        self.base = RunningNode(BASE, directory, sockets / f"{BASE}.sock", "base")
        ids = range(BASE + 1, BASE + 1 + drones)
        self.drones = [RunningNode(id, directory, sockets / f"{id}.sock", f"drone-{id}") for id in ids]
        self._children = children
        self._wires = wires
        self._vehicles = {id: MockVehicle(id, 2 * math.pi * n / drones, wires) for n, id in enumerate(ids)}
        self._census = Census([node.store for node in self.nodes], 1, STEP_S, first=BASE)
        self._feed = Feed(lambda: Archive(self.base.store))
        self._shown: Cursor | None = None
        """How far the arrivals at the base have been shown."""
        self._begun = self._next_look = self._next_tick = time.monotonic()

    @property
    def nodes(self) -> list[RunningNode]:
        """All of them, the base first."""
        return [self.base, *self.drones]

    def start(self) -> None:
        """Start all nodes, and return when they are ready. Raises `SwarmError`."""
        self.configure()
        for node in self.nodes:
            node.start(self._children)
            self._wires.watch(node.child.file, node.heard)
        within_s = START_S + _START_EACH_S * len(self.nodes)
        deadline = time.monotonic() + within_s
        while missing := [node.name for node in self.nodes if not node.ready]:
            if time.monotonic() > deadline:
                raise SwarmError(f"{', '.join(missing)}: not ready within {within_s:g} s")
            self._turn(deadline)

    def watch(self, until: float, arrived: Callable[[Entry, bytes], None]) -> None:
        """Run until a time of `time.monotonic`. `arrived` is called with each datum that has arrived at the base, and
        with its contents. Raises `SwarmError` if a node ends."""
        while (now := time.monotonic()) < until:
            if now >= self._next_look:
                for entry, content in self._look():
                    arrived(entry, content)
                took = time.monotonic() - now
                self._next_look = now + max(_TICK_S, took / _LOOK_SHARE)
            self._turn(min(until, self._next_look))

    def stop(self) -> dict[str, Any]:
        """Stop all nodes, the base last. Returns what became of the data. Raises `SwarmError` if one does not stop."""
        for nodes in (self.drones, [self.base]):
            for node in nodes:
                node.child.terminate()
            for node in nodes:
                node.child.wait_stopped()
        census = self._census
        census.close(time.time())
        return {
            "drones": len(self.drones),
            "seconds": round(time.monotonic() - self._begun, 1),
            "created": census.created,
            "delivered": census.delivered,
            "held": census.held,
            "lost": census.losses(),
            "altered": census.altered,
        }

    def _turn(self, until: float) -> None:
        """Let the vehicles fly, and read the output of the processes."""
        now = time.monotonic()
        if now >= self._next_tick:
            self._next_tick = now + _TICK_S
            for vehicle in self._vehicles.values():
                vehicle.fly(now - self._begun)
        self._wires.poll(min(until, self._next_tick) - now)

    def _look(self) -> Iterator[tuple[Entry, bytes]]:
        """The data that have arrived since the last look, with their contents."""
        self._census.look_at_bases(time.time())
        with self._feed.look(self._shown) as look:
            for entry, cursor in look.arrivals(second_contents=False):
                self._shown = cursor
                yield entry, look.data.payload(entry.name)

    # -- the configurations --------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Write the configurations, with UDP ports that are free at this moment. Raises `ConfigError`."""
        with contextlib.ExitStack() as stack:
            ports = {}
            for node in self.nodes:
                sock = stack.enter_context(bound_socket(node.name, (_LOCALHOST, 0)))
                ports[node.node_id] = f"{_LOCALHOST}:{sock.getsockname()[1]}"
            for node in self.nodes:
                text = "".join(f"{key}: {_yaml(value)}\n" for key, value in self._sections(node, ports).items())
                with os_errors_as(ConfigError, node.config):
                    node.config.write_text("# Written by `rass-mav try`.\n" + text, encoding="utf-8")

    def _sections(self, node: RunningNode, ports: dict[int, str]) -> dict[str, Any]:
        peers = [{"id": id, "address": address} for id, address in ports.items() if id != node.node_id]
        sections: dict[str, Any] = {
            "node": {"id": node.node_id, "role": "base" if node is self.base else "drone", "step_s": STEP_S},
            "links": [{"type": "udp", "listen": ports[node.node_id], "peers": peers}],
            "store": {"path": str(node.store)},
            "control": {"socket": str(node.socket)},
        }
        if node is not self.base:
            vehicle = self._vehicles[node.node_id].wire
            sections |= {"autopilot": {"url": f"udpout:{_LOCALHOST}:{vehicle.port}"}, "risk": RISK}
        return sections


def _yaml(value: Any) -> str:
    """On one line: JSON is YAML."""
    return json.dumps(value, ensure_ascii=False)


@contextlib.contextmanager
def desk(drones: int, keep: Path | None) -> Iterator[Desk]:
    """A base and a number of drones, running. No process and no temporary directory outlives the block.

    `keep`: a directory, new or empty, for configurations, stores and logs; None: a temporary one.

    Raises `ConfigError`: too many drones, a directory that cannot be used; `SwarmError`: a node that does not start.
    """
    if not 1 <= drones <= MAX_DRONES:
        raise ConfigError(f"--drones: expected 1 to {MAX_DRONES}, got {drones}")
    with workplace(keep) as (directory, sockets, children), contextlib.closing(Wires()) as wires:
        nodes = Desk(drones, directory, sockets, children, wires)
        nodes.start()
        yield nodes
