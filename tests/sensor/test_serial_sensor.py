"""Counters on serial ports, with pseudo-terminals as cables: unplugged, plugged in again, garbage, half a line."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest
import serial

from rass_mav.errors import ConfigError
from rass_mav.link.base import MAX_TURN_BYTES
from rass_mav.sensor.base import MAX_WAITING, SensorReading, SensorState
from rass_mav.sensor.dose import DoseMeter, Tube
from rass_mav.sensor.gmc import Gmc
from rass_mav.sensor.mightyohm import MightyOhm
from rass_mav.sensor.protocol import Protocol, Sample
from rass_mav.sensor.radpro import RadPro
from rass_mav.sensor.serial_sensor import SerialSensor
from tests.ptys import SerialDevice
from tests.waking import Waking

METER = Tube(100.0, 0.0)


def line(cpm: int) -> bytes:
    return b"CPS, 1, CPM, %d, uSv/hr, 0.07, SLOW\r\n" % cpm


@pytest.fixture
def device(tmp_path: Path) -> Iterator[SerialDevice]:
    device = SerialDevice(tmp_path / "ttyCounter").plug()
    yield device
    device.unplug()


class Watched:
    """A sensor, and a way to wait for it."""

    def __init__(self, device: SerialDevice, protocol: Protocol) -> None:
        self.sensor = SerialSensor(str(device.path), 9600, protocol, DoseMeter(METER, "cpm"), time.monotonic)
        self.waking = Waking(self.sensor.start)

    async def readings(self) -> list[SensorReading]:
        """The next ones."""
        return await self.waking.next(self.sensor.receive)

    async def until(self, so: Callable[[SensorState], bool]) -> None:
        """Until its state is so."""
        await self.waking.until(lambda: so(self.sensor.state()))

    async def connected(self, times: int = 1) -> None:
        """Until its port has been opened so often; what was said before that is flushed away."""
        await self.until(lambda state: state.connected and state.connections >= times)

    async def trouble(self, text: str) -> None:
        """Until it says so."""
        await self.until(lambda state: text in state.trouble)


@contextlib.asynccontextmanager
async def watching(device: SerialDevice, protocol: Protocol) -> AsyncIterator[Watched]:
    watched = Watched(device, protocol)
    try:
        yield watched
    finally:
        watched.sensor.close()


async def test_a_counter_that_speaks_by_itself(device: SerialDevice) -> None:
    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        before = time.monotonic()
        device.say(line(13))
        [reading] = await watched.readings()
        assert reading.value == 13.0
        assert before <= reading.at <= time.monotonic()
        state = watched.sensor.state()
        assert (state.connected, state.readings, state.connections, state.trouble) == (True, 1, 1, "")


async def test_a_gmc_is_asked(device: SerialDevice) -> None:
    async with watching(device, Gmc()) as watched:
        await asyncio.to_thread(device.hear, b"<HEARTBEAT0>><GETVER>>")
        device.say(b"GMC-500")
        device.say(b"+Re 1.18")
        await asyncio.to_thread(device.hear, b"<GETCPM>>")
        device.say(b"\x00\x00\x01\x02")
        assert [reading.value for reading in await watched.readings()] == [258.0]


async def test_a_rad_pro_is_asked(device: SerialDevice) -> None:
    async with watching(device, RadPro()) as watched:
        await asyncio.to_thread(device.hear, b"GET tubeSensitivity\r\n")
        device.say(b"OK 153.800\r\n")
        await asyncio.to_thread(device.hear, b"GET tubeRate\r\n")
        device.say(b"OK 14")
        device.say(b"2.857\r\n")
        assert [reading.value for reading in await watched.readings()] == [142.857]


async def test_unplugged_in_the_middle_of_a_line_and_plugged_in_again(device: SerialDevice) -> None:
    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        device.say(line(1))
        await watched.readings()
        for n in range(2, 5):
            device.say(line(n)[:12])
            device.unplug()
            await watched.until(lambda state: not state.connected)
            assert watched.sensor.receive() == []
            device.plug()
            await watched.connected(n)
            device.say(line(n))
            assert [reading.value for reading in await watched.readings()] == [float(n)]
        state = watched.sensor.state()
        assert (state.connections, state.malformed, state.trouble) == (4, 0, "")


async def test_a_port_that_comes_late(device: SerialDevice, caplog: pytest.LogCaptureFixture) -> None:
    device.unplug()

    async with watching(device, MightyOhm()) as watched:
        await watched.trouble("no such file or directory")
        assert not watched.sensor.state().connected
        device.plug()
        await watched.connected()
        device.say(line(7))
        assert [reading.value for reading in await watched.readings()] == [7.0]
    # However often it was tried.
    assert [record.message.split(": ")[1] for record in caplog.records] == [
        "no such file or directory; trying again",
        "open",
    ]


async def test_garbage_and_a_wrong_rate_are_counted_and_told(device: SerialDevice) -> None:
    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        device.say(bytes(range(128, 256)) * 4 + b"\n" + line(5) + b"\xff" * 600 + b"\n" + line(6))
        values: list[float] = []
        while len(values) < 2:
            values += [reading.value for reading in await watched.readings()]
        assert values == [5.0, 6.0]
        assert watched.sensor.state().malformed == 2


async def test_a_device_that_says_nothing_sensible_is_opened_anew(
    device: SerialDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rass_mav.sensor.serial_sensor.SILENCE_S", 0.3)

    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        device.say(b"gibberish\n")
        await watched.trouble("no valid input for 0.3 s (expected 'CPS")
        await watched.connected(2)
        device.say(line(3))
        assert [reading.value for reading in await watched.readings()] == [3.0]
        assert watched.sensor.state().connections >= 2


async def test_a_port_that_another_program_uses(device: SerialDevice) -> None:
    with serial.Serial(str(device.path), 9600, exclusive=True) as other:
        async with watching(device, MightyOhm()) as watched:
            await watched.trouble("in use by another program")
            other.close()
            await watched.connected()
            device.say(line(3))
            await watched.readings()


async def test_a_driver_that_does_not_come_loses_the_oldest_readings(device: SerialDevice) -> None:
    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        await asyncio.to_thread(device.say, b"".join(line(n) for n in range(100)))
        await watched.until(lambda state: state.readings == 100)
        values = [reading.value for reading in watched.sensor.receive()]
        assert values == [float(n) for n in range(100 - MAX_WAITING, 100)]
        assert watched.sensor.state().dropped == 100 - MAX_WAITING


class Counted(MightyOhm):
    """Notes how much it is given at once."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes: list[int] = []

    def feed(self, data: bytes, now: float) -> list[Sample]:
        if data:
            self.sizes.append(len(data))
        return super().feed(data, now)


async def test_a_device_that_floods_is_read_in_bounded_portions(device: SerialDevice) -> None:
    protocol = Counted()

    async with watching(device, protocol) as watched:
        await watched.connected()
        saying = asyncio.create_task(asyncio.to_thread(device.say, b"".join(line(n) for n in range(500))))
        await watched.until(lambda state: state.readings == 500)
        await saying
        assert max(protocol.sizes) <= MAX_TURN_BYTES
        assert len(watched.sensor.receive()) == MAX_WAITING


class Broken(MightyOhm):
    """A protocol with a bug in it."""

    def feed(self, data: bytes, now: float) -> list[Sample]:
        raise ZeroDivisionError


async def test_a_bug_of_ours_does_not_look_like_silence(device: SerialDevice) -> None:
    async with watching(device, Broken()) as watched:
        with pytest.raises(ZeroDivisionError):
            await watched.readings()


async def test_closing_frees_the_port(device: SerialDevice) -> None:
    async with watching(device, MightyOhm()) as watched:
        await watched.connected()
        device.say(line(1))
        await watched.readings()
        watched.sensor.close()
        with serial.Serial(str(device.path), 9600, exclusive=True):
            assert not watched.sensor.state().connected


def test_without_pyserial_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(ConfigError, match=r"needs pyserial: pip install -e '\.\[drone\]' in the checkout"):
        SerialSensor("tty", 9600, MightyOhm(), DoseMeter(METER), time.monotonic)
