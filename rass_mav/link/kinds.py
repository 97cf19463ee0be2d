"""The links to neighbours that a configuration can name, one row each. A node loads the modules of its own
ones only."""

from __future__ import annotations

from typing import NamedTuple


class LinkKind(NamedTuple):
    """A type of link."""

    link: str
    """`module:name` of a `Link` with two class methods more: `check(section, key)` raises `ConfigError` for what cannot
    be set; `of(section, vehicle)` makes it, or raises `LinkError`."""
    keys: tuple[str, ...] = ()
    """Keys of `LinkSection` that cannot be set for types which do not list them."""
    shared: bool = True
    """Everybody hears everybody, so airtime is bounded and nodes listen before they speak. False: nodes have
    addresses."""
    forwarded: bool = False
    """Who is heard may be many hops away, unless `one_hop` says otherwise."""
    through: bool = False
    """It goes through the autopilot's port."""


KINDS: dict[str, LinkKind] = {
    "udp": LinkKind("rass_mav.link.udp:UdpLink", ("peers", "broadcast", "multicast", "interface"), shared=False),
    "serial": LinkKind("rass_mav.link.radio:SerialLink", ("device",)),
    "autopilot": LinkKind("rass_mav.link.radio:AutopilotLink", forwarded=True, through=True),
}
