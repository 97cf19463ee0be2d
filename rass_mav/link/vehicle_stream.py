"""The way to the autopilot over a stream: a serial port, or TCP."""

from __future__ import annotations

from collections.abc import Callable

from .address import VehicleUrl
from .base import LinkCounters
from .serialport import SerialOpener
from .stream import Opener, StreamPort
from .tcp import TcpOpener
from .vehicle import VehicleLink, VehiclePort


class VehicleStream(VehiclePort):
    """Bytes from and to the autopilot. The port is opened on `start`, and again for ever when it is lost."""

    stream = True

    def __init__(self, opener: Opener) -> None:
        self.port = StreamPort(opener)
        self.name = self.port.name

    def start(self, wake: Callable[[], None]) -> None:
        """Begin to open and read the port."""
        self.port.start(wake)

    @property
    def generation(self) -> int:
        """How often the port was opened."""
        return self.port.generation

    @property
    def trouble(self) -> str:
        """Why the port is not open; empty while it is."""
        return self.port.trouble

    def receive(self) -> list[bytes]:
        """What has arrived, in pieces that end anywhere."""
        return [data for data, _ in self.port.receive()]

    def send(self, frame: bytes) -> None:
        """Send to the autopilot."""
        self.port.send(frame)

    def counters(self) -> LinkCounters:
        """What has been done so far. Received are pieces of the stream."""
        port = self.port
        return LinkCounters(port.sent, port.received, 0, port.dropped, 0)

    def close(self) -> None:
        """Close the port."""
        self.port.close()


def open_vehicle(url: VehicleUrl) -> VehiclePort:
    """The port that a connection string names. Raises `LinkError` if it can never be opened (UDP); others wait."""
    if url.mode == "serial":
        return VehicleStream(SerialOpener(*url.address))
    if url.mode == "tcp":
        return VehicleStream(TcpOpener(url.address))
    return VehicleLink(url)
