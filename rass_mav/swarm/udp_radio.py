"""The radio process of a swarm of real processes: the air between the nodes, and the flight controller of each.

Every node has two sockets of its own here, both on 127.0.0.1. To the first one the node sends all that it says to its
neighbours; the radio passes it on to those in range, with loss, doubling, overtaking and latency as the scenario has
them. Behind the second one sits the node's mock flight controller. All ports are chosen by the system, here and in the
nodes, so none can be in use: the parent tells each node the radio's two ports, and the radio learns a node's ports
from the source of what it sends.

The process is started with the name of a `RadioOrder` file (JSON). It says its ports in one line on stdout, takes
orders on stdin, a line each, and says its figures in a last line. When stdin ends, so does the process: it never
outlives its parent.

    start           the world begins to turn; until then it stands at step 0
    off NODE        this node's process is dead: what it said last is passed on, then it hears nothing until it speaks
    stop            say the figures and end
"""

from __future__ import annotations

import contextlib
import os
import random
import selectors
import socket
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import msgspec

from rass_mav.errors import ConfigError, RassError
from rass_mav.link.base import Address
from rass_mav.link.sockets import MAX_DATAGRAM, MAX_PER_WAKE, bound_socket, kernel_drops
from rass_mav.mavlink.messages import HEARTBEAT
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.tlog import TlogWriter
from rass_mav.swarm.air_counts import AirCounts
from rass_mav.swarm.autopilot import MockAutopilot
from rass_mav.swarm.radio import Radio, Record
from rass_mav.swarm.scenario import Scenario, system_id
from rass_mav.swarm.surroundings import Surroundings

_LOCALHOST = "127.0.0.1"
# Longest line of orders, bytes.
_MAX_ORDER = 4096


class RadioOrder(msgspec.Struct):
    """What the radio process is started with."""

    scenario: Scenario
    record: str | None = None
    """A .tlog file for every frame put on the air; None: none."""


class Ports(msgspec.Struct):
    """The first line: where the radio listens on 127.0.0.1, by node id."""

    air: list[int]
    vehicle: list[int]


class Figures(msgspec.Struct):
    """The last line: what the radio counted."""

    sent: int
    """Frames put on the air."""
    received: int
    """Frames passed on, one for each hearer and time."""
    dropped: int
    """Frames lost, one for each hearer that lost it; by the scenario's loss, or because a socket was full."""
    malformed: int
    """Datagrams from nodes that are not one frame of ours."""
    bytes_sent: int
    sha256: str
    """Over all frames put on the air, in order."""
    data_sent: int
    """Data, copies and chunks in these frames, retransmissions included."""
    max_hop_count: int
    """Largest hop count in any beacon."""
    heartbeats: int
    """Heartbeats of nodes that their flight controllers got."""
    late_steps: int
    """Steps in which the flight controllers kept silent because the machine was late."""


class UdpRadio:
    """Sockets, air and flight controllers. `poll` and `tick` do all the work; the caller brings the time."""

    def __init__(self, scenario: Scenario, *, record: Record | None = None) -> None:
        """`record` is called with every frame put on the air. Raises `ConfigError` and `LinkError`."""
        nodes = range(scenario.nodes)
        self.surroundings = Surroundings(scenario)
        self._radio = Radio(scenario.radio, random.Random(f"{scenario.seed}:radio"), record=record)
        self._noise = scenario.radiation.noise
        self._noise_rng = random.Random(f"{scenario.seed}:noise")
        name = scenario.mavlink.reading_name
        self._autopilots = [MockAutopilot(system_id(node), reading_name=name) for node in nodes]
        self._vehicle_readers = [FrameReader() for _ in nodes]
        self._air = [bound_socket("radio", (_LOCALHOST, 0)) for _ in nodes]
        self._vehicle = [bound_socket("vehicle", (_LOCALHOST, 0)) for _ in nodes]
        self._hearers: list[Address | None] = [None for _ in nodes]
        """Where each node listens to its neighbours; None: not known, or off."""
        self._pilots: list[Address | None] = [None for _ in nodes]
        """Where each node listens to its autopilot."""
        self._selector = selectors.DefaultSelector()
        for node in nodes:
            self._selector.register(self._air[node], selectors.EVENT_READ, (self._hear, node))
            self._selector.register(self._vehicle[node], selectors.EVENT_READ, (self._hear_vehicle, node))
        self._tick = 0
        self._received = 0
        self._unsent = 0
        self._counts = AirCounts(scenario.mavlink.payload_type)
        self._heartbeats = 0
        self.late_steps = 0

    @property
    def ports(self) -> Ports:
        """Where the nodes send to."""
        return Ports([s.getsockname()[1] for s in self._air], [s.getsockname()[1] for s in self._vehicle])

    def watch(self, file: int, ready: Callable[[], None]) -> None:
        """Let `poll` call `ready` when there is something to read from a file descriptor."""
        self._selector.register(file, selectors.EVENT_READ, (lambda _: ready(), 0))

    def poll(self, timeout_s: float) -> None:
        """Pass on what the nodes have sent; wait for it at most so long."""
        for key, _ in self._selector.select(max(timeout_s, 0.0)):
            handle, node = key.data
            handle(node)

    def tick(self, now: float, *, turn: bool, speak: bool = True) -> None:
        """A step later: late frames arrive, and the flight controllers speak (`speak`). `now` in seconds since boot.

        `turn`: the world turns too: nodes move, sources drift.
        """
        self._tick += 1
        if turn:
            self.surroundings.step()
        self._radio.begin_step(self._tick)
        self._deliver()
        if speak:
            self._speak(now)

    def off(self, node: int) -> None:
        """The process of a node is dead. It hears nothing until its successor speaks."""
        # What it sent lies in our sockets already. Nothing may bring its address back afterwards: its ports are free
        # now, and the next process may get them.
        while self._hear(node):
            pass
        while self._hear_vehicle(node):
            pass
        self._hearers[node] = self._pilots[node] = None

    def figures(self) -> Figures:
        """What has been counted so far."""
        radio = self._radio
        lost = self._unsent + sum(kernel_drops(sock) for sock in self._air)
        return Figures(
            sent=radio.sent,
            received=self._received,
            dropped=radio.dropped + lost,
            malformed=self._counts.malformed,
            bytes_sent=radio.bytes_sent,
            sha256=radio.sha256,
            data_sent=self._counts.data_sent,
            max_hop_count=self._counts.max_hop_count,
            heartbeats=self._heartbeats,
            late_steps=self.late_steps,
        )

    def close(self) -> None:
        """Release the sockets."""
        self._selector.close()
        for sock in self._air + self._vehicle:
            sock.close()

    def _hear(self, node: int) -> bool:
        """Take in what a node says to its neighbours. True: there may be more."""
        for _ in range(MAX_PER_WAKE):
            try:
                frame, self._hearers[node] = self._air[node].recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return False
            self._counts.count(frame)
            self._radio.send(node, frame, self._tick)
            self._deliver()
        return True

    def _deliver(self) -> None:
        for _, hearer, frame in self._radio.arrivals(self._tick, self.surroundings.graph.neighbours):
            address = self._hearers[hearer]
            if address is None:
                continue
            if self._sent(self._air[hearer], frame, address):
                self._received += 1
            else:
                self._unsent += 1

    @staticmethod
    def _sent(sock: socket.socket, frame: bytes, address: Address) -> bool:
        try:
            sock.sendto(frame, address)
        except OSError:
            # A full buffer, or nobody there any more: the air does not mind.
            return False
        return True

    def _hear_vehicle(self, node: int) -> bool:
        for _ in range(MAX_PER_WAKE):
            try:
                data, self._pilots[node] = self._vehicle[node].recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return False
            frames = self._vehicle_readers[node].feed(data)
            self._heartbeats += sum(frame.message_id == HEARTBEAT for frame in frames)
        return True

    def _speak(self, now: float) -> None:
        surroundings = self.surroundings
        for node, address in enumerate(self._pilots):
            if address is None:
                continue
            x, y = surroundings.positions[node]
            reading = surroundings.levels[node] + self._noise_rng.gauss(0.0, self._noise)
            for frame in self._autopilots[node].frames(now, x, y, reading):
                if not self._sent(self._vehicle[node], frame, address):
                    self._unsent += 1


class _Orders:
    """The lines on stdin."""

    def __init__(self, radio: UdpRadio, file: int) -> None:
        self._radio = radio
        self._file = file
        self._rest = b""
        self.turning = False
        self.stopped = False
        self.orphaned = False

    def read(self) -> None:
        data = os.read(self._file, _MAX_ORDER)
        if not data:
            self.orphaned = True
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._obey(line.decode("ascii").split())

    def _obey(self, words: list[str]) -> None:
        match words:
            case ["start"]:
                self.turning = True
            case ["off", node]:
                self._radio.off(int(node))
            case ["stop"]:
                self.stopped = True
            case _:
                raise ValueError(f"not an order: {words}")


def turn(radio: UdpRadio, step_s: float, orders: int) -> bool:
    """Run the radio in real time until the file descriptor `orders` says stop. False: the parent is gone."""
    told = _Orders(radio, orders)
    radio.watch(orders, told.read)
    boot = time.monotonic()
    due = 1
    while not told.stopped and not told.orphaned:
        now = time.monotonic() - boot
        radio.poll(due * step_s - now)
        now = time.monotonic() - boot
        # A step that is missed is made up for, so that the world keeps the time, but in silence.
        while due * step_s <= now:
            late = (due + 1) * step_s <= now
            radio.late_steps += late
            radio.tick(now, turn=told.turning, speak=not late)
            due += 1
    return not told.orphaned


def main(arguments: Iterable[str]) -> int:
    """The process: 0 when it was told to stop, 1 when its parent has gone."""
    (path,) = arguments
    order = msgspec.json.decode(Path(path).read_bytes(), type=RadioOrder)
    try:
        with contextlib.ExitStack() as stack:
            record = None
            if order.record is not None:
                record = _recorder(TlogWriter(stack.enter_context(_opened(order.record))))
            radio = UdpRadio(order.scenario, record=record)
            stack.callback(radio.close)
            _say(radio.ports)
            if not turn(radio, order.scenario.node.step_s, sys.stdin.fileno()):
                return 1
            _say(radio.figures())
    except RassError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _opened(path: str) -> BinaryIO:
    try:
        return Path(path).open("wb")
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}") from None


def _recorder(tape: TlogWriter) -> Record:
    return lambda frame, step: tape.record(frame, time.time())


def _say(struct: msgspec.Struct) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(struct) + b"\n")
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
