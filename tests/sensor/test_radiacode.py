"""A RadiaCode: the real package, over a USB device that answers as the package's protocol says."""

from __future__ import annotations

import array
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import usb.core

from rass_mav.sensor import radiacode
from rass_mav.sensor.base import SensorReading
from rass_mav.sensor.radiacode import RadiaCodeSensor, open_radiacode
from rass_mav.sensor.settings import SensorSettings
from tests.patience import PATIENCE_S

# Commands and virtual strings, as the package's `types` has them.
VERSION, READ_STRING, CONFIGURATION, DATA_BUF = 0x000A, 0x0826, 2, 0x100


def real_time(number: int, count_rate: float, dose_rate: float) -> bytes:
    """A record of the data buffer: its number, the groups 0 and 0, a time in 10 ms, and then GRP_RealTimeData."""
    return struct.pack("<BBBi", number, 0, 0, -12_800) + struct.pack("<ffHHHB", count_rate, dose_rate, 51, 62, 0, 0)


def rare(number: int) -> bytes:
    """Another record, GRP_RareData: duration, dose, temperature, charge, flags."""
    return struct.pack("<BBBi", number, 0, 3, -12_800) + struct.pack("<IfHHH", 60, 1e-6, 4350, 9000, 0)


class Device:
    """The detector at the other end of the cable."""

    def __init__(self) -> None:
        self.serial = "RC-102-001234"
        self.plugged = True
        self.version = (4, 12)
        self.buffers: list[bytes] = []
        """What it has gathered; each question takes one."""
        self.asked = 0
        self.closed = 0
        self._answer = b""
        self._lock = threading.Lock()

    def find(self, idVendor: int, idProduct: int, serial_number: str | None = None) -> Device | None:
        assert (idVendor, idProduct) == (0x0483, 0xF123)
        return self if self.plugged and serial_number in (None, self.serial) else None

    def write(self, endpoint: int, request: bytes) -> None:
        if not self.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)")
        (length,) = struct.unpack_from("<I", request)
        assert length == len(request) - 4
        head, body = request[4:8], request[8:]
        answer = head + self._reply(struct.unpack_from("<H", head)[0], body)
        self._answer = struct.pack("<I", len(answer)) + answer

    def read(self, endpoint: int, size: int, timeout: int | None = None) -> array.array[int]:
        if not self._answer:
            raise usb.core.USBTimeoutError("Operation timed out")
        part, self._answer = self._answer[:size], self._answer[size:]
        return array.array("B", part)

    def _reply(self, command: int, body: bytes) -> bytes:
        if command == VERSION:
            text = b"\x04date"
            major, minor = self.version
            return struct.pack("<HH", 0, 4) + text + struct.pack("<HH", minor, major) + text
        if command == READ_STRING:
            (which,) = struct.unpack_from("<I", body)
            content = b"SpecFormatVersion=1\n" if which == CONFIGURATION else self._gathered()
            return struct.pack("<II", 1, len(content)) + content
        return struct.pack("<I", 1)

    def _gathered(self) -> bytes:
        self.asked += 1
        with self._lock:
            return self.buffers.pop(0) if self.buffers else b""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    device = Device()
    monkeypatch.setattr(usb.core, "find", device.find)
    monkeypatch.setattr("usb.util.dispose_resources", lambda which: setattr(which, "closed", which.closed + 1))
    monkeypatch.setattr(radiacode, "POLL_S", 0.01)
    monkeypatch.setattr(radiacode, "REOPEN_S", 0.01)
    return device


@pytest.fixture
def opened(device: Device) -> Iterator[Callable[..., RadiaCodeSensor]]:
    sensors = []

    def open_it(**keys: Any) -> RadiaCodeSensor:
        settings = SensorSettings(type="radiacode", **keys)
        settings.check()
        sensor = open_radiacode(settings, time.monotonic)
        sensors.append(sensor)
        sensor.start(lambda: None)
        return sensor

    yield open_it
    for sensor in sensors:
        sensor.close()
        assert sensor._work is not None
        sensor._work.result(PATIENCE_S)


def until(so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not so():
        assert time.monotonic() < deadline
        threading.Event().wait(0.005)


def readings(sensor: RadiaCodeSensor, count: int = 1) -> list[SensorReading]:
    found: list[SensorReading] = []

    def look() -> bool:
        found.extend(sensor.receive())
        return len(found) >= count

    until(look)
    return found


@pytest.mark.parametrize(("unit", "value"), [("usvh", 0.12), ("cps", 7.5), ("cpm", 450.0)])
def test_it_tells_its_dose_rate_or_its_count_rate(
    device: Device, opened: Callable[..., RadiaCodeSensor], unit: str, value: float
) -> None:
    # The display of such a device shows 0.12 uSv/h, or 12 uR/h. Of what it has gathered the last one counts.
    device.buffers = [real_time(7, 1.0, 1e-6) + rare(8) + real_time(9, 7.5, 12e-6)]
    sensor = opened(unit=unit)
    (reading,) = readings(sensor)
    assert reading.value == pytest.approx(value, rel=1e-6)
    assert abs(reading.at - time.monotonic()) < PATIENCE_S
    assert sensor.state()[:2] == (True, 1)


def test_a_device_is_chosen_by_its_serial_number(device: Device, opened: Callable[..., RadiaCodeSensor]) -> None:
    device.buffers = [real_time(0, 1.0, 1e-5)]
    other = opened(port="RC-103-009999")
    until(lambda: other.state().trouble.startswith("not found: is it on and plugged in, and is this user allowed to"))
    assert not other.state().connected
    assert readings(opened(port="RC-102-001234"))[0].value == pytest.approx(0.1, rel=1e-6)


def test_a_device_that_is_unplugged_comes_back(device: Device, opened: Callable[..., RadiaCodeSensor]) -> None:
    device.buffers = [real_time(0, 1.0, 1e-5)]
    sensor = opened()
    readings(sensor)
    device.plugged = False
    until(lambda: "not found" in sensor.state().trouble)
    assert device.closed
    device.buffers = [real_time(0, 1.0, 2e-5)]
    device.plugged = True
    assert readings(sensor)[0].value == pytest.approx(0.2, rel=1e-6)
    state = sensor.state()
    assert (state.connected, state.connections, state.trouble) == (True, 2, "")


@pytest.mark.parametrize(
    "buffer", [real_time(0, float("nan"), float("nan")), real_time(0, -1.0, -1.0), b"\xff" * 40, b"\0" * 6, b""]
)
def test_nonsense_is_no_reading(device: Device, opened: Callable[..., RadiaCodeSensor], buffer: bytes) -> None:
    device.buffers = [buffer]
    sensor = opened()
    until(lambda: device.asked > 1)
    assert sensor.receive() == []
    device.buffers.append(real_time(0, 1.0, 1e-5))
    readings(sensor)


def test_old_firmware_and_silence_are_said(
    device: Device, opened: Callable[..., RadiaCodeSensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(radiacode, "SILENCE_S", 0.02)
    silent = opened()
    until(lambda: silent.state().trouble == "no reading for 0.02 s")
    device.version = (4, 1)
    until(lambda: "Incompatible firmware version 4.1" in silent.state().trouble)
    assert not silent.state().connected
