"""A counter on a serial port. A separate thread talks to it, because a USB device that hangs must not stop the node.

pyserial is imported when the first port is opened. Nodes without a serial sensor do not need it.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import termios
import threading
from collections import deque
from collections.abc import Callable
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

from rass_mav.errors import ConfigError, LinkError, installing

from .base import MAX_WAITING, Sensor, SensorReading, SensorState
from .dose import DoseMeter
from .protocol import Protocol
from .settings import SensorSettings

if TYPE_CHECKING:
    import serial

log = logging.getLogger(__name__)

#: How long a read waits, seconds. Questions are considered as often.
READ_S = 0.1
#: How long a write waits, seconds. A question not sent by then never will be.
WRITE_S = 1.0
#: Bytes read at once, and the pause after them, seconds. So a device that never stops sending is read at 50 kB/s, which
#: is several times what a counter's line carries, and the processor stays free for the node.
MAX_READ = 1024
GATHER_S = 0.02
#: How long `close` waits for the thread, seconds. A thread that hangs in the kernel ends with the process.
CLOSE_S = 2.0


class Patience(NamedTuple):
    """How long to wait, seconds."""

    first_pause: float = 0.25
    """Pause after a port was lost. From then on the pauses double."""
    longest_pause: float = 2.0
    silence: float = 20.0
    """A port without valid input for this long is opened again. An adapter that hangs may recover this way."""


class SerialSensor(Sensor):
    """Readings from a device. Its port is opened again indefinitely, with growing pauses."""

    def __init__(
        self,
        port: str,
        baud: int,
        protocol: Protocol,
        meter: DoseMeter,
        now: Callable[[], float],
        patience: Patience = Patience(),  # noqa: B008 (it cannot be changed)
    ) -> None:
        """:param port: a device file. Names below /dev/serial/by-id do not depend on the order of plugging in.
        :param baud: bit/s, 8N1.
        :param now: the driver's timeline, seconds; called on the sensor's thread.
        :raises ConfigError: pyserial is not installed.
        """
        super().__init__(f"{port}:{baud}")
        try:
            import serial  # noqa: F401
        except ImportError:
            raise ConfigError(f"sensor.type: a serial port needs pyserial: {installing('drone')}") from None
        self._port = port
        self._baud = baud
        self._protocol = protocol
        self._meter = meter
        self._now = now
        self._patience = patience
        self._readings: deque[SensorReading] = deque(maxlen=MAX_WAITING)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._wake: Callable[[], None] = lambda: None  # until `start`
        self._connected = False
        self._count = 0
        self._dropped = 0
        self._connections = 0
        self._trouble = ""
        self._ended = False

    def start(self, wake: Callable[[], None]) -> None:
        """Start, on the running event loop."""
        loop = asyncio.get_running_loop()

        def from_thread() -> None:
            try:
                loop.call_soon_threadsafe(wake)
            except RuntimeError:
                # The loop was closed while this thread hung in the kernel.
                self._stop.set()

        self._wake = from_thread
        self._thread = threading.Thread(target=self._run, name="sensor", daemon=True)
        self._thread.start()

    def receive(self) -> list[SensorReading]:
        """The readings since the last call."""
        if self._ended and not self._stop.is_set():
            # A bug of ours, which Python has printed. A sensor that only seems silent would hide it.
            raise RuntimeError(f"the thread of sensor {self.name} has ended")
        # Only as many as there are now, because the thread adds more.
        return [self._readings.popleft() for _ in range(len(self._readings))]

    def state(self) -> SensorState:
        """Its state."""
        return SensorState(
            self._connected, self._count, self._protocol.malformed, self._meter.saturated, self._dropped,
            self._connections, self._trouble or self._protocol.trouble,
        )  # fmt: skip

    def close(self) -> None:
        """Stop the thread, which closes the port."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    # -- on the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._keep_connecting()
        finally:
            self._ended = True
            self._wake()

    def _keep_connecting(self) -> None:
        pause = self._patience.first_pause
        while not self._stop.is_set():
            heard = self._protocol.heard
            try:
                with _opened(self._port, self._baud) as port:
                    self._connected = True
                    self._connections += 1
                    self._wake()
                    self._talk(port)
            except (LinkError, OSError, termios.error) as error:
                # pyserial lets the last two through when a device vanishes during a call.
                self._connected = False
                self._tell(_reason(error))
            self._connected = False
            if self._protocol.heard != heard:
                pause = self._patience.first_pause
            if self._stop.wait(pause):
                return
            pause = min(2.0 * pause, self._patience.longest_pause)

    def _talk(self, port: serial.Serial) -> None:
        """Until the port is lost or silent, or the sensor is closed."""
        protocol = self._protocol
        protocol.reset()
        heard, heard_at = protocol.heard, self._now()
        while not self._stop.is_set():
            question = protocol.ask(self._now())
            if question:
                port.write(question)
            data = port.read(1)
            if data and port.in_waiting:
                data += port.read(min(port.in_waiting, MAX_READ - 1))
            now = self._now()
            samples = protocol.feed(data, now)
            for sample in samples:
                self._take(SensorReading(self._meter.reading(sample.cpm, sample.cpm_per_usvh), sample.at))
            if samples:
                # Once for all of them: waking the loop takes time.
                self._wake()
            if data:
                self._stop.wait(GATHER_S)
            if protocol.heard != heard:
                heard, heard_at = protocol.heard, now
            elif now - heard_at > self._patience.silence:
                why = f" ({protocol.trouble})" if protocol.trouble else ""
                raise LinkError(f"no valid input for {self._patience.silence:g} s{why}")

    def _take(self, reading: SensorReading) -> None:
        if self._trouble:
            self._trouble = ""
            log.warning("sensor %s: working again", self.name)
        # One thread appends, another removes. In between, at most one reading too many is counted as dropped.
        self._dropped += len(self._readings) == MAX_WAITING
        self._readings.append(reading)
        self._count += 1

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:
            # Log it once until it changes: a missing port stays missing for many attempts.
            self._trouble = trouble
            log.warning("sensor %s: %s", self.name, trouble)
            self._wake()


def open_counter(settings: SensorSettings, now: Callable[[], float]) -> SerialSensor:
    """Open the counter of a configuration; `now`: the driver's timeline. Raises `ConfigError`: pyserial is missing."""
    assert settings.port is not None
    kind = settings.kind
    return SerialSensor(settings.port, settings.baud or kind.baud, resolve_name(kind.protocol)(), settings.meter(), now)


def _opened(port: str, baud: int) -> serial.Serial:
    import serial

    try:
        # Exclusive: otherwise two programs on one port each get half of the bytes.
        return serial.Serial(port, baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        raise LinkError(f"{error}".lower()) from None


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno:
        in_use = error.errno in (errno.EWOULDBLOCK, errno.EBUSY)
        return "in use by another program" if in_use else os.strerror(error.errno).lower()
    return str(error) if isinstance(error, LinkError) else " ".join(str(error).split()).lower()
