"""A base and some drones on this machine, for `rass-mav try`.

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

from rass_mav.errors import ConfigError, os_errors_as
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.ground.feed import Cursor, Feed
from rass_mav.lab.fleet.children import Children, workplace
from rass_mav.lab.fleet.fleet import Autopilots, Fleet, NodeProcess
from rass_mav.lab.fleet.wires import LOCALHOST, Wire
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
# Seconds between two messages of an autopilot.
_TICK_S = 0.2


class MockVehicles(Autopilots):
    """Vehicles that fly a circle, one behind the other, each with a radiation sensor."""

    def __init__(self, drones: range) -> None:
        """`drones`: their node ids; the first one begins due east."""
        self._wires = {id: Wire(self._hear, id) for id in drones}
        self._autopilots = {id: MockAutopilot(id, position_hz=1 / _TICK_S) for id in drones}
        self._phases = {id: 2 * math.pi * n / len(drones) for n, id in enumerate(drones)}
        self._field = RadiationField([SOURCE], decay=DECAY)
        self._begun = self._next_tick = time.monotonic()

    def _hear(self, node_id: int, data: bytes) -> None:
        """Ignore frames from the node. The wire records their source; this autopilot answers nothing."""

    def start(self, directory: Path, children: Children) -> None:
        """They hear their nodes while the fleet waits."""
        for wire in self._wires.values():
            children.watch(wire.sock, wire.read)

    def url(self, node_id: int) -> str | None:
        """Where a node finds its autopilot; None: it has none."""
        wire = self._wires.get(node_id)
        return None if wire is None else f"udpout:{LOCALHOST}:{wire.port}"

    def tick(self, now: float) -> float:
        """Send what is due."""
        if now >= self._next_tick:
            self._next_tick = now + _TICK_S
            self.fly(now - self._begun)
        return self._next_tick

    def fly(self, seconds: float) -> None:
        """Send each vehicle's position and reading, so many seconds after the start."""
        for id, wire in self._wires.items():
            angle = self._phases[id] + 2 * math.pi * seconds / ROUND_S
            x, y = RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)
            for frame in self._autopilots[id].frames(seconds, x, y, self._field.level(x, y)):
                wire.send(frame)

    def close(self) -> None:
        """Release the sockets."""
        for wire in self._wires.values():
            wire.sock.close()


class Demo(Fleet):
    """The nodes of a demo; see `demo`."""

    def __init__(
        self, drones: int, directory: Path, sockets: Path, children: Children, vehicles: MockVehicles,
        arrived: Callable[[Entry, bytes], None],
    ) -> None:  # fmt: skip
        """`directory`: for all files. `sockets`: for the control sockets. `arrived` is called with each datum that has
        arrived at the base, and with its contents."""
        ids = range(BASE, BASE + 1 + drones)
        nodes = [
            NodeProcess(id, directory, sockets / f"{id}.sock", "base" if id == BASE else f"drone-{id}") for id in ids
        ]
        super().__init__(nodes, 1, STEP_S, directory, children, vehicles)
        self._show = arrived
        self._feed = Feed(lambda: Archive(self.bases[0].store))
        self._shown: Cursor | None = None
        """How far the arrivals at the base have been shown."""

    def _look(self, now: float) -> None:
        super()._look(now)
        with self._feed.look(self._shown) as look:
            for entry, cursor in look.arrivals(second_contents=False):
                self._shown = cursor
                self._show(entry, look.data.payload(entry.name))

    def summary(self) -> dict[str, Any]:
        """What became of the data."""
        seconds = round(time.monotonic() - self.begun, 1)
        return {"drones": len(self.drones), "seconds": seconds, **self.ledger.figures()}

    def configure(self) -> None:
        """Write the configurations, with UDP ports that are free at this moment. Raises `ConfigError`."""
        with contextlib.ExitStack() as stack:
            ports = {}
            for node in self.nodes:
                sock = stack.enter_context(bound_socket(node.name, (LOCALHOST, 0)))
                ports[node.node_id] = f"{LOCALHOST}:{sock.getsockname()[1]}"
            for node in self.nodes:
                # JSON is YAML.
                sections = self._sections(node, ports).items()
                text = "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in sections)
                with os_errors_as(ConfigError, node.config):
                    node.config.write_text("# Written by `rass-mav try`.\n" + text, encoding="utf-8")

    def _sections(self, node: NodeProcess, ports: dict[int, str]) -> dict[str, Any]:
        peers = [{"id": id, "address": address} for id, address in ports.items() if id != node.node_id]
        sections: dict[str, Any] = {
            "node": {"id": node.node_id, "role": "base" if node in self.bases else "drone", "step_s": STEP_S},
            "links": [{"type": "udp", "listen": ports[node.node_id], "peers": peers}],
            "store": {"path": str(node.store)},
            "control": {"socket": str(node.socket)},
        }
        if (url := self.autopilots.url(node.node_id)) is not None:
            sections |= {"autopilot": {"url": url}, "risk": RISK}
        return sections


@contextlib.contextmanager
def demo(drones: int, keep: Path | None, arrived: Callable[[Entry, bytes], None]) -> Iterator[Demo]:
    """A base and a number of drones, running. No process and no temporary directory outlives the block.

    `keep`: a directory, new or empty, for configurations, stores and logs; None: a temporary one. `arrived`: see
    `Demo`.

    Raises `ConfigError`: too many drones, a directory that cannot be used; `SwarmError`: a node that does not start.
    """
    if not 1 <= drones <= MAX_DRONES:
        raise ConfigError(f"--drones: expected 1 to {MAX_DRONES}, got {drones}")
    with (
        workplace(keep) as (directory, sockets, children),
        contextlib.closing(MockVehicles(range(BASE + 1, BASE + 1 + drones))) as vehicles,
    ):
        fleet = Demo(drones, directory, sockets, children, vehicles, arrived)
        fleet.start()
        yield fleet
