"""Links on which everybody hears everything: a serial radio, and the way through the autopilot's port."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from rass_mav.config.sections import under
from rass_mav.errors import ConfigError

from .address import parse_serial
from .base import Address, Datagram, Link, LinkCounters, remember
from .serialport import SerialOpener
from .settings import LinkSection
from .stream import Opener, OverStream, StreamPort
from .vehicle import VehiclePort

#: Node ids heard that a link remembers; beyond it the longest silent one is forgotten.
MAX_HEARD = 512


class SharedLink(Link):
    """Nobody has an address: each frame goes to everybody. The link remembers who has been heard on it."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._heard: OrderedDict[int, None] = OrderedDict()

    def reaches(self, target: int) -> bool:
        """Whether the node has been heard here."""
        return target in self._heard

    def learn(self, node_id: int, source: Address) -> None:
        """The node has been heard here."""
        remember(self._heard, node_id, None, MAX_HEARD)


class SerialLink(OverStream, SharedLink):
    """A telemetry radio (SiK, RFD) on a serial port. The port is opened on `start`, and again when it is lost."""

    def __init__(self, opener: Opener) -> None:
        self.port = StreamPort(opener)
        super().__init__(self.port.name)

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Raise `ConfigError` for what cannot be set of such a link. `key`: of the section."""
        if section.device is None:
            raise ConfigError(f"{key}.device: missing, expected a serial port, as /dev/ttyUSB0,57600")
        with under(f"{key}.device"):
            parse_serial(section.device)

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> SerialLink:
        """The link of a configuration that was checked."""
        assert section.device is not None
        return cls(SerialOpener(*parse_serial(section.device), flow_control=section.flow_control))

    def receive(self) -> list[Datagram]:
        """What has arrived, in pieces that end anywhere."""
        return self.port.receive()

    def send(self, frame: bytes, target: int) -> None:
        """To everybody."""
        self.port.send(frame)


class AutopilotLink(SharedLink):
    """Through the autopilot, which passes frames on to its radio. It shares the port with the way to the vehicle.

    The port's owner reads it, and says with `took` what was for the neighbours.
    """

    def __init__(self, vehicle: VehiclePort) -> None:
        super().__init__("autopilot")
        self._vehicle = vehicle
        self._took = 0
        self._sent = 0
        self._dropped = 0

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Nothing of its own can be set of such a link."""

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> AutopilotLink:
        """The link of a configuration that was checked."""
        assert vehicle is not None
        return cls(vehicle)

    def start(self, wake: Callable[[], None]) -> None:
        """Nothing: the port's owner starts it."""

    def receive(self) -> list[Datagram]:
        """Nothing: the port's owner reads it."""
        return []

    def took(self) -> None:
        """The port's owner has taken in a frame from the neighbours."""
        self._took += 1

    def send(self, frame: bytes, target: int) -> None:
        """To everybody, by way of the autopilot."""
        if self._vehicle.trouble:
            self._dropped += 1
        else:
            self._sent += 1
        self._vehicle.send(frame)

    @property
    def trouble(self) -> str:
        """Why the port is not open; empty while it is."""
        return self._vehicle.trouble

    def counters(self) -> LinkCounters:
        """What has been done so far. What the open port dropped for want of room is counted there only."""
        return LinkCounters(self._sent, self._took, 0, self._dropped, 0)

    def close(self) -> None:
        """Nothing: the port's owner closes it."""
