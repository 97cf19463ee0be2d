"""The links to neighbours and the ports to the autopilot that a configuration can name, one row each. A node loads only
the modules of its own."""

from __future__ import annotations

from typing import NamedTuple


class LinkKind(NamedTuple):
    """A type of link."""

    link: str
    """`module:name` of a `Link` with two more class methods: `check(section, key)` raises `ConfigError` for invalid
    settings; `of(section, vehicle)` creates the link, or raises `LinkError`."""
    keys: tuple[str, ...] = ()
    """Keys of `LinkSection` that can only be set for types that list them."""
    shared: bool = True
    """All nodes hear each other, so airtime is bounded and nodes listen before they send. False: nodes have
    addresses."""
    forwarded: bool = False
    """Nodes that are heard may be many hops away, unless `one_hop` is set."""
    through: bool = False
    """The link uses the autopilot's port."""
    ip: bool = False
    """It carries IP."""
    radio: bool = True
    """`radio` may name what is behind it; False: the type says it."""


KINDS: dict[str, LinkKind] = {
    "udp": LinkKind(
        "rass_mav.link.udp:UdpLink", ("peers", "broadcast", "multicast", "interface"), shared=False, ip=True
    ),
    "serial": LinkKind("rass_mav.link.radio:SerialLink", ("device",)),
    "rnode": LinkKind("rass_mav.link.rnode:RNodeLink", ("device", "rnode"), radio=False),
    "autopilot": LinkKind("rass_mav.link.radio:AutopilotLink", forwarded=True, through=True),
}

#: The ports to an autopilot or a ground station, by the mode of their `VehicleUrl`: `module:name` of a `VehiclePort`.
VEHICLE_PORTS = {
    "udpin": "rass_mav.link.vehicle_udp:VehicleLink",
    "udpout": "rass_mav.link.vehicle_udp:VehicleLink",
    "tcp": "rass_mav.link.vehicle_stream:VehicleStream",
    "serial": "rass_mav.link.vehicle_stream:VehicleStream",
}
