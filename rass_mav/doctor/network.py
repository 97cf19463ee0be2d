"""UDP links: do their addresses and interfaces fit this computer, and do the interfaces have a carrier?"""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import lru_cache

from rass_mav.errors import LinkError
from rass_mav.link.address import parse_address, resolve
from rass_mav.link.interface import carriers, is_address, wifi_driver
from rass_mav.link.settings import LinkSection, PeerSection

from .finding import Finding, failed, passed, warned

#: How long the lookup of a name may take, seconds.
LOOKUP_S = 2.0


def link_address(index: int, link: LinkSection) -> Finding:
    """The addresses of a UDP link, and whether the interfaces on the route have a carrier."""
    key = f"links[{index}]"
    name = f"{key} address"
    named = [text for text in (link.listen, link.broadcast, *(peer.address for peer in link.peers)) if text]
    for text in named:
        host = parse_address(text, any_port=True)[0]
        if not is_known(host):
            return failed(name, f"unknown host name {host}", "use its IPv4 address, or add it to /etc/hosts")
    found = {text: resolve(parse_address(text, any_port=True), name) for text in named}
    plain = {text: f"{host}:{port}" for text, (host, port) in found.items()}
    remarks = replace(
        link,
        listen=plain[link.listen],
        broadcast=link.broadcast and plain[link.broadcast],
        peers=tuple(PeerSection(address=plain[peer.address]) for peer in link.peers),
    ).remarks(key)
    if remarks:
        worst = min(remarks, key=lambda remark: remark.works)
        return (warned if worst.works else failed)(name, worst.text, worst.remedy)
    targets, hosts = [], [found[peer.address][0] for peer in link.peers]
    if link.broadcast is not None:
        targets.append(f"broadcast to {found[link.broadcast][0]}")
        hosts.append(found[link.broadcast][0])
    if link.multicast is not None:
        targets.append(f"group {link.multicast}")
        hosts.append(parse_address(link.multicast)[0])
    if link.peers:
        targets.append(f"{len(link.peers)} peers")
    ways = ", ".join(way.name for way in carriers(hosts, link.interface)) or "no interface yet"
    return passed(name, f"{link.listen} to {', '.join(targets)} on {ways}")


def sending(index: int, link: LinkSection) -> Finding | None:
    """How frames for one neighbour leave over Wi-Fi, and what that costs. None: over something else."""
    addresses = [peer.address for peer in link.peers] + [each for each in (link.broadcast, link.multicast) if each]
    hosts = [host for address in addresses if is_address(host := parse_address(address)[0])]
    ways = ((way.name, wifi_driver(way.name)) for way in carriers(hosts, link.interface))
    radio = next((f"{name} (driver {driver})" for name, driver in ways if driver), None)
    if radio is None:
        return None
    name = f"links[{index}] data"
    if link.data == "unicast":
        return passed(
            name, f"unicast over {radio}, which acknowledges and repeats frames; other nodes do not overhear them"
        )
    if len(addresses) > 1:
        return warned(
            name, f"broadcast, but {radio} sends each frame {len(addresses)} times, once to each address",
            f"set links[{index}].broadcast alone, or links[{index}].data: unicast",
        )  # fmt: skip
    return passed(
        name,
        f"broadcast over {radio}, at its mcast-rate; all in range overhear it, and the nodes repeat it",
    )


@lru_cache(64)
def is_known(host: str) -> bool:
    """Whether the name service knows a host, and answers in time."""
    answers: list[bool] = []

    def look() -> None:
        try:
            resolve((host, 0), host)
            answers.append(True)
        except LinkError:
            answers.append(False)

    # An unreachable name service would take half a minute. The thread may hang; it ends with the process.
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    thread.join(LOOKUP_S)
    return bool(answers) and answers[0]
