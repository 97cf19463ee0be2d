"""Links on which every node hears everything: a serial radio, and the autopilot's port."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from rass_mav.config.sections import under
from rass_mav.errors import ConfigError

from .address import parse_serial
from .base import Address, Datagram, Link, LinkCounters, remember
from .budget import Budget
from .serialport import SerialOpener
from .settings import LinkSection
from .stream import Opener, StreamPort
from .vehicle import VehiclePort

#: Node ids that a link remembers as heard. When there are more, the longest silent one is forgotten.
MAX_HEARD = 512


class SharedLink(Link):
    """Nodes have no addresses: each frame goes to everybody. The link remembers which nodes were heard on it."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._heard: OrderedDict[int, None] = OrderedDict()

    def reaches(self, target: int) -> bool:
        """Whether the node has been heard on this link."""
        return target in self._heard

    def learn(self, node_id: int, source: Address) -> None:
        """Remember a node that was heard on this link."""
        remember(self._heard, node_id, None, MAX_HEARD)


class SerialLink(StreamPort, SharedLink):
    """A telemetry radio on a serial port. The port is opened by `start`, and again when it is lost."""

    def __init__(self, opener: Opener) -> None:
        SharedLink.__init__(self, opener.name)
        StreamPort.__init__(self, opener)

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Raise `ConfigError` for invalid settings of such a link. `key`: the section's key."""
        if section.device is None:
            raise ConfigError(f"{key}.device: missing, expected a serial port, for example /dev/ttyUSB0,57600")
        with under(f"{key}.device"):
            parse_serial(section.device)

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> SerialLink:
        """Create the link of a checked configuration."""
        assert section.device is not None
        return cls(SerialOpener(*parse_serial(section.device), flow_control=section.flow_control))

    @staticmethod
    def usual(section: LinkSection) -> Budget:
        """What a known radio carries, or its serial port if that is slower: ten bits a byte."""
        budget = Link.usual(section)
        if section.radio is None or section.device is None:
            return budget
        return budget._replace(bytes_s=min(budget.bytes_s, parse_serial(section.device)[1] / 10))

    def receive(self) -> list[Datagram]:
        """The bytes of one turn, in pieces that end anywhere."""
        return self.take()

    def send(self, frame: bytes, target: int) -> None:
        """Send to everybody."""
        self.write(frame)


class AutopilotLink(SharedLink):
    """Through the autopilot, which forwards frames to its radio. It shares the port with the connection to the vehicle.

    The port's owner reads it, and calls `took` for each frame from the neighbours.
    """

    through = True

    def __init__(self, vehicle: VehiclePort) -> None:
        super().__init__("autopilot")
        self._vehicle = vehicle
        self._took = 0
        self._sent = 0
        self._dropped = 0

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Such a link has no settings of its own."""

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> AutopilotLink:
        """Create the link of a checked configuration."""
        assert vehicle is not None
        return cls(vehicle)

    def start(self, wake: Callable[[], None]) -> None:
        """Nothing: the port's owner starts it."""

    def receive(self) -> list[Datagram]:
        """Nothing: the port's owner reads it."""
        return []

    def took(self) -> None:
        """Count a frame from the neighbours, received by the port's owner."""
        self._took += 1

    def send(self, frame: bytes, target: int) -> None:
        """Send to everybody, through the autopilot."""
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
        """The counters so far. Frames that the open port dropped because it was full are counted only there."""
        return LinkCounters(self._sent, self._took, 0, self._dropped, 0)

    def close(self) -> None:
        """Nothing: the port's owner closes it."""
