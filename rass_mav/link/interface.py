"""The kernel's present network interfaces (Linux, netdevice(7)): their addresses, and whether they have a carrier."""

from __future__ import annotations

import array
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from rass_mav.errors import LinkError

_SIOCGIFCONF = 0x8912
_SIOCGIFFLAGS = 0x8913
_SIOCGIFBRDADDR = 0x8919
_SIOCGIFNETMASK = 0x891B
#: What the kernel says of each interface.
NETWORKS = Path("/sys/class/net")
_IFF_UP = 0x1
_IFF_RUNNING = 0x40
# struct ifreq: the name, then a union whose largest member is struct ifmap. Its size depends on the machine.
_REQUEST_BYTES = struct.calcsize("16s2LH4B0L")
#: Longest name of an interface, bytes (IFNAMSIZ without the closing zero).
MAX_NAME = 15
#: The broadcast address of the local network, whichever it is.
EVERY_NETWORK = "255.255.255.255"
#: Own address of a socket that receives on all addresses.
ANY_ADDRESS = "0.0.0.0"


class Interface(NamedTuple):
    """An IPv4 address of an interface. An interface with two addresses is listed twice."""

    name: str
    address: str
    """Own IPv4 address."""
    network: ipaddress.IPv4Network
    broadcast: str | None
    """The network's broadcast address; None: nothing can be broadcast there."""


class Carrier(NamedTuple):
    """Whether an interface can carry a frame now."""

    name: str
    up: bool
    """Whether it is switched on."""
    carrier: bool
    """Whether it has joined a Wi-Fi network, or its cable is connected at the other end."""

    @property
    def trouble(self) -> str:
        """Why it carries nothing; empty if it works."""
        if not self.up:
            return f"{self.name} is down"
        if not self.carrier:
            return f"{self.name} has {'joined no network' if wifi_driver(self.name) else 'no carrier'}"
        return ""

    @property
    def remedy(self) -> str:
        """What to do about `trouble`."""
        if not self.up:
            return f"sudo ip link set {self.name} up"
        if wifi_driver(self.name):
            return f"join the drones' network (sudo iw dev {self.name} ibss join ...; documentation: how-to/links)"
        return f"is the cable of {self.name} plugged in, and the other end switched on?"


def is_address(text: str) -> bool:
    """Whether a text is an IPv4 address, not a name."""
    try:
        socket.inet_pton(socket.AF_INET, text)
    except OSError:
        return False
    return True


def is_name(text: str) -> bool:
    """Whether Linux allows this name for an interface."""
    return 0 < len(text.encode()) <= MAX_NAME and text not in (".", "..") and not set(text) & set("/: \t\n\0")


def interfaces() -> list[Interface]:
    """All interfaces of this computer that have an IPv4 address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        found = []
        for entry in _configured(sock):
            # The address in the request selects this address of the interface, not its first one.
            address = _address_of(entry)
            try:
                mask = _address_of(fcntl.ioctl(sock.fileno(), _SIOCGIFNETMASK, entry))
                broadcast = _address_of(fcntl.ioctl(sock.fileno(), _SIOCGIFBRDADDR, entry))
            except OSError:
                continue  # it has disappeared meanwhile
            network = ipaddress.IPv4Network((address, mask), strict=False)
            if broadcast == ANY_ADDRESS:
                # Set without `brd +`: the kernel still broadcasts there.
                broadcast = str(network.broadcast_address)
            label = entry[:16].split(b"\0")[0].decode()
            name = label.partition(":")[0]
            found.append(Interface(name, address, network, broadcast if network.prefixlen < 31 else None))
    return found


def _configured(sock: socket.socket) -> Iterable[bytes]:
    """A `struct ifreq` with name and address for each address."""
    room = 64
    while True:
        buffer = array.array("B", bytes(room * _REQUEST_BYTES))
        place, length = buffer.buffer_info()
        # struct ifconf: length and address of the buffer.
        answer = fcntl.ioctl(sock.fileno(), _SIOCGIFCONF, struct.pack("iP", length, place))
        filled: int = struct.unpack_from("i", answer)[0]
        if filled <= length - _REQUEST_BYTES:
            return [buffer[at : at + _REQUEST_BYTES].tobytes() for at in range(0, filled, _REQUEST_BYTES)]
        room *= 2  # entries that did not fit were left out


def _address_of(request: bytes) -> str:
    # After the name: family, port and address.
    return socket.inet_ntoa(request[20:24])


def find_interface(which: str) -> Interface:
    """The present interface with this name or this own IPv4 address.

    Raises `LinkError` if there is none, or if it has no IPv4 address yet.
    """
    present = interfaces()
    for interface in present:
        if which in (interface.name, interface.address):
            return interface
    if is_address(which):
        raise LinkError(
            f"{which} is not an address of this computer ({listed(present)})", "to list them: ip -br address"
        )
    if which in (name for _, name in socket.if_nameindex()):
        raise LinkError(f"{which} has no IPv4 address yet", f"sudo ip addr add 192.168.4.7/24 brd + dev {which}")
    raise LinkError(f"there is no interface {which} ({listed(present)})", "to list them: ip -br link")


def listed(present: Sequence[Interface]) -> str:
    """The interfaces, for people."""
    each = [f"{i.name} {i.address}" + (f" with broadcast {i.broadcast}" if i.broadcast else "") for i in present]
    return f"there is {', '.join(each)}" if each else "there are none"


def interface_to(host: str, present: Sequence[Interface]) -> Interface | None:
    """The one of the `present` interfaces through which an IPv4 address is reached; None: none.

    An address in the network of an interface belongs to it, even if the kernel has no route because it is down.
    """
    there = ipaddress.IPv4Address(host)
    near = [interface for interface in present if there in interface.network]
    if near:
        return max(near, key=lambda interface: interface.network.prefixlen)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            probe.connect((host, 9))  # sends nothing; the kernel chooses the route
        except OSError:
            return None
        own = probe.getsockname()[0]
    return next((interface for interface in present if interface.address == own), None)


def carriers(hosts: Iterable[str], chosen: str | None) -> list[Carrier]:
    """The interfaces through which IPv4 addresses are reached, each once. `chosen`: the one for multicast and for
    broadcast to 255.255.255.255, by name or own address; None: the system chooses."""
    present = interfaces()
    names = dict.fromkeys(name for host in hosts if (name := _name_of_way(host, chosen, present)))
    return [carrier(name) for name in names]


def _name_of_way(host: str, chosen: str | None, present: Sequence[Interface]) -> str | None:
    if chosen is not None and (host == EVERY_NETWORK or ipaddress.IPv4Address(host).is_multicast):
        if not is_address(chosen):
            return chosen
        host = chosen
    way = interface_to(host, present)
    return None if way is None else way.name


def carrier(name: str) -> Carrier:
    """The state of this interface. One that does not exist counts as down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            answer = fcntl.ioctl(sock.fileno(), _SIOCGIFFLAGS, struct.pack(f"{_REQUEST_BYTES}s", name.encode()))
        except OSError:
            return Carrier(name, up=False, carrier=False)
    flags: int = struct.unpack_from("H", answer, 16)[0]
    return Carrier(name, bool(flags & _IFF_UP), bool(flags & _IFF_RUNNING))


def wifi_driver(name: str) -> str:
    """The driver of a Wi-Fi interface; empty: it is something else."""
    place = NETWORKS / name
    return (place / "device" / "driver").resolve().name if (place / "phy80211").exists() else ""
