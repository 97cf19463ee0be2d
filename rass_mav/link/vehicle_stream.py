"""The connection to the autopilot over a stream: a serial port, or TCP."""

from __future__ import annotations

from .address import VehicleUrl
from .serialport import SerialOpener
from .stream import Opener, OverStream, StreamPort
from .tcp import TcpOpener
from .vehicle import VehicleLink, VehiclePort


class VehicleStream(OverStream, VehiclePort):
    """Bytes from and to the autopilot. The port is opened by `start`, and again indefinitely when it is lost."""

    def __init__(self, opener: Opener) -> None:
        self.port = StreamPort(opener)
        self.name = self.port.name

    def receive(self) -> list[bytes]:
        """The bytes of one turn, in pieces that end anywhere."""
        return [data for data, _ in self.port.receive()]

    def send(self, frame: bytes) -> None:
        """Send to the autopilot."""
        self.port.send(frame)


def open_vehicle(url: VehicleUrl) -> VehiclePort:
    """Open the port of a connection string. Raises `LinkError` if it can never be opened (UDP); others wait."""
    if url.mode == "serial":
        return VehicleStream(SerialOpener(*url.address))
    if url.mode == "tcp":
        return VehicleStream(TcpOpener(url.address))
    return VehicleLink(url)
