"""A base and some drones on this machine, for `rass-mav try`.

They hear each other over UDP on 127.0.0.1. This process simulates the vehicles, which fly a circle past a radiation
source. With several drones it is the rehearsal of a mission: one of them takes a photograph, and another one dies.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import socket
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rass_mav.config.keys import check_package
from rass_mav.errors import ConfigError, LinkError, SwarmError, os_errors_as
from rass_mav.ground.archive import Archive, opener_of
from rass_mav.ground.entry import Entry
from rass_mav.ground.feed import Cursor, Feed
from rass_mav.lab.fleet.children import Children, workplace
from rass_mav.lab.fleet.fleet import Autopilots, Fleet, NodeProcess
from rass_mav.lab.fleet.wires import LOCALHOST, Wire
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.lab.swarm.radiation import RadiationField, Source
from rass_mav.link.address import parse_address
from rass_mav.link.sockets import bound_socket

if TYPE_CHECKING:
    from rass_mav.ground.entry import Opens

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
#: With so many drones one takes a photograph and the last one dies, at these times, seconds after the start.
REHEARSED = 3
PHOTO_S = 10.0
DEATH_S = 60.0
#: The photograph: a file in the folder that the first drone watches.
PHOTO = "photo.png"
_PIXELS = (320, 240)
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


def photograph(field: RadiationField) -> bytes:
    """A picture of the arena from above, a pixel for each 0.5 m, as PNG (ISO/IEC 15948): the brighter, the more
    radiation, with the noise of a camera, so that it does not pack to nothing."""
    width, height = _PIXELS
    rng = random.Random(1)

    def pixel(column: int, row: int) -> int:
        level = field.level((column - width / 2) / 2, (height / 2 - row) / 2)
        return min(240, int(level)) & 0xF0 | rng.getrandbits(4)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = b"".join(b"\0" + bytes(pixel(column, row) for column in range(width)) for row in range(height))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


class Options(NamedTuple):
    """What a demo has besides a base and its drones."""

    drones: int = 1
    """1..`MAX_DRONES`."""
    keep: Path | None = None
    """A directory, new or empty, for configurations, stores and logs; None: a temporary one."""
    keys: bool = False
    """Whether it has a mission's keys."""
    page: str | None = None
    """host:port of the base's page; None: there is none."""


class Demo(Fleet):
    """The nodes of a demo; see `demo`."""

    def __init__(
        self, options: Options, directory: Path, sockets: Path, children: Children, vehicles: MockVehicles,
        arrived: Callable[[Entry, bytes], None], tell: Callable[[str], None] = lambda line: None,
    ) -> None:  # fmt: skip
        """`directory`: for all files. `sockets`: for the control sockets. `arrived` is called with each datum that has
        arrived at the base, and with its contents. `tell`: with a line about what happens."""
        ids = range(BASE, BASE + 1 + options.drones)
        nodes = [
            NodeProcess(id, directory, sockets / f"{id}.sock", "base" if id == BASE else f"drone-{id}") for id in ids
        ]
        super().__init__(nodes, 1, STEP_S, directory, children, vehicles)
        self.page = options.page
        self._mission = directory / "mission" if options.keys else None
        """The folder of the mission's keys; None: the nodes have none."""
        self._rehearsed = options.drones >= REHEARSED
        self._photos = directory / "photos"
        self._events = [(PHOTO_S, self._photograph), (DEATH_S, self._die)] if self._rehearsed else []
        """What is still to happen, and when, seconds after the start."""
        self._tell = tell
        self._show = arrived
        self._opens: Opens | None = None
        self._feed = Feed(lambda: Archive(self.bases[0].store, opens=self._opens))
        self._shown: Cursor | None = None
        """How far the arrivals at the base have been shown."""

    def _look(self, now: float) -> None:
        super()._look(now)
        with self._feed.look(self._shown) as look:
            for entry, cursor in look.arrivals(second_contents=False):
                self._shown = cursor
                self._show(entry, look.data.payload(entry.name))

    def _fail(self, now: float) -> float:
        while self._events and now >= self.begun + self._events[0][0]:
            self._tell(self._events.pop(0)[1]())
        return self.begun + self._events[0][0] if self._events else math.inf

    def _photograph(self) -> str:
        with os_errors_as(SwarmError, self._photos):
            (self._photos / PHOTO).write_bytes(photograph(RadiationField([SOURCE], decay=DECAY)))
        return f"node {self.drones[0].node_id} takes a photograph, {self._photos / PHOTO}"

    def _die(self) -> str:
        *self.drones, dead = self.drones
        self._children.kill(dead.child)
        return f"node {dead.node_id} dies: its process is killed, with the data that only it holds"

    def summary(self) -> dict[str, Any]:
        """What became of the data."""
        seconds = round(time.monotonic() - self.begun, 1)
        return {"drones": len(self.nodes) - len(self.bases), "seconds": seconds, **self.ledger.figures()}

    def configure(self) -> None:
        """Write the keys and the configurations, with UDP ports that are free at this moment. Raises `ConfigError`."""
        if self._mission is not None:
            check_package()
            from rass_mav.trust.keys.folder import create, issue  # with PyNaCl

            create(self._mission)
            issue(self._mission, [node.node_id for node in self.drones])
            self._opens = opener_of(str(self._mission / "ground.keys"))
        if self._rehearsed:
            with os_errors_as(ConfigError, self._photos):
                self._photos.mkdir()
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
        if self._mission is not None:
            name = "ground.keys" if node in self.bases else f"drone-{node.node_id}.keys"
            sections["keys"] = {"file": str(self._mission / name)}
        if self.page is not None and node in self.bases:
            sections["page"] = {"listen": self.page}
        if self._rehearsed and node is self.drones[0]:
            sections["watch"] = {"folder": str(self._photos), "settle_s": 1.0}
        return sections


@contextlib.contextmanager
def demo(
    options: Options, arrived: Callable[[Entry, bytes], None], tell: Callable[[str], None] = lambda line: None
) -> Iterator[Demo]:
    """A base and a number of drones, running. No process and no temporary directory outlives the block.

    `arrived`, `tell`: see `Demo`.

    Raises `ConfigError`: too many drones, a directory that cannot be used; `LinkError`: another program has the page's
    address; `SwarmError`: a node that does not start.
    """
    drones = options.drones
    if not 1 <= drones <= MAX_DRONES:
        raise ConfigError(f"--drones: expected 1 to {MAX_DRONES}, got {drones}")
    if options.page is not None:
        try:
            host, port = parse_address(options.page, any_port=True, ipv6=True)
        except ConfigError as error:
            raise ConfigError(f"--page: {error}") from None
        # The base would write it to its log alone, and the browser would show the other program's page.
        with os_errors_as(LinkError, f"--page: {options.page}"):
            socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    with (
        workplace(options.keep) as (directory, sockets, children),
        contextlib.closing(MockVehicles(range(BASE + 1, BASE + 1 + drones))) as vehicles,
    ):
        if options.keep is None:
            # Its name is the mission's on the page.
            directory = directory / "try"
            directory.mkdir()
        fleet = Demo(options, directory, sockets, children, vehicles, arrived, tell)
        fleet.start()
        yield fleet
