"""RadiaCode detectors on USB or Bluetooth, by the package `radiacode` (https://github.com/cdump/radiacode).

The package speaks the device's protocol, and blocks meanwhile, so it has a thread. Once a second it fetches the
records that the device has gathered since. The last `RealTimeData` among them is the reading: `count_rate` in counts
per second, or `dose_rate` in roentgen per hour. That is 10,000 uSv/h by the device's fixed conversion, whatever its
display shows (so the package's examples for Prometheus and narodmon.ru).
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any

from rass_mav.errors import ConfigError, installing

from .base import MAX_WAITING, Sensor, SensorReading, SensorState
from .dose import Unit
from .settings import SensorSettings

log = logging.getLogger(__name__)

#: Seconds between two questions. The device measures once or twice a second.
POLL_S = 1.0
#: Seconds until a lost device is looked for again.
REOPEN_S = 2.0
#: A device that says nothing of interest for this long is opened again, seconds.
SILENCE_S = 20.0
#: uSv/h in a unit of `RealTimeData.dose_rate`.
USVH = 10_000.0
# By Bluetooth, the device has an address; by USB, a serial number.
_ADDRESS = re.compile(r"(?:[0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}")


class RadiaCodeSensor(Sensor):
    """Readings from a RadiaCode."""

    def __init__(self, port: str | None, unit: Unit, now: Callable[[], float]) -> None:
        """:param port: a serial number such as RC-102-001234, or a Bluetooth address; None: the first one on USB.
        :param unit: of the readings.
        :param now: the driver's timeline, seconds. Called from a thread.
        :raises ConfigError: the package is not installed.
        """
        super().__init__(f"radiacode:{port or 'usb'}")
        if find_spec("radiacode") is None:
            raise ConfigError(f"sensor.type: radiacode needs the package radiacode: {installing('radiacode')}")
        self._port = port
        self._unit = unit
        self._now = now
        self._readings: deque[SensorReading] = deque(maxlen=MAX_WAITING)
        self._stopped = threading.Event()
        self._executor = ThreadPoolExecutor(1, "radiacode")
        self._work: Future[None] | None = None
        self._connected = False
        self._connections = self._count = self._malformed = self._dropped = 0
        self._trouble = ""

    def start(self, wake: Callable[[], None]) -> None:
        """Start its thread. `wake` is not called: the driver asks at every step."""
        self._work = self._executor.submit(self._run)

    def receive(self) -> list[SensorReading]:
        """The readings since the last call."""
        if self._work is not None and self._work.done():
            # A bug of ours. A sensor that only seems silent would hide it.
            self._work.result()
        return [self._readings.popleft() for _ in range(len(self._readings))]

    def state(self) -> SensorState:
        """Its state."""
        return SensorState(
            self._connected, self._count, self._malformed, 0, self._dropped, self._connections, self._trouble
        )

    def close(self) -> None:
        """Release the device, as soon as it has answered."""
        self._stopped.set()
        self._executor.shutdown(wait=False)

    def _run(self) -> None:
        while not self._stopped.is_set():
            failure = self._visit()
            self._connected = False
            if failure and failure != self._trouble:
                # Log it once until it changes.
                self._trouble = failure
                log.warning("sensor %s: %s", self.name, failure)
            self._stopped.wait(REOPEN_S)

    def _visit(self) -> str:
        """Open the device, and take its readings until it fails or is silent. Returns what is wrong."""
        try:
            device = self._open()
        except Exception as error:  # noqa: BLE001  The package raises many kinds, some of them bare.
            return _words(error)
        heard_at = self._now()
        try:
            self._connected = True
            self._connections += 1
            while not self._stopped.wait(POLL_S):
                try:
                    records = device.data_buf()
                except Exception as error:  # noqa: BLE001  As above.
                    return _words(error)
                now = self._now()
                if self._take(records, now):
                    heard_at, self._trouble = now, ""
                elif now - heard_at > SILENCE_S:
                    return f"no reading for {SILENCE_S:g} s"
        finally:
            device.close()
        return ""

    def _open(self) -> Any:
        from radiacode import RadiaCode

        if self._port is not None and _ADDRESS.fullmatch(self._port):
            return RadiaCode(bluetooth_mac=self._port)
        return RadiaCode(serial_number=self._port)

    def _take(self, records: list[Any], now: float) -> bool:
        """Keep the last reading. Returns whether there was one."""
        from radiacode import RealTimeData

        found = [record for record in records if isinstance(record, RealTimeData)]
        if not found:
            return False
        value = found[-1].dose_rate * USVH if self._unit == "usvh" else found[-1].count_rate
        if self._unit == "cpm":
            value *= 60.0
        if not (math.isfinite(value) and value >= 0.0):
            self._malformed += 1
            return False
        self._dropped += len(self._readings) == MAX_WAITING
        self._readings.append(SensorReading(value, now))
        self._count += 1
        return True


def _words(error: Exception) -> str:
    """On one line. The package's own error for a missing device has no text."""
    if type(error).__name__ == "DeviceNotFound":
        return "not found: is it on and plugged in, and is this user allowed to open it (udev rule)?"
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def open_radiacode(settings: SensorSettings, now: Callable[[], float]) -> RadiaCodeSensor:
    """The detector of a configuration; `now`: the driver's timeline. Raises `ConfigError`: the package is missing."""
    return RadiaCodeSensor(settings.port, settings.unit, now)
