"""A counter on a serial port, which is kept open as those of radios and autopilots are.

pyserial is imported when the first port is opened. Nodes without a serial sensor do not need it.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from importlib.util import find_spec
from pkgutil import resolve_name

from rass_mav.errors import ConfigError, installing
from rass_mav.link.serialport import SerialOpener
from rass_mav.link.stream import StreamPort

from .base import MAX_WAITING, Sensor, SensorReading, SensorState
from .dose import DoseMeter
from .protocol import Protocol
from .settings import SensorSettings

log = logging.getLogger(__name__)

#: How often the protocol gets what has arrived, and may ask, seconds. A device that never stops sending gets no more of
#: the processor: the port hands out a few kilobytes each time, and what it cannot hold stays with the kernel.
TURN_S = 0.1
#: A port without valid input for this long is opened again, seconds. An adapter that hangs may recover this way.
SILENCE_S = 20.0


class SerialSensor(Sensor):
    """Readings from a device."""

    def __init__(self, port: str, baud: int, protocol: Protocol, meter: DoseMeter, now: Callable[[], float]) -> None:
        """:param port: a device file. Names below /dev/serial/by-id do not depend on the order of plugging in.
        :param baud: bit/s, 8N1.
        :param now: the driver's timeline, seconds.
        :raises ConfigError: pyserial is not installed.
        """
        super().__init__(f"{port}:{baud}")
        if find_spec("serial") is None:
            raise ConfigError(f"sensor.type: a serial port needs pyserial: {installing('drone')}")
        self._port = StreamPort(SerialOpener(port, baud))
        self._protocol = protocol
        self._meter = meter
        self._now = now
        self._readings: deque[SensorReading] = deque(maxlen=MAX_WAITING)
        self._wake: Callable[[], None] = lambda: None  # until `start`
        self._task: asyncio.Task[None] | None = None
        self._connections = 0
        self._heard, self._heard_at = 0, 0.0
        """What the protocol had heard when it last heard more, and when that was."""
        self._count = 0
        self._dropped = 0
        self._trouble = ""
        """What is wrong with a port that is open."""
        self._seen = ""
        """The port's trouble at the last turn."""

    def start(self, wake: Callable[[], None]) -> None:
        """Start, on the running event loop."""
        self._wake = wake
        self._port.start(lambda: None)
        self._task = asyncio.create_task(self._talk())
        self._task.add_done_callback(lambda task: wake())

    def receive(self) -> list[SensorReading]:
        """The readings since the last call."""
        if self._task is not None and self._task.done() and not self._task.cancelled():
            # A bug of ours. A sensor that only seems silent would hide it.
            self._task.result()
        arrived = list(self._readings)
        self._readings.clear()
        return arrived

    @property
    def _connected(self) -> bool:
        return self._port.is_open and self._connections == self._port.generation

    def state(self) -> SensorState:
        """Its state."""
        return SensorState(
            self._connected, self._count, self._protocol.malformed, self._meter.saturated, self._dropped,
            self._connections, self._port.trouble or self._trouble or self._protocol.trouble,
        )  # fmt: skip

    def close(self) -> None:
        """Close the port."""
        if self._task is not None:
            self._task.cancel()
        self._port.close()

    async def _talk(self) -> None:
        while True:
            self._turn(self._now())
            await asyncio.sleep(TURN_S)

    def _turn(self, now: float) -> None:
        port, protocol = self._port, self._protocol
        arrived = b"".join(data for data, _ in port.take())
        if port.generation != self._connections:
            # What has arrived may be of the connection before.
            arrived = b""
            self._connections = port.generation
            protocol.reset()
            self._heard_at = now
            self._wake()
        if port.trouble != self._seen:
            self._seen = port.trouble
            self._wake()
        if self._connected and (question := protocol.ask(now)):
            port.write(question)
        if samples := protocol.feed(arrived, now):
            for sample in samples:
                self._dropped += len(self._readings) == MAX_WAITING
                self._readings.append(SensorReading(self._meter.reading(sample.cpm, sample.cpm_per_usvh), sample.at))
            self._count += len(samples)
            self._wake()
        if protocol.heard != self._heard:
            self._heard, self._heard_at = protocol.heard, now
            self._tell("")
        elif self._connected and now - self._heard_at > SILENCE_S:
            self._heard_at = now
            why = f" ({protocol.trouble})" if protocol.trouble else ""
            self._tell(f"no valid input for {SILENCE_S:g} s{why}")
            port.reopen()

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:
            # Log it once until it changes.
            self._trouble = trouble
            log.warning("sensor %s: %s", self.name, trouble or "working again")
            self._wake()


def open_counter(settings: SensorSettings, now: Callable[[], float]) -> SerialSensor:
    """Open the counter of a configuration; `now`: the driver's timeline. Raises `ConfigError`: pyserial is missing."""
    assert settings.port is not None
    kind = settings.kind
    return SerialSensor(settings.port, settings.baud or kind.baud, resolve_name(kind.protocol)(), settings.meter(), now)
