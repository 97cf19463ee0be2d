"""The connection to an autopilot, whatever the port is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from pkgutil import resolve_name

from .address import VehicleUrl
from .base import Port
from .kinds import VEHICLE_PORTS


class VehiclePort(Port):
    """Bytes from and to the autopilot. Each class is created from a `VehicleUrl`."""

    sign: Callable[[bytes], bytes] | None = None
    """Appends the signature to each frame as it leaves; None: nothing is signed. Whoever reads the frames that come in
    checks theirs."""

    @abstractmethod
    def receive(self) -> list[bytes]:
        """The bytes of one turn (`base.MAX_TURN`)."""

    def send(self, frame: bytes) -> None:
        """Send a frame, whole or not at all."""
        self._send(frame if self.sign is None else self.sign(frame))

    @abstractmethod
    def _send(self, frame: bytes) -> None:
        """Send a frame as it is."""


def open_vehicle(url: VehicleUrl) -> VehiclePort:
    """Open the port of a connection string. Raises `LinkError` if it can never be opened (UDP); others wait."""
    port: VehiclePort = resolve_name(VEHICLE_PORTS[url.mode])(url)
    return port
