"""Settings of the links to the neighbours (docs/how-to/links.md)."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Annotated, Literal

from rass_mav.config.sections import Meta, Mistakes, NodeId, Positive, Section

from .base import Link, Remark
from .budget import FRAME_BYTES, USUAL, Budget
from .kinds import KINDS, LinkKind
from .radios import RADIOS, Radio
from .vehicle import VehiclePort

#: How long a node listens before it sends on a shared radio: the airtime of this many full frames.
_LISTEN_FRAMES = 4


class PeerSection(Section):
    """A neighbour with a known address."""

    address: str
    """host:port."""
    id: NodeId | None = None
    """Node id of the neighbour; null: learned from its beacons."""


class AirtimeSection(Section):
    """How much may be sent on a link."""

    bytes_s: Positive | None = None
    """Capacity of the link; null: that of `radio`, without one 5760, for 57,600 bit/s."""
    duty: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Share of the capacity for this swarm, all nodes in range together; null: 0.3, or what the region allows."""
    beacons: Annotated[float, Meta(gt=0, lt=1)] = 0.3
    """Share of that for beacons. With more neighbours, beacons become rarer."""
    burst_bytes: Annotated[int, Meta(ge=FRAME_BYTES)] = 512
    """Maximum bytes sent at once; ArduPilot's buffer has 1024."""
    burst_frames: Annotated[int, Meta(ge=1)] | None = None
    """Maximum frames sent at once; null: 2, as many as PX4's buffer holds, or what shares a packet."""
    frames_s: Positive = 100.0
    """Maximum frames per second."""

    def budget(self, *, shared: bool, usual: Budget = USUAL) -> Budget:
        """The settings for the pacer. `shared`: all nodes hear each other, so a node listens before it sends. `usual`:
        what holds where this section is silent."""
        bytes_s = usual.bytes_s if self.bytes_s is None else self.bytes_s
        return Budget(
            bytes_s,
            usual.duty if self.duty is None else self.duty,
            self.beacons,
            self.burst_bytes,
            usual.burst_frames if self.burst_frames is None else self.burst_frames,
            self.frames_s,
            _LISTEN_FRAMES * FRAME_BYTES / bytes_s if shared else 0.0,
            usual.packet_bytes,
        )


class RNodeSection(Section):
    """A LoRa modem with the RNode firmware. All nodes need the same values, except the power."""

    frequency_mhz: Annotated[float, Meta(ge=137, le=3000)]
    """Centre of the signal."""
    region: Literal["eu433", "eu868", "us915", "none"]
    """Region whose rules for unlicensed use apply; none: another one, whose rules `airtime.duty` must follow."""
    bandwidth_khz: Annotated[float, Meta(ge=7.8, le=1625)] = 125.0
    """Width of the signal."""
    spreading_factor: Annotated[int, Meta(ge=5, le=12)] = 7
    """Each step up reaches farther and takes almost twice the time."""
    coding_rate: Annotated[int, Meta(ge=5, le=8)] = 5
    """From 5, one check bit for four bits, to 8, four check bits."""
    power_dbm: Annotated[int, Meta(ge=0, le=37)] = 14
    """Power at the antenna."""


class LinkSection(Section):
    """Links to the neighbours (docs/how-to/links.md). A drone needs at least one."""

    type: Annotated[str, Meta(one_of=KINDS.keys)] = "udp"
    """udp: a network; serial: a telemetry radio on a serial port; rnode: a LoRa modem on a serial port; autopilot:
    through the autopilot and its radio."""
    device: str | None = None
    """serial, rnode: port and speed, for example `/dev/ttyUSB0,57600`."""
    flow_control: bool = False
    """serial, rnode: whether the port uses RTS/CTS."""
    rnode: RNodeSection | None = None
    """Type rnode: the modem. All nodes need the same values, except the power."""
    radio: Annotated[str, Meta(one_of=RADIOS.keys)] | None = None
    """The radio: it sets the defaults of `airtime` and which RADIO_STATUS counts; null: unknown."""
    one_hop: bool | None = None
    """Whether every node heard is one hop away; null: true, but false through an autopilot without `radio`."""
    only: tuple[NodeId, ...] | None = None
    """Node ids to accept as neighbours on this link, for links that forward; null: all."""
    airtime: AirtimeSection | None = None
    """How much may be sent; null: no limit for udp without `radio`, the defaults below otherwise."""
    listen: str = "0.0.0.0:14600"
    """udp: own address and port; port 0: any."""
    peers: tuple[PeerSection, ...] = ()
    """udp: neighbours to send to one by one, where broadcast and multicast do not work."""
    broadcast: str | None = None
    """udp: broadcast address and port, for example 192.168.4.255:14600 or 255.255.255.255:14600; null: none."""
    multicast: str | None = None
    """udp: multicast group and port, for example 239.255.82.83:14601. The port must differ from that of `listen`; null:
    none."""
    interface: str | None = None
    """udp: interface for multicast, and for broadcast to 255.255.255.255, by name (wlan0) or by its IPv4 address; null:
    the system chooses."""
    data: Literal["broadcast", "unicast"] = "unicast"
    """udp: how a frame for one neighbour is sent. unicast: to its address, once that is known, so that Wi-Fi
    acknowledges and repeats it; broadcast: to all, who overhear it."""
    ttl: Annotated[int, Meta(ge=0, le=255)] = 1
    """udp: one more than the number of routers that multicast frames may pass."""

    @property
    def kind(self) -> LinkKind:
        """Its row in the registry."""
        return KINDS[self.type]

    @property
    def known_radio(self) -> Radio | None:
        """The radio's row in the table; None: unknown."""
        return None if self.radio is None else RADIOS[self.radio]

    @property
    def direct(self) -> bool:
        """Whether nodes that are heard are one hop away."""
        if self.one_hop is not None:
            return self.one_hop
        return not self.kind.forwarded or self.radio is not None

    @property
    def budget(self) -> Budget | None:
        """What may be sent; None: no limit."""
        shared = self.kind.shared
        if self.airtime is None and self.radio is None and not shared:
            return None
        link: type[Link] = resolve_name(self.kind.link)
        return (self.airtime or AirtimeSection()).budget(shared=shared, usual=link.usual(self))

    def check(self, key: str) -> None:
        """Raise `ConfigError` for invalid settings. `key`: this link's key."""
        mistakes = Mistakes()
        for name, value in vars(self).items():
            types = [type for type, kind in KINDS.items() if name in kind.keys]
            if value and types and self.type not in types:
                mistakes.add(f"{key}.{name}", f"belongs to type {' or '.join(types)}, this link is {self.type}")
        radio = self.known_radio
        if radio is not None and radio.over_ip != self.kind.ip:
            fitting = sorted(type for type, kind in KINDS.items() if kind.ip == radio.over_ip and kind.radio)
            mistakes.add(f"{key}.radio", f"{self.radio} needs type {' or '.join(fitting)}, this link is {self.type}")
        elif radio is not None and not self.kind.radio:
            mistakes.add(f"{key}.radio", f"expected null with type {self.type}, which is a radio itself")
        with mistakes.gathering():
            resolve_name(self.kind.link).check(self, key)
        mistakes.check()

    def remarks(self, key: str) -> list[Remark]:
        """Settings that do not fit the computer's present state, after `check`. `key`: this link's key."""
        link: type[Link] = resolve_name(self.kind.link)
        return list(link.remarks(self, key))

    def open(self, vehicle: VehiclePort | None) -> Link:
        """Open the link. `vehicle`: the autopilot's port. Raises `LinkError`."""
        kind = self.kind
        link: Link = resolve_name(kind.link).of(self, vehicle)
        link.budget = self.budget
        link.radio = self.known_radio
        link.one_hop = self.direct
        link.only = None if self.only is None else frozenset(self.only)
        return link
