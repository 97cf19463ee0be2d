"""A counter on a serial port. A thread of its own talks to it: a USB device that hangs must not stop the heartbeat.

pyserial is imported when the first port is opened; nodes without a serial sensor do without it.
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

#: How long a read waits, seconds: so often questions are considered.
READ_S = 0.1
#: A question that is not sent after so long never will be, seconds.
WRITE_S = 1.0
#: Bytes read at once, and the pause after them, seconds: a device that never stops talking is read at 50 kB/s, several
#: times what a counter's line carries, and leaves the processor to the node.
MAX_READ = 1024
GATHER_S = 0.02
#: How long `close` waits for the thread, seconds; one that hangs in the kernel ends with the process.
CLOSE_S = 2.0


class Patience(NamedTuple):
    """How long to wait, seconds."""

    first_pause: float = 0.25
    """After a port was lost; the pauses double from then on."""
    longest_pause: float = 2.0
    silence: float = 20.0
    """A port on which nothing sensible was heard for so long is opened anew; adapters that hang may recover by it."""


class SerialSensor(Sensor):
    """Readings from a device; its port is opened again for ever, with growing pauses."""

    def __init__(
        self,
        port: str,
        baud: int,
        protocol: Protocol,
        meter: DoseMeter,
        now: Callable[[], float],
        patience: Patience = Patience(),  # noqa: B008 (it cannot be changed)
    ) -> None:
        """:param port: a device file; names below /dev/serial/by-id survive another order of plugging in.
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
        self._wake: Callable[[], None] = lambda: None  # nobody is listening yet
        self._connected = False
        self._count = 0
        self._dropped = 0
        self._connections = 0
        self._trouble = ""
        self._ended = False

    def start(self, wake: Callable[[], None]) -> None:
        """Begin, on the running event loop."""
        loop = asyncio.get_running_loop()

        def from_thread() -> None:
            try:
                loop.call_soon_threadsafe(wake)
            except RuntimeError:
                # The loop has been closed while this thread hung in the kernel.
                self._stop.set()

        self._wake = from_thread
        self._thread = threading.Thread(target=self._run, name="sensor", daemon=True)
        self._thread.start()

    def receive(self) -> list[SensorReading]:
        """The readings since the last call."""
        if self._ended and not self._stop.is_set():
            # A bug of ours, which Python has printed; a sensor that just looks silent would hide it.
            raise RuntimeError(f"the thread of sensor {self.name} has ended")
        # As many as there are now: the thread goes on.
        return [self._readings.popleft() for _ in range(len(self._readings))]

    def state(self) -> SensorState:
        """How it is."""
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
            self._connect_for_ever()
        finally:
            self._ended = True
            self._wake()

    def _connect_for_ever(self) -> None:
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
                # pyserial lets both others through where a device vanishes in the middle of a call.
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
                # Once for all of them: what wakes the loop waits there.
                self._wake()
            if data:
                self._stop.wait(GATHER_S)
            if protocol.heard != heard:
                heard, heard_at = protocol.heard, now
            elif now - heard_at > self._patience.silence:
                why = f" ({protocol.trouble})" if protocol.trouble else ""
                raise LinkError(f"nothing sensible heard for {self._patience.silence:g} s{why}")

    def _take(self, reading: SensorReading) -> None:
        if self._trouble:
            self._trouble = ""
            log.warning("sensor %s: reads again", self.name)
        # One thread appends, one takes away; what is counted too much in between is one reading.
        self._dropped += len(self._readings) == MAX_WAITING
        self._readings.append(reading)
        self._count += 1

    def _tell(self, trouble: str) -> None:
        if trouble != self._trouble:
            # Once, until something else happens: a port that is away stays away for many tries.
            self._trouble = trouble
            log.warning("sensor %s: %s", self.name, trouble)
            self._wake()


def open_counter(settings: SensorSettings, now: Callable[[], float]) -> SerialSensor:
    """The counter of a configuration, `now` on the driver's timeline. Raises `ConfigError`: pyserial is missing."""
    assert settings.port is not None
    kind = settings.kind
    return SerialSensor(settings.port, settings.baud or kind.baud, resolve_name(kind.protocol)(), settings.meter(), now)


def _opened(port: str, baud: int) -> serial.Serial:
    import serial

    try:
        # Exclusive: two programs on one port each get half of the bytes.
        return serial.Serial(port, baud, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except ValueError as error:
        raise LinkError(f"{error}".lower()) from None


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno:
        in_use = error.errno in (errno.EWOULDBLOCK, errno.EBUSY)
        return "in use by another program" if in_use else os.strerror(error.errno).lower()
    return str(error) if isinstance(error, LinkError) else " ".join(str(error).split()).lower()
