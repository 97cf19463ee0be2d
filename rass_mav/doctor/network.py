"""UDP links: are the addresses of this computer's networks?"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from rass_mav.errors import LinkError
from rass_mav.link.address import parse_address, resolve
from rass_mav.link.interface import EVERY_NETWORK, find_interface
from rass_mav.link.settings import LinkSection
from rass_mav.link.sockets import is_local

from .finding import Finding, failed, passed, warned

#: How long a name may take to be looked up, seconds.
LOOKUP_S = 2.0


class Interface(NamedTuple):
    """A network interface with an IPv4 address."""

    name: str
    address: str
    broadcast: str


def interfaces() -> list[Interface]:
    """Those of this computer that have an IPv4 address, the first one of each."""
    found = []
    for _, name in socket.if_nameindex():
        with contextlib.suppress(LinkError):  # it has no IPv4 address
            own = find_interface(name)
            found.append(Interface(name, own.address, own.broadcast or "0.0.0.0"))
    return found


def link_address(index: int, link: LinkSection, known: Sequence[Interface]) -> Finding:
    """Where a UDP link sends to, and from where. `known`: the interfaces."""
    name = f"links[{index}] address"
    host = parse_address(link.listen, any_port=True)[0]
    wanted = [host, *(parse_address(peer.address)[0] for peer in link.peers)]
    if link.broadcast is not None:
        wanted.append(parse_address(link.broadcast)[0])
    for each in wanted:
        if not is_known(each):
            return failed(name, f"the name {each} is not known", "write the IPv4 address instead, or see /etc/hosts")
    listed = ", ".join(f"{i.name} {i.address} with broadcast {i.broadcast}" for i in known) or "none"
    for key, own in (("listen", host), ("interface", link.interface)):
        if own not in (None, "0.0.0.0") and not is_local(resolve((own, 0), name)[0]):
            return failed(
                name, f"{own} is no address of this computer (it has {listed})", f"correct links[{index}].{key}"
            )
    if link.broadcast is None:
        way = f"group {link.multicast}" if link.multicast else f"{len(link.peers)} peers"
        return passed(name, f"{link.listen} to {way}")
    broadcast = parse_address(link.broadcast)[0]
    outside = [i for i in known if not ipaddress.IPv4Address(i.address).is_loopback]
    if broadcast == EVERY_NETWORK:
        if len(outside) > 1:
            return warned(
                name, f"{broadcast} leaves on one of {len(outside)} networks only ({listed})",
                f"write the broadcast address of the drones' network into links[{index}].broadcast",
            )  # fmt: skip
        return passed(name, f"broadcast to {broadcast}")
    on = [i.name for i in known if i.broadcast == resolve((broadcast, 0), name)[0]]
    if not on:
        return failed(
            name, f"{broadcast} is the broadcast address of no interface (there are {listed})",
            f"join the drones' network, or correct links[{index}].broadcast",
        )  # fmt: skip
    return passed(name, f"broadcast to {broadcast} on {on[0]}")


@lru_cache(64)
def is_known(host: str) -> bool:
    """Whether the name service knows a host, and says so in time."""
    known: list[bool] = []

    def look() -> None:
        try:
            resolve((host, 0), host)
            known.append(True)
        except LinkError:
            known.append(False)

    # A name service that is not reached would take half a minute; the thread may hang on, it ends with the process.
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    thread.join(LOOKUP_S)
    return bool(known) and known[0]
