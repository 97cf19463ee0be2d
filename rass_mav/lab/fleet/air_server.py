"""The process that simulates the air of a swarm of real processes, a mock swarm or one that flies.

Every node has two sockets of its own here, both on 127.0.0.1. To the first one the node sends its frames to its
neighbours; the air passes them on to those in range, with the scenario's loss, duplication, overtaking and latency. The
second one is the node's flight controller. The system chooses all ports, here and in the nodes, so none can be in use:
the parent tells each node its two ports, and the air learns a node's ports from the source of its datagrams.

The process is started with the name of an `AirOrder` file (JSON). It prints its `Ports` in one line on stdout, takes
orders on stdin, a line each, and prints its `Figures` in the last line. When stdin ends, so does the process: it never
outlives its parent.

    start           a mock world starts; until then it stays at step 0
    off NODE        this node's process is dead: its last frames are passed on, then it hears nothing until it sends
    down NODE       only where vehicles fly: this node's autopilot is dead
    stop            print the figures and end
"""

from __future__ import annotations

import contextlib
import os
import random
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO, Any, Generic, TypeVar

import msgspec

from rass_mav.core.messages import NO_ROUTE, Beacon, Chunk, Data, Put
from rass_mav.errors import ConfigError, MalformedError, RassError, os_errors_as
from rass_mav.lab.fleet.wires import Wires, whole_frames
from rass_mav.lab.medium.air import Record
from rass_mav.lab.medium.instant import Radio
from rass_mav.lab.medium.neighbours import RangeGraph
from rass_mav.lab.medium.tlog import TlogWriter
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.lab.swarm.scenario import Scenario, system_id
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.messages import HEARTBEAT
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.wire import decode
from rass_mav.wire.attestation import is_attestation
from rass_mav.wire.introduction import is_introduction
from rass_mav.wire.key_updates import is_about_keys

S = TypeVar("S", bound=Scenario)

# Longest line of orders, bytes.
_MAX_ORDER = 4096


class AirOrder(msgspec.Struct, Generic[S]):
    """How the air is set up. What follows `record` is for vehicles that fly."""

    scenario: S
    record: str | None = None
    """A .tlog file for every frame put on the air; None: none."""
    through: bool = False
    """Frames between nodes go through the autopilots."""
    px4: bool = False
    """The vehicles' ports are those of PX4."""
    readings: bool = False
    """Whether readings are injected here."""
    trajectories: str = ""
    """A CSV file for the vehicles' true positions."""


class Ports(msgspec.Struct):
    """The first line: the ports on 127.0.0.1 for each node, by node id; 0: there is no such port."""

    air: list[int]
    vehicle: list[int]
    """Where a node finds its autopilot."""
    serial0: list[int] = []
    """This one and the following: of vehicles that fly (see `lab.sitl.air`)."""
    serial1: list[int] = []
    serial2: list[int] = []
    station: list[int] = []


class Figures(msgspec.Struct):
    """The last line: what was counted. Only the air hears all nodes, also those that are killed."""

    sent: int = 0
    """Frames put on the air."""
    received: int = 0
    """Frames passed on, one for each hearer and time."""
    dropped: int = 0
    """Frames lost, one for each hearer that lost it; by the scenario's loss, or because a socket was full."""
    malformed: int = 0
    """Frames to the air that are not ours, and datagrams with anything but frames."""
    bytes_sent: int = 0
    sha256: str = ""
    """Over all frames put on the air, in order."""
    data_sent: int = 0
    """Data, copies and chunks in these frames, retransmissions included."""
    max_hop_count: int = 0
    """Largest hop count in any beacon."""
    heartbeats: int = 0
    """Heartbeats of nodes that their flight controllers received."""
    late_steps: int = 0
    """Steps that were caught up because the machine was late; mock flight controllers were silent in them."""
    telemetry: int = 0
    """Frames on the air that do not come from nodes; part of `sent`. This and the following: of vehicles that fly."""
    truth: list[int] = []
    """By node id, like the following: how often its true position was reported."""
    flew_m: list[float] = []
    """Metres over ground."""
    farthest_m: list[float] = []
    """Largest distance from the take-off position."""
    highest_m: list[float] = []
    """Largest height above the take-off position."""


class Air(ABC):
    """Sockets and the radio. `wires.poll`, `step` and `look` do all the work; the caller brings the time."""

    def __init__(self, order: AirOrder[S], graph: RangeGraph) -> None:
        """`graph`: which nodes hear each other.

        Raises `ConfigError` for a file that cannot be written, `LinkError` for a port in use.
        """
        scenario = order.scenario
        nodes = range(scenario.nodes)
        self._payload_type = scenario.mavlink.payload_type
        self._graph = graph
        self._files = contextlib.ExitStack()
        record = None if order.record is None else _recorder(self._opened(order.record, "wb"))
        self._radio = Radio(scenario.radio, random.Random(f"{scenario.seed}:radio"), record=record)
        self._noise_rng = random.Random(f"{scenario.seed}:noise")
        self.wires = Wires()
        self._air = [self.wires.new(self._hear_node, node) for node in nodes]
        self._companion = [self.wires.new(self._hear_companion, node) for node in nodes]
        self._ears = list(self._air)
        """The wire on which each node hears the others."""
        self._reader = FrameReader()
        self._step = 0
        self.step_s = scenario.node.step_s
        self.started = False
        """Whether the order `start` has come."""
        self.counted = Figures()
        """So far, without what `figures` adds."""

    @property
    def ports(self) -> Ports:
        """Where the nodes send to."""
        return Ports([wire.port for wire in self._air], [wire.port for wire in self._companion])

    @property
    def due(self) -> float:
        """When the next step is due, seconds since the start."""
        return (self._step + 1) * self.step_s

    def step(self) -> None:
        """Advance one step: delayed frames arrive."""
        self._step += 1
        self._radio.begin_step(self._step)
        self._deliver()

    @abstractmethod
    def look(self, now: float) -> float:
        """Let the flight controllers send what is due at `now`. Returns when to call again; seconds since the start."""

    def off(self, node: int) -> None:
        """The process of a node is dead. It hears nothing until its successor sends."""
        self._air[node].forget()
        self._companion[node].forget()

    def down(self, node: int) -> None:
        """The autopilot of a node is dead."""
        raise ValueError("there are no autopilots of their own here")

    def figures(self) -> Figures:
        """What has been counted so far."""
        radio = self._radio
        return msgspec.structs.replace(
            self.counted,
            sent=radio.sent,
            bytes_sent=radio.bytes_sent,
            sha256=radio.sha256,
            dropped=self.counted.dropped + radio.dropped + sum(wire.overrun for wire in self._ears),
            malformed=self.counted.malformed + sum(wire.reader.malformed for wire in self._ears),
        )

    def close(self) -> None:
        """Release sockets and files."""
        self.wires.close()
        self._files.close()

    def _opened(self, path: str, mode: str) -> IO[Any]:
        with os_errors_as(ConfigError, path):
            return self._files.enter_context(Path(path).open(mode))

    def _hear_node(self, node: int, data: bytes) -> None:
        """Frames from a node to its neighbours."""
        size = 0
        for raw, _ in whole_frames(data, self._reader):
            size += len(raw)
            self._hear_frame(node, raw)
        self.counted.malformed += size < len(data)

    def _hear_frame(self, node: int, frame: bytes) -> None:
        self._count(frame)
        self._put_on_air(node, frame)

    def _put_on_air(self, node: int, frame: bytes) -> None:
        self._radio.send(node, frame, self._step)
        self._deliver()

    def _deliver(self) -> None:
        for hearers, frame in self._radio.arrivals(self._step, self._graph.neighbours):
            for wire in [self._ears[hearer] for hearer in hearers]:
                if wire.peer is None:
                    continue
                if wire.send(frame):
                    self.counted.received += 1
                else:
                    self.counted.dropped += 1

    def _hear_companion(self, node: int, data: bytes) -> None:
        """Data from a node to its flight controller."""
        frames = self._companion[node].reader.feed(data)
        self.counted.heartbeats += sum(frame.message_id == HEARTBEAT for frame in frames)

    def _count(self, frame: bytes) -> None:
        counted = self.counted
        fields = tunnel_from_datagram(frame)
        if fields is None or fields[4] != self._payload_type:
            counted.malformed += 1
            return
        payload = fields[5]
        if is_introduction(payload) or is_about_keys(payload) or is_attestation(payload):
            return
        try:
            message = decode(fields[5], 0.0)
        except MalformedError:
            counted.malformed += 1
            return
        if isinstance(message, Beacon):
            if message.hops != NO_ROUTE:
                counted.max_hop_count = max(counted.max_hop_count, message.hops)
        elif isinstance(message, Data):
            counted.data_sent += len(message.handovers)
        elif isinstance(message, Put) or (isinstance(message, Chunk) and message.data):
            counted.data_sent += 1


def _recorder(file: IO[bytes]) -> Record:
    tape = TlogWriter(file)
    return lambda frame, step: tape.record(frame, time.time())


class MockAir(Air):
    """Nodes move and sources drift as in virtual time, once the air has been told to start."""

    def __init__(self, order: AirOrder[Scenario]) -> None:
        """See `Air`."""
        scenario = order.scenario
        self.surroundings = Surroundings(scenario)
        super().__init__(order, self.surroundings.graph)
        name = scenario.mavlink.reading_name
        self._autopilots = [MockAutopilot(system_id(node), reading_name=name) for node in range(scenario.nodes)]

    def step(self) -> None:
        """Advance one step: the world moves, and delayed frames arrive."""
        if self.started:
            self.surroundings.step()
        super().step()

    def look(self, now: float) -> float:
        """The flight controllers send once a step; in steps that are caught up they are silent."""
        surroundings = self.surroundings
        for node, wire in enumerate(self._companion):
            if wire.peer is None:
                continue
            x, y = surroundings.positions[node]
            reading = surroundings.reading(node, self._noise_rng)
            for frame in self._autopilots[node].frames(now, x, y, reading):
                wire.send(frame)
        return self.due


class _Orders:
    """The lines on stdin."""

    def __init__(self, air: Air, file: int) -> None:
        self._air = air
        self._file = file
        self._rest = b""
        self.stopped = False
        self.orphaned = False

    def read(self) -> None:
        data = os.read(self._file, _MAX_ORDER)
        if not data:
            self.orphaned = True
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            match line.decode("ascii").split():
                case ["start"]:
                    self._air.started = True
                case ["off", node]:
                    self._air.off(int(node))
                case ["down", node]:
                    self._air.down(int(node))
                case ["stop"]:
                    self.stopped = True
                case words:
                    raise ValueError(f"not an order: {words}")


def serve(air: Air, orders: int) -> bool:
    """Run the air in real time until the file descriptor `orders` says stop. False: the parent is gone."""
    reader = _Orders(air, orders)
    air.wires.watch(orders, reader.read)
    boot = time.monotonic()
    next_look = 0.0
    while not (reader.stopped or reader.orphaned):
        air.wires.poll(min(air.due, next_look) - (time.monotonic() - boot))
        now = time.monotonic() - boot
        # A missed step is caught up, so that the world keeps the time.
        while air.due <= now:
            air.counted.late_steps += air.due + air.step_s <= now
            air.step()
        if now >= next_look:
            next_look = air.look(now)
    return not reader.orphaned


def main(make: Callable[[AirOrder[S]], Air], kind: type[S], arguments: Iterable[str]) -> int:
    """The process: 0 when it was told to stop, 1 when its parent has gone, or a port or a file is not available.

    `make`: creates the air from its order, whose scenario is of this `kind`.
    """
    (path,) = arguments
    order = msgspec.json.decode(Path(path).read_bytes(), type=AirOrder[kind])  # type: ignore[valid-type]
    try:
        with contextlib.closing(make(order)) as air:
            _say(air.ports)
            if not serve(air, sys.stdin.fileno()):
                return 1
            _say(air.figures())
    except RassError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _say(struct: msgspec.Struct) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(struct) + b"\n")
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main(MockAir, Scenario, sys.argv[1:]))
