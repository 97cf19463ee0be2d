"""Serial ports (pseudo-terminals stand in for them) and TCP: lost, opened again, jammed."""

from __future__ import annotations

import asyncio
import os
import socket
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rass_mav.link.address import parse_vehicle_url
from rass_mav.link.serialport import SerialOpener
from rass_mav.link.stream import LONGEST_PAUSE_S, MAX_PENDING_BYTES, OPENING_S, StreamPort
from rass_mav.link.vehicle import open_vehicle
from rass_mav.link.vehicle_stream import VehicleStream
from tests.patience import PATIENCE_S
from tests.ptys import SerialDevice
from tests.waking import Waking


class Watched:
    """A port of the autopilot, and a way to wait for what it does."""

    def __init__(self, port: VehicleStream) -> None:
        self.port = port
        self.heard = b""
        self.waking = Waking(port.start)

    async def until(self, done: Callable[[], bool]) -> None:
        def looked() -> bool:
            self.heard += b"".join(self.port.receive())
            return done()

        await self.waking.until(looked)

    async def opened(self, times: int) -> None:
        await self.until(lambda: self.port.generation >= times)


async def readable(fd: int) -> bytes:
    """What comes out of the far end next."""
    loop = asyncio.get_running_loop()
    came = loop.create_future()

    def arrived() -> None:
        if not came.done():
            came.set_result(None)

    loop.add_reader(fd, arrived)
    try:
        await asyncio.wait_for(came, PATIENCE_S)
    finally:
        loop.remove_reader(fd)
    return os.read(fd, 65536)


def vehicle(device: SerialDevice) -> VehicleStream:
    port = open_vehicle(parse_vehicle_url(f"serial:{device.path}:921600"))
    assert isinstance(port, VehicleStream)
    return port


@pytest.fixture
def device(tmp_path: Path) -> Iterator[SerialDevice]:
    device = SerialDevice(tmp_path / "ttyUSB0").plug()
    yield device
    device.unplug()


async def opened(device: SerialDevice) -> Watched:
    watched = Watched(vehicle(device))
    await watched.opened(1)
    return watched


async def test_a_serial_port_carries_bytes_both_ways(device: SerialDevice) -> None:
    watched = await opened(device)
    device.say(b"\x00\x03\x11\x13\r\n\x04binary\xff")  # none of it may mean anything to the line discipline
    await watched.until(lambda: watched.heard.endswith(b"\xff"))
    assert watched.heard == b"\x00\x03\x11\x13\r\n\x04binary\xff"
    watched.port.send(b"\x03answer\r\n")
    assert await readable(device.far) == b"\x03answer\r\n"
    assert watched.port.counters().sent == 1
    assert watched.port.trouble == ""
    watched.port.close()


async def test_the_speed_is_set(device: SerialDevice) -> None:
    port = open_vehicle(parse_vehicle_url(f"{device.path},57600"))
    assert isinstance(port, VehicleStream)
    await Watched(port).opened(1)
    assert termios.tcgetattr(device.far)[tty.OSPEED] == termios.B57600
    port.close()


async def test_a_device_that_is_pulled_out_comes_back_under_its_name(tmp_path: Path) -> None:
    """Three times, and each time the port is back within 5 s."""
    loop = asyncio.get_running_loop()
    device = SerialDevice(tmp_path / "ttyUSB0")
    watched = Watched(vehicle(device))
    watched.port.send(b"nobody is there")
    assert watched.port.counters().dropped_out == 1
    for turn in range(1, 4):
        device.plug()
        began = loop.time()
        await watched.opened(turn)
        half = b"%d half a fra" % turn
        device.say(half)

        def heard(half: bytes = half) -> bool:
            return watched.heard.endswith(half)

        await watched.until(heard)
        assert loop.time() - began < 5.0
        watched.port.send(b"here")
        assert await readable(device.far) == b"here"
        device.unplug()
        await watched.until(lambda: bool(watched.port.trouble))
        watched.port.send(b"gone")
    assert watched.port.counters().sent == 3
    assert watched.port.counters().dropped_out == 4
    watched.port.close()


async def test_a_port_that_does_not_drain_drops_whole_frames_and_says_so(device: SerialDevice) -> None:
    watched = await opened(device)
    frames = [bytes([65 + n % 26]) * 145 for n in range(2000)]
    for frame in frames:
        watched.port.send(frame)
    dropped = watched.port.counters().dropped_out
    assert dropped
    heard = b""
    while len(heard) < (2000 - dropped) * 145:
        heard += await readable(device.far)
    # What came through is whole frames, in order.
    assert heard == b"".join(frames[: 2000 - dropped])
    assert watched.port.counters().sent == 2000 - dropped
    watched.port.send(b"x" * MAX_PENDING_BYTES)
    assert len(await readable(device.far)) > 0
    watched.port.close()


async def test_closing_does_not_wait_for_a_jammed_port(device: SerialDevice) -> None:
    watched = await opened(device)
    for _ in range(200):
        watched.port.send(bytes(145))
    began = asyncio.get_running_loop().time()
    watched.port.close()
    assert asyncio.get_running_loop().time() - began < 1.0


async def test_two_programs_do_not_share_a_port(device: SerialDevice) -> None:
    first = await opened(device)
    second = Watched(vehicle(device))
    await second.until(lambda: bool(second.port.trouble))
    assert second.port.generation == 0
    second.port.close()
    first.port.close()


def test_back_within_five_seconds_whatever_the_port() -> None:
    """The longest pause and the longest attempt before it together."""
    assert LONGEST_PAUSE_S + OPENING_S <= 5.0


class Router:
    """A TCP server for one client at a time."""

    def __init__(self) -> None:
        self.listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)

    def listen(self, port: int = 0) -> int:
        self.listener.bind(("127.0.0.1", port))
        self.listener.listen(1)
        self.listener.setblocking(False)
        number: int = self.listener.getsockname()[1]
        return number

    async def client(self) -> socket.socket:
        sock, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(self.listener), PATIENCE_S)
        sock.setblocking(False)
        return sock


async def test_tcp_connects_again_when_the_server_was_restarted() -> None:
    loop = asyncio.get_running_loop()
    router = Router()
    number = router.listen()
    port = open_vehicle(parse_vehicle_url(f"tcp:127.0.0.1:{number}"))
    assert isinstance(port, VehicleStream)
    watched = Watched(port)
    client = await router.client()
    await watched.opened(1)
    port.send(b"heartbeat")
    assert await loop.sock_recv(client, 100) == b"heartbeat"
    await loop.sock_sendall(client, b"telemetry")
    await watched.until(lambda: watched.heard == b"telemetry")
    client.close()
    router.listener.close()
    await watched.until(lambda: bool(port.trouble))
    again = Router()
    again.listen(number)
    client = await again.client()
    await watched.opened(2)
    await loop.sock_sendall(client, b" again")
    await watched.until(lambda: watched.heard == b"telemetry again")
    port.close()
    client.close()
    again.listener.close()


async def test_a_mistake_of_ours_in_a_port_is_not_hidden() -> None:
    class Broken(SerialOpener):
        async def open(self) -> None:  # type: ignore[override]
            raise AssertionError("our bug")

    told: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: told.set_result(context["exception"]))
    StreamPort(Broken("/dev/null", 57600)).start(lambda: None)
    assert isinstance(await asyncio.wait_for(told, PATIENCE_S), AssertionError)


async def test_without_pyserial_a_person_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(Exception, match=r"pip install -e '\.\[drone\]' in the checkout"):
        await SerialOpener("/dev/ttyUSB0", 57600).open()
