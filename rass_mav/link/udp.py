"""UDP between neighbours: unicast to named peers, broadcast, multicast.

All frames leave from one socket, bound to `listen`, where unicast also arrives. For multicast, a second socket listens
to the group; other nodes on the same host share it. So each node has its own source address. Its neighbours answer to
it, and the node recognises its own echoes by it. Frames that are sent at once to the same address share a datagram.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import socket
import sys
import termios
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from rass_mav.config.sections import Mistakes
from rass_mav.errors import LinkError, why

from .address import parse_address, parse_multicast, resolve
from .backlog import WAITING_FRAME_BYTES
from .base import Address, Datagram, Inbox, Link, LinkCounters, Remark, remember
from .budget import DATAGRAM_BYTES
from .gathering import Gathering
from .interface import (
    ANY_ADDRESS,
    EVERY_NETWORK,
    Carrier,
    Interface,
    carriers,
    find_interface,
    interface_to,
    interfaces,
    is_address,
    is_name,
    listed,
)
from .settings import LinkSection
from .sockets import Reader, Sender, bound_socket, in_use, is_local, kernel_drops, udp_socket
from .vehicle import VehiclePort

#: Addresses learned from beacons that a link remembers. When there are more, the longest silent one is forgotten.
MAX_LEARNED = 512
# How long the answer to "is this address ours" stays valid, seconds: interfaces come and go.
_LOCAL_S = 30.0
_MAX_LOCAL = 256


class Peer(NamedTuple):
    """A neighbour that the configuration names."""

    address: Address
    node_id: int | None = None
    """If known, frames for this node go only there from the start; otherwise after a beacon of it has been heard."""


class UdpLink(Link):
    """A link between neighbours. The constructor opens its sockets."""

    def __init__(
        self,
        listen: Address,
        *,
        peers: Iterable[Peer] = (),
        broadcast: Address | None = None,
        multicast: Address | None = None,
        interface: str | None = None,
        data: str = "unicast",
        ttl: int = 1,
    ) -> None:
        """`listen`: own address; port 0: any. `data`: as `LinkSection.data`. `interface`: name or own IPv4 address of
        the interface for multicast and for broadcast to 255.255.255.255; None: the system chooses. `ttl`: one more than
        the number of routers that a multicast frame may pass.

        Host names are looked up, which may take seconds. Raises `LinkError`.
        """
        super().__init__(f"udp:{listen[0]}:{listen[1]}")
        self._inbox = Inbox()
        peers = list(peers)
        self._everybody = [resolve(peer.address, self.name) for peer in peers]
        self._configured = {
            peer.node_id: address
            for peer, address in zip(peers, self._everybody, strict=True)
            if peer.node_id is not None
        }
        self._interface = interface
        if interface is not None:
            try:
                found = find_interface(interface)
            except LinkError as error:
                raise LinkError(f"{self.name}: {error.text}", error.remedy) from None
            interface = found.address
            if broadcast is not None and broadcast[0] == EVERY_NETWORK and found.broadcast is not None:
                broadcast = (found.broadcast, broadcast[1])
        if broadcast is not None:
            self._everybody.append(resolve(broadcast, self.name))
        self._broadcast = None if broadcast is None else self._everybody[-1][0]
        if multicast is not None:
            self._everybody.append(multicast)
        self.broadcasts = data != "unicast"
        self._learned: OrderedDict[int, Address] = OrderedDict()
        self._local: dict[str, bool] = {}
        self._local_until = 0.0
        self._readers: list[Reader] = []
        self._socket = bound_socket(self.name, resolve(listen, self.name))
        self._sockets = [self._socket]
        self.address: Address = self._socket.getsockname()
        """Own address, with the chosen port if it was 0."""
        self.name = f"udp:{self.address[0]}:{self.address[1]}"
        self._sender = Sender(self._socket, self.name)
        self._gathering = Gathering(DATAGRAM_BYTES, self._sender.send)
        if multicast is not None:
            try:
                self._sockets.append(self._join(multicast, interface, ttl))
            except LinkError:
                self._socket.close()
                raise

    @staticmethod
    def check(section: LinkSection, key: str) -> None:
        """Raise `ConfigError` for invalid settings of such a link. `key`: the section's key."""
        mistakes = Mistakes()
        with mistakes.gathering(f"{key}.listen"):
            parse_address(section.listen, any_port=True)
        for index, peer in enumerate(section.peers):
            with mistakes.gathering(f"{key}.peers[{index}].address"):
                parse_address(peer.address)
        if section.broadcast is not None:
            with mistakes.gathering(f"{key}.broadcast"):
                parse_address(section.broadcast)
        if section.multicast is not None:
            with mistakes.gathering(f"{key}.multicast"):
                parse_multicast(section.multicast)
        name = section.interface
        if name is not None and not is_address(name) and not is_name(name):
            mistakes.add(
                f"{key}.interface", f"expected the name of a network interface or its own IPv4 address, got {name!r}"
            )
        if not section.peers and section.broadcast is None and section.multicast is None:
            mistakes.add(key, "expected at least one of peers, broadcast and multicast")
        mistakes.check()

    @classmethod
    def of(cls, section: LinkSection, vehicle: VehiclePort | None) -> UdpLink:
        """Create the link of a checked configuration. Raises `LinkError`."""
        return cls(
            parse_address(section.listen, any_port=True),
            peers=[Peer(parse_address(peer.address), peer.id) for peer in section.peers],
            broadcast=None if section.broadcast is None else parse_address(section.broadcast),
            multicast=None if section.multicast is None else parse_multicast(section.multicast),
            interface=section.interface,
            data=section.data,
            ttl=section.ttl,
        )

    @staticmethod
    def remarks(section: LinkSection, key: str) -> Iterable[Remark]:
        """Settings of a checked section that do not fit the computer's present state. `key`: the section's key."""
        return _remarks(section, key)

    def _join(self, group: Address, interface: str | None, ttl: int) -> socket.socket:
        own = socket.inet_aton(interface or "0.0.0.0")
        sock = udp_socket()
        try:
            if interface is not None:
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, own)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
            # Other nodes on this host are neighbours too.
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(group)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group[0]) + own)
        except OSError as error:
            sock.close()
            if error.errno == errno.EADDRINUSE:
                raise in_use(self.name, group[1]) from None
            where = f" on {interface}" if interface else ""
            raise LinkError(f"{self.name}: multicast {group[0]}:{group[1]}{where}: {why(error)}") from None
        return sock

    def start(self, wake: Callable[[], None]) -> None:
        """Start reading, on the running event loop."""
        self._inbox.wake = wake
        self._readers = [Reader(sock, self._inbox, is_echo=self._is_own) for sock in self._sockets]

    def receive(self) -> list[Datagram]:
        """The datagrams of one turn."""
        was_full = self._inbox.full
        arrived = self._inbox.take()
        if was_full:
            for reader in self._readers:
                reader.resume()
        return arrived

    def _is_own(self, source: Address) -> bool:
        if source[1] != self.address[1]:
            return False
        now = asyncio.get_running_loop().time()
        if now >= self._local_until or len(self._local) >= _MAX_LOCAL:
            self._local.clear()
            self._local_until = now + _LOCAL_S
        own = self._local.get(source[0])
        if own is None:
            own = self._local[source[0]] = is_local(source[0])
        return own

    def send(self, frame: bytes, target: int) -> None:
        """Send to all peers, the broadcast address and the group, or (unicast) to the target's address if it is known.

        It leaves at the end of this turn of the event loop, together with others for the same address.
        """
        known = self._configured.get(target) or self._learned.get(target)
        for address in (known,) if known is not None and not self.broadcasts else self._everybody:
            self._gathering.add(frame, address)

    def reaches(self, target: int) -> bool:
        """Whether the node is configured with its id, or has been heard."""
        return target in self._configured or target in self._learned

    def learn(self, node_id: int, source: Address) -> None:
        """From now on, send frames for this node to this address."""
        if node_id not in self._configured:
            remember(self._learned, node_id, source, MAX_LEARNED)

    def carriers(self) -> list[Carrier]:
        """The interfaces through which the neighbours are reached."""
        return carriers((address[0] for address in self._everybody), self._interface)

    @property
    def waiting(self) -> int:
        """Bytes in the socket's send queue: they wait for the interface. Those of this turn will."""
        soon = WAITING_FRAME_BYTES * len(self._gathering)
        try:
            queued = fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4))
        except OSError:
            return soon  # not every system tells
        return soon + int.from_bytes(queued, sys.byteorder)

    @property
    def trouble(self) -> str:
        """Why nothing can leave: no interface has a carrier, or none has the broadcast address."""
        broadcasts = [EVERY_NETWORK, *(interface.broadcast for interface in interfaces())]
        if self._broadcast is not None and len(self._everybody) == 1 and self._broadcast not in broadcasts:
            return f"{self._broadcast} is the broadcast address of no interface"
        ways = self.carriers()
        if self._everybody and all(way.trouble for way in ways):
            return ", ".join(way.trouble for way in ways) or "no interface leads to the neighbours"
        return ""

    def counters(self) -> LinkCounters:
        """The counters so far; `dropped_in` counts datagrams that found the kernel's buffer full."""
        overrun = sum(kernel_drops(sock) for sock in self._sockets)
        echoes = sum(reader.echoes for reader in self._readers)
        return LinkCounters(self._sender.sent, self._inbox.taken, overrun, self._sender.dropped, echoes)

    def close(self) -> None:
        """Send what has just been handed over, and release the sockets."""
        for reader in self._readers:
            reader.stop()
        self._gathering.leave()
        self._sender.stop()
        for sock in self._sockets:
            sock.close()


def _remarks(section: LinkSection, key: str) -> Iterator[Remark]:
    """Remarks on a checked link. `key`: its section's key. Host names are not looked up."""
    present = interfaces()
    own = parse_address(section.listen, any_port=True)[0]
    if is_address(own) and own != ANY_ADDRESS and not is_local(own):
        yield Remark(
            f"{key}.listen", f"{own} is not an address of this computer ({listed(present)})", f"correct {key}.listen"
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
        yield from _about_broadcast(targets[-1], section, key, present)
    if section.multicast is not None:
        targets.append(parse_multicast(section.multicast)[0])
        if chosen is None and interface_to(targets[-1], present) is None:
            yield Remark(
                f"{key}.multicast", f"no interface leads to {targets[-1]} ({listed(present)})",
                f"set {key}.interface",
            )  # fmt: skip
    ways = carriers(filter(is_address, targets), chosen)
    for way in ways:
        if way.trouble:
            yield Remark(key, way.trouble, way.remedy, works=not all(other.trouble for other in ways))


def _about_broadcast(host: str, section: LinkSection, key: str, present: Sequence[Interface]) -> Iterator[Remark]:
    remedy = f"set {key}.broadcast to the broadcast address of the drones' network"
    if host == EVERY_NETWORK:
        if section.interface is not None:
            return
        way = interface_to(host, present)
        outside = {interface.name for interface in present if not interface.network.is_loopback}
        if way is None:
            yield Remark(f"{key}.broadcast", f"no interface leads to {host} ({listed(present)})", remedy)
        elif len(outside) > 1:
            yield Remark(
                f"{key}.broadcast", f"{host} is reached on {way.name} only, one of {len(outside)} networks"
                f" ({listed(present)})", remedy, works=True,
            )  # fmt: skip
    elif is_address(host) and all(interface.broadcast != host for interface in present):
        yield Remark(
            f"{key}.broadcast", f"{host} is the broadcast address of no interface ({listed(present)})",
            f"join the drones' network, or correct {key}.broadcast",
        )  # fmt: skip
