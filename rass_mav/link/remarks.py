"""Settings of a UDP link that do not fit the computer's present state, although they may fit later."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rass_mav.errors import LinkError

from .address import parse_address, parse_multicast
from .base import Remark
from .interface import (
    ANY_ADDRESS,
    EVERY_NETWORK,
    Interface,
    carriers,
    find_interface,
    interface_to,
    interfaces,
    is_address,
    listed,
)
from .settings import LinkSection
from .sockets import is_local


def remarks(section: LinkSection, key: str) -> Iterator[Remark]:
    """Remarks on a checked link. `key`: its section's key. Host names are not looked up."""
    known = interfaces()
    own = parse_address(section.listen, any_port=True)[0]
    if is_address(own) and own != ANY_ADDRESS and not is_local(own):
        yield Remark(
            f"{key}.listen", f"{own} is not an address of this computer ({listed(known)})", f"correct {key}.listen"
        )
    chosen = section.interface
    if chosen is not None:
        try:
            find_interface(chosen)
        except LinkError as error:
            yield Remark(f"{key}.interface", error.text, f"correct {key}.interface; {error.remedy}")
            return
    targets = [parse_address(peer.address)[0] for peer in section.peers]
    if section.broadcast is not None:
        targets.append(parse_address(section.broadcast)[0])
        yield from _about_broadcast(targets[-1], section, key, known)
    if section.multicast is not None:
        targets.append(parse_multicast(section.multicast)[0])
        if chosen is None and interface_to(targets[-1], known) is None:
            yield Remark(
                f"{key}.multicast", f"{targets[-1]} leaves on no interface ({listed(known)})",
                f"set {key}.interface",
            )  # fmt: skip
    ways = carriers(filter(is_address, targets), chosen)
    for way in ways:
        if way.trouble:
            yield Remark(key, way.trouble, way.remedy, works=not all(other.trouble for other in ways))


def _about_broadcast(host: str, section: LinkSection, key: str, known: Sequence[Interface]) -> Iterator[Remark]:
    remedy = f"set {key}.broadcast to the broadcast address of the drones' network"
    if host == EVERY_NETWORK:
        if section.interface is not None:
            return
        way = interface_to(host, known)
        outside = {interface.name for interface in known if not interface.network.is_loopback}
        if way is None:
            yield Remark(f"{key}.broadcast", f"{host} leaves on no interface ({listed(known)})", remedy)
        elif len(outside) > 1:
            yield Remark(
                f"{key}.broadcast", f"{host} leaves on {way.name} only, one of {len(outside)} networks"
                f" ({listed(known)})", remedy, works=True,
            )  # fmt: skip
    elif is_address(host) and all(interface.broadcast != host for interface in known):
        yield Remark(
            f"{key}.broadcast", f"{host} is the broadcast address of no interface ({listed(known)})",
            f"join the drones' network, or correct {key}.broadcast",
        )  # fmt: skip
