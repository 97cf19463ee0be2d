"""The connection to the autopilot over a stream. The port is opened by `start`, and again whenever it is lost."""

from __future__ import annotations

from .address import VehicleUrl
from .serialport import SerialOpener
from .stream import StreamPort
from .tcp import TcpOpener
from .vehicle import VehiclePort


class VehicleStream(StreamPort, VehiclePort):
    """Bytes from and to the autopilot, through a serial port or TCP."""

    def __init__(self, url: VehicleUrl) -> None:
        super().__init__(SerialOpener(*url.address) if url.mode == "serial" else TcpOpener(url.address))

    def receive(self) -> list[bytes]:
        """The bytes of one turn, in pieces that end anywhere."""
        return [data for data, _ in self.take()]

    def _send(self, frame: bytes) -> None:
        self.write(frame)
