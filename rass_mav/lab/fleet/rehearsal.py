"""A mock vehicle, the other end of the cable that a configuration describes, for `rass-mav mock-vehicle`."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import pty
import random
import signal
import socket
import time
import tty
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.app.config import RunConfig
from rass_mav.errors import ConfigError, LinkError, why
from rass_mav.lab.swarm.autopilot import HEIGHT_M, METRES_PER_DEGREE, ORIGIN, MockAutopilot, metres_east
from rass_mav.lab.swarm.radiation import Counter, DoseField, Source
from rass_mav.link.address import VehicleUrl, parse_vehicle_url
from rass_mav.link.base import Address
from rass_mav.link.interface import ANY_ADDRESS
from rass_mav.link.sockets import is_local
from rass_mav.link.stream import Channel, Opener, StreamPort
from rass_mav.link.vehicle import VehiclePort
from rass_mav.link.vehicle_udp import VehicleLink
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameReader
from rass_mav.mavlink.messages import HEARTBEAT
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.sensor.dose import TUBES, converted

#: What rehearses on a computer that has not the drone's port.
OTHERWISE = "pass --set autopilot.url=udpin:127.0.0.1:14550 to this command and to `rass-mav run`"
#: Dose rate without sources, uSv/h, and the tube that counts.
BACKGROUND, TUBE = 0.1, TUBES["sbm-20"]
#: How many strips a lawnmower mows.
STRIPS = 6
#: Sides of a path, and speeds, metres and metres per second.
MOST_SIZE_M, MOST_SPEED_M_S = 20_000.0, 100.0
#: No path may reach a pole, degrees.
MOST_LATITUDE = 89.0
#: A node that has not been heard for so long is gone, seconds.
GONE_S = 5.0
#: A full battery lasts so long, seconds.
BATTERY_S = 1500.0
_TICK_S, _READING_S = 0.2, 1.0
_CORNERS = 64


class Flight(NamedTuple):
    """What the vehicle flies."""

    place: tuple[float, float]
    """The middle of its path: latitude and longitude, degrees."""
    path: str = "circle"
    """circle, lawnmower or hover."""
    size_m: float = 60.0
    """Diameter of the circle, or side of the square that is mown."""
    speed_m_s: float = 5.0
    sources: Sequence[tuple[float, float, float]] = ()
    """Latitude and longitude, degrees, and uSv/h 1 m from it."""


class Way:
    """A closed line of corners, flown at a constant speed. Metres east and north of its middle."""

    def __init__(self, flight: Flight) -> None:
        half = flight.size_m / 2
        self._corners: list[tuple[float, float]]
        if flight.path == "circle":
            turns = [2 * math.pi * n / _CORNERS for n in range(_CORNERS + 1)]
            self._corners = [(half * math.cos(turn), half * math.sin(turn)) for turn in turns]
        elif flight.path == "lawnmower":
            norths = [-half + flight.size_m * n / (STRIPS - 1) for n in range(STRIPS)]
            there = [(x, y) for n, y in enumerate(norths) for x in ((-half, half), (half, -half))[n % 2]]
            self._corners = there + there[-2::-1]
        else:
            self._corners = [(0.0, 0.0), (0.0, 0.0)]
        self._speed = flight.speed_m_s
        self._sums = [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(self._corners))]

    def at(self, seconds: float) -> tuple[float, float, tuple[float, float]]:
        """The place after so many seconds, and the velocity to east and to north, metres per second."""
        length = self._sums[-1]
        if not length or not self._speed:
            return *self._corners[0], (0.0, 0.0)
        way = self._speed * seconds % length
        n = min(bisect_right(self._sums, way), len(self._corners) - 1)
        (x1, y1), (x2, y2) = self._corners[n - 1 : n + 1]
        leg = self._sums[n] - self._sums[n - 1]
        done = (way - self._sums[n - 1]) / leg
        velocity = self._speed * (x2 - x1) / leg, self._speed * (y2 - y1) / leg
        return x1 + (x2 - x1) * done, y1 + (y2 - y1) * done, velocity


class _Server(Opener):
    """Accepts one connection after the other."""

    def __init__(self, url: VehicleUrl) -> None:
        """Raises `LinkError`: the port is in use."""
        self.name = f"{url}, where the node connects"
        self.source: Address = url.address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind(url.address)
            self._socket.listen(1)
        except (OSError, UnicodeError) as error:
            self.close()
            raise LinkError(f"{url}: {why(error)}") from None

    async def open(self) -> Channel:
        """Wait for the node."""
        taken, _ = await asyncio.get_running_loop().sock_accept(self._socket)
        taken.setblocking(False)
        taken.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return Channel(taken.fileno(), taken.close)

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


class _Terminal(Opener):
    """A pseudo-terminal, under the name of the serial device."""

    def __init__(self, url: VehicleUrl) -> None:
        """Raises `LinkError`: the name is taken, or cannot be created."""
        self.name = str(url)
        self.source: Address = url.address
        self._far, self._near = pty.openpty()
        # Nothing is echoed before the node opens its end. As that stays open here too, the far one never fails.
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self._path = Path(url.address[0])
        try:
            # What a mock vehicle left behind that was killed.
            if self._path.is_symlink() and not self._path.exists():
                self._path.unlink()
            self._path.symlink_to(os.ttyname(self._near))
        except OSError as error:
            self._path = Path(os.ttyname(self._near))
            self.close()
            raise LinkError(f"{url}: the mock vehicle cannot use this port: {why(error)}", OTHERWISE) from None

    async def open(self) -> Channel:
        """It is open."""
        return Channel(self._far, lambda: None)

    def close(self) -> None:
        """Remove the name."""
        if self._path.is_symlink():
            self._path.unlink()
        for end in (self._far, self._near):
            os.close(end)


class _Stream(StreamPort, VehiclePort):
    """Bytes from and to the node."""

    def __init__(self, opener: _Server | _Terminal) -> None:
        super().__init__(opener)
        self._end = opener

    def receive(self) -> list[bytes]:
        """As in `VehiclePort`."""
        return [data for data, _ in self.take()]

    def _send(self, frame: bytes) -> None:
        self.write(frame)

    def close(self) -> None:
        """Release what it was opened from, too."""
        super().close()
        self._end.close()


class _Sender(VehicleLink):
    """Sends to the port where the node listens, alone on this computer: the node would take two for one vehicle."""

    def __init__(self, url: VehicleUrl) -> None:
        """Raises `LinkError`: another mock vehicle sends there."""
        super().__init__(url)
        host, port = self._socket.getpeername()
        self._claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            # A name without a file: it is free again when this process ends, however it ends.
            self._claim.bind(f"\0rass-mav mock-vehicle {host}:{port}")
        except OSError:
            self.close()
            raise LinkError(f"{url}: another mock vehicle sends to this port", "stop it first") from None

    def close(self) -> None:
        """Release the port."""
        super().close()
        self._claim.close()


def other_end(text: str | None) -> VehiclePort:
    """The other end of the port that `autopilot.url` describes.

    Raises `ConfigError`: the node has no autopilot; `LinkError`: this computer cannot be the other end.
    """
    if text is None:
        raise ConfigError(f"autopilot.url: none, so this node listens to no vehicle; {OTHERWISE}")
    url = parse_vehicle_url(text)
    host, port = url.address
    if url.mode == "serial":
        return _Stream(_Terminal(url))
    if url.mode == "udpin":
        if not port:
            raise ConfigError(f"autopilot.url: expected a fixed port, got {text!r}")
        return _Sender(VehicleUrl("udpout", ("127.0.0.1" if host in ("", ANY_ADDRESS) else host, port)))
    if not is_local(host):
        raise ConfigError(
            f"autopilot.url: expected an address of this computer for a rehearsal, got {text!r}; {OTHERWISE}"
        )
    return _Stream(_Server(url)) if url.mode == "tcp" else VehicleLink(VehicleUrl("udpin", url.address))


def not_rehearsed(config: RunConfig) -> Iterator[str]:
    """What of a configuration a mock vehicle does not stand in for."""
    if config.sensor.own:
        yield f"sensor.type is {config.sensor.type}: the node does not use the readings of the mock vehicle"
    for index, link in enumerate(config.links):
        if link.kind.through:
            yield f"links[{index}] goes through the autopilot: a mock vehicle forwards nothing to other nodes"


def _signing(config: RunConfig) -> SignedPort | None:
    """What the autopilot signs with; None: it does not. Raises `KeysError`."""
    if not config.autopilot.signing or (keyring := config.open_keys()) is None:
        return None
    from rass_mav.app.signing import last_timestamp, signing_key  # with PyNaCl

    return SignedPort(signing_key(keyring), last_timestamp(config.store_path))


def _time_and_battery(now: float) -> Iterator[MavlinkMessage]:
    """The date as GPS gives it, and a battery that empties, so many seconds after the start."""
    yield common.MAVLink_system_time_message(int(time.time() * 1e6), int(now * 1e3) & 0xFFFFFFFF)
    left = max(0.0, 1.0 - now / BATTERY_S)
    yield common.MAVLink_sys_status_message(0, 0, 0, 0, round(14_000 + 2_800 * left), 1500, round(100 * left), *[0] * 6)


class Rehearsal:
    """The vehicle, and the node that it has heard."""

    def __init__(self, config: RunConfig, flight: Flight, tell: Callable[[str], None]) -> None:
        """`tell` is called with lines about what happens. Opens the port.

        Raises `ConfigError`, `LinkError`: see `other_end`; `KeysError`: the autopilot signs, and the key is missing.
        """
        latitude, longitude = flight.place
        origin = latitude, longitude, ORIGIN[2]
        mavlink = config.mavlink
        self.system_id: int = mavlink.autopilot_id or mavlink.system_id or (config.node_id - 1) % 255 + 1
        self._unit, self._tell = config.risk.unit or "usvh", tell
        self._way = Way(flight)
        east = metres_east(origin)
        sources = [
            Source((lon - longitude) * east, (lat - latitude) * METRES_PER_DEGREE, strength)
            for lat, lon, strength in flight.sources
        ]
        self._field = DoseField(sources, background=BACKGROUND, height_m=HEIGHT_M, page_dose=1.0, step_s=_READING_S)
        self._counter, self._rng = Counter(TUBE, _READING_S), random.Random()
        signing = _signing(config)
        self._autopilot = MockAutopilot(
            self.system_id, reading_name=mavlink.reading_name, position_hz=1 / _TICK_S, accuracy_m=1.0, origin=origin,
            reading_component=mavlink.reading_component, flags=0 if signing is None else FLAG_SIGNED,
            beside=_time_and_battery,
        )  # fmt: skip
        self._reader = FrameReader(check=signing)
        self._next_reading = 0.0
        self._heard_at = -math.inf
        self._there = False
        self.sent = self.heard = 0
        """Frames to the node, and heartbeats from it."""
        self.port = other_end(config.autopilot.url)
        if signing is not None:
            self.port.sign = signing.sign

    async def run(self, seconds: float) -> None:
        """Fly for so long, or until SIGINT or SIGTERM."""
        loop = asyncio.get_running_loop()
        stop = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
        self.port.start(lambda: None)
        begun = loop.time()
        while not stop.is_set() and (now := loop.time() - begun) < seconds:
            self.turn(now)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(stop.wait(), min(_TICK_S, seconds - now))

    def turn(self, now: float) -> None:
        """Hear the node, and send it what is due, so many seconds after the start."""
        for data in self.port.receive():
            frames = self._reader.feed(data)
            self.heard += (beats := sum(frame.message_id == HEARTBEAT for frame in frames))
            if beats:
                self._heard_at = now
        there = now - self._heard_at < GONE_S
        if there != self._there:
            self._there = there
            self._tell(f"{time.strftime('%H:%M:%S')} the node is {'there' if there else 'silent'}")
        x, y, velocity = self._way.at(now)
        reading = None
        if now >= self._next_reading:
            self._next_reading += _READING_S
            rate = self._counter.reading(self._field.level(x, y), self._rng)
            reading = converted(rate, "usvh", self._unit, TUBE.cpm_per_usvh) if self._unit != "counts" else rate
        for frame in self._autopilot.frames(now, x, y, reading, velocity):
            # Nobody reads what a serial port would keep for a node that is not there.
            if there or not self.port.name.startswith("serial:"):
                self.sent += 1
                self.port.send(frame)

    def summary(self) -> dict[str, Any]:
        """What was exchanged."""
        return {"system_id": self.system_id, "port": self.port.name, "sent": self.sent, "heartbeats": self.heard}
