"""What can be set of the links to the neighbours (docs/links.md)."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Annotated

from rass_mav.config.bounds import NodeId, Positive
from rass_mav.config.sections import Meta, Mistakes, Section

from .airtime import FRAME_BYTES, Budget
from .base import Link, Remark
from .kinds import KINDS, LinkKind
from .vehicle import VehiclePort

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

    type: Annotated[str, Meta(one_of=KINDS.keys)] = "udp"
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
    address; null: the system chooses."""
    ttl: Annotated[int, Meta(ge=0, le=255)] = 1
    """Multicast frames pass so many routers less one."""

    @property
    def kind(self) -> LinkKind:
        """Its row in the registry."""
        return KINDS[self.type]

    @property
    def direct(self) -> bool:
        """Whether who is heard is one hop away."""
        return not self.kind.forwarded if self.one_hop is None else self.one_hop

    def check(self, key: str) -> None:
        """Raise `ConfigError` for what cannot be. `key`: of this link."""
        mistakes = Mistakes()
        for name, value in vars(self).items():
            types = [type for type, kind in KINDS.items() if name in kind.keys]
            if value and types and self.type not in types:
                mistakes.add(f"{key}.{name}", f"belongs to type {' or '.join(types)}, this link is {self.type}")
        with mistakes.gathering():
            resolve_name(self.kind.link).check(self, key)
        mistakes.check()

    def remarks(self, key: str) -> list[Remark]:
        """What does not fit this computer as it is now. `key`: of this link, which was checked."""
        link: type[Link] = resolve_name(self.kind.link)
        return list(link.remarks(self, key))

    def open(self, vehicle: VehiclePort | None) -> Link:
        """The link. `vehicle`: the autopilot's port. Raises `LinkError`."""
        kind = self.kind
        link: Link = resolve_name(kind.link).of(self, vehicle)
        if self.airtime is not None or kind.shared:
            link.budget = (self.airtime or AirtimeSection()).budget(shared=kind.shared)
        link.one_hop = self.direct
        link.only = None if self.only is None else frozenset(self.only)
        return link
