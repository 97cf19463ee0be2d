"""The links of a configuration: their keys, and how they are opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Literal

from rass_mav.agent.settings import Positive
from rass_mav.config.sections import Meta, Section
from rass_mav.errors import ConfigError
from rass_mav.link.address import parse_address, parse_multicast, parse_serial
from rass_mav.link.airtime import FRAME_BYTES, Budget
from rass_mav.link.base import Link
from rass_mav.link.interface import is_address, is_name
from rass_mav.link.radio import AutopilotLink, SerialLink
from rass_mav.link.serialport import SerialOpener
from rass_mav.link.udp import Peer, UdpLink
from rass_mav.link.vehicle import VehiclePort

NodeId = Annotated[int, Meta(ge=0, le=65534)]
#: Listening before speaking on a shared radio: the airtime of so many full frames.
_LISTEN_FRAMES = 4


class PeerSection(Section):
    """A neighbour with a known address."""

    address: str
    """host:port"""
    id: NodeId | None = None
    """Its node id; null: learned from its beacons."""


class AirtimeSection(Section):
    """What may be sent on a link."""

    bytes_s: Positive = 5760.0
    """What the link carries in all, bytes/s; 57,600 bit/s are 5760."""
    duty: Annotated[float, Meta(gt=0, le=1)] = 0.3
    """Part of it that this swarm takes, all nodes in range together."""
    beacons: Annotated[float, Meta(gt=0, lt=1)] = 0.3
    """Part of what the swarm takes that is for beacons; they become rarer when more neighbours are heard."""
    burst_bytes: Annotated[int, Meta(ge=FRAME_BYTES)] = 512
    """Never more bytes at once; ArduPilot's buffer has 1024."""
    burst_frames: Annotated[int, Meta(ge=1)] = 2
    """Never more frames at once; PX4's buffer holds 2."""
    frames_s: Positive = 100.0
    """Never more frames a second."""

    def budget(self, *, shared: bool) -> Budget:
        """The same for the pacer. `shared`: everybody hears everybody, so one listens before one speaks."""
        listen_s = _LISTEN_FRAMES * FRAME_BYTES / self.bytes_s if shared else 0.0
        return Budget(
            self.bytes_s, self.duty, self.beacons, self.burst_bytes, self.burst_frames, self.frames_s, listen_s
        )


class LinkSection(Section):
    """A link to the neighbours."""

    type: Literal["udp", "serial", "autopilot"] = "udp"
    """udp; serial: a telemetry radio on a serial port; autopilot: through the autopilot's port and its radio."""
    device: str | None = None
    """serial: the port and its speed, as `/dev/ttyUSB0,57600`."""
    flow_control: bool = False
    """serial: RTS/CTS."""
    one_hop: bool | None = None
    """Who is heard is one hop away; null: true, but false through the autopilot."""
    only: tuple[NodeId, ...] | None = None
    """Only these node ids are taken for neighbours on this link; null: all. A limit for links with forwarding."""
    airtime: AirtimeSection | None = None
    """What may be sent; null: for udp as much as one likes, for the others the defaults of this section."""
    listen: str = "0.0.0.0:14600"
    """Own address and port; port 0: any."""
    peers: tuple[PeerSection, ...] = ()
    """Neighbours that are sent to one by one."""
    broadcast: str | None = None
    """Broadcast address and port, as 192.168.4.255:14600 or 255.255.255.255:14600; null: none."""
    multicast: str | None = None
    """Multicast group and port, as 239.255.82.83:14601; null: none."""
    interface: str | None = None
    """Network interface for multicast and for broadcast to 255.255.255.255, by name (wlan0) or by its own IPv4
    address (multicast only); null: the system chooses."""
    ttl: Annotated[int, Meta(ge=0, le=255)] = 1
    """Multicast frames pass so many routers less one."""

    def check(self, key: str) -> None:
        """Raise `ConfigError` for what cannot be. `key`: of this link."""
        of_udp = {"peers": self.peers, "broadcast": self.broadcast, "multicast": self.multicast}
        if self.type != "udp":
            for name, value in {**of_udp, "interface": self.interface}.items():
                if value:
                    raise ConfigError(f"{key}.{name}: belongs to type udp, this link is {self.type}")
        if self.type == "serial":
            if self.device is None:
                raise ConfigError(f"{key}.device: missing, expected a serial port, as /dev/ttyUSB0,57600")
            with under(f"{key}.device"):
                parse_serial(self.device)
            return
        if self.device is not None:
            raise ConfigError(f"{key}.device: belongs to type serial, this link is {self.type}")
        if self.type == "autopilot":
            return
        with under(f"{key}.listen"):
            parse_address(self.listen, any_port=True)
        for index, peer in enumerate(self.peers):
            with under(f"{key}.peers[{index}].address"):
                parse_address(peer.address)
        if self.broadcast is not None:
            with under(f"{key}.broadcast"):
                parse_address(self.broadcast)
        if self.multicast is not None:
            with under(f"{key}.multicast"):
                parse_multicast(self.multicast)
        if self.interface is not None:
            with under(f"{key}.interface"):
                _check_interface(self.interface)
        if not self.peers and self.broadcast is None and self.multicast is None:
            raise ConfigError(f"{key}: expected at least one of peers, broadcast and multicast")

    def open(self, vehicle: VehiclePort | None) -> Link:
        """The link. `vehicle`: the autopilot's port. Raises `LinkError`."""
        airtime = self.airtime
        link: Link
        if self.type == "udp":
            link = UdpLink(
                parse_address(self.listen, any_port=True),
                peers=[Peer(parse_address(peer.address), peer.id) for peer in self.peers],
                broadcast=None if self.broadcast is None else parse_address(self.broadcast),
                multicast=None if self.multicast is None else parse_multicast(self.multicast),
                interface=self.interface,
                ttl=self.ttl,
            )
        else:
            airtime = airtime or AirtimeSection()
            if self.type == "serial":
                assert self.device is not None
                link = SerialLink(SerialOpener(*parse_serial(self.device), flow_control=self.flow_control))
            else:
                assert vehicle is not None
                link = AutopilotLink(vehicle)
        link.budget = None if airtime is None else airtime.budget(shared=self.type != "udp")
        link.one_hop = self.type != "autopilot" if self.one_hop is None else self.one_hop
        link.only = None if self.only is None else frozenset(self.only)
        return link


@contextmanager
def under(key: str) -> Iterator[None]:
    """Put a key in front of the `ConfigError`s of a block."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None


def _check_interface(text: str) -> None:
    if not is_address(text) and not is_name(text):
        raise ConfigError(f"expected the name of a network interface or its own IPv4 address, got {text!r}")
