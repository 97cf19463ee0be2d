"""Network interfaces by their names (Linux, netdevice(7)): what a wlan0 is called and how it broadcasts."""

from __future__ import annotations

import fcntl
import socket
import struct
from typing import NamedTuple

from rass_mav.errors import LinkError, os_errors_as

_SIOCGIFADDR = 0x8915
_SIOCGIFBRDADDR = 0x8919
#: Longest name of an interface, bytes (IFNAMSIZ less the closing zero).
MAX_NAME = 15
#: The broadcast address of whatever network one is on.
EVERY_NETWORK = "255.255.255.255"
_NONE = "0.0.0.0"


class Interface(NamedTuple):
    """An interface on which IPv4 is spoken."""

    address: str
    """Own IPv4 address."""
    broadcast: str | None
    """The network's broadcast address; None: nothing can be broadcast there."""


def is_address(text: str) -> bool:
    """Whether an interface is given by its own IPv4 address, and not by its name."""
    try:
        socket.inet_pton(socket.AF_INET, text)
    except OSError:
        return False
    return True


def is_name(text: str) -> bool:
    """Whether Linux lets an interface have this name."""
    return 0 < len(text.encode()) <= MAX_NAME and text not in (".", "..") and not set(text) & set("/: \t\n\0")


def find_interface(name: str) -> Interface:
    """The interface of this name, as it is now. Raises `LinkError`: there is none, or it has no IPv4 address yet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, os_errors_as(LinkError, name):
        address = _ask(sock, _SIOCGIFADDR, name)
        broadcast = _ask(sock, _SIOCGIFBRDADDR, name)
    return Interface(address, None if broadcast == _NONE else broadcast)


def _ask(sock: socket.socket, what: int, name: str) -> str:
    # struct ifreq: the name, then family, port and address.
    answer = fcntl.ioctl(sock.fileno(), what, struct.pack("16s24x", name.encode()))
    return socket.inet_ntoa(answer[20:24])
