"""Addresses as people write them."""

from __future__ import annotations

import ipaddress
import socket
from typing import Literal, NamedTuple

from rass_mav.core.errors import ConfigError, LinkError

from .base import Address

#: Where a ground station's and a simulator's MAVLink usually is.
_EXAMPLE = "udpin:0.0.0.0:14550"
_WILDCARDS = ("", "0.0.0.0")


def parse_address(text: str, *, any_port: bool = False) -> Address:
    """`host:port` as (host, port); IPv4 or a name. `any_port`: port 0 is allowed, the system chooses then.

    Raises `ConfigError`: `expected host:port, got ...`.
    """
    host, colon, port = text.rpartition(":")
    least = 0 if any_port else 1
    if not colon or not host or ":" in host or any(c.isspace() or c == "/" for c in host):
        raise ConfigError(f"expected host:port (IPv4 address or name), got {text!r}")
    if not (port.isascii() and port.isdecimal() and len(port) <= 5 and least <= int(port) <= 65535):
        raise ConfigError(f"expected a port {least}..65535 behind the colon, got {text!r}")
    return host, int(port)


def parse_multicast(text: str) -> Address:
    """`group:port`. Raises `ConfigError` if the group is no IPv4 multicast address."""
    group, port = parse_address(text)
    try:
        good = ipaddress.IPv4Address(group).is_multicast
    except ValueError:
        good = False
    if not good:
        raise ConfigError(f"expected a multicast group 224.0.0.0 .. 239.255.255.255 and a port, got {text!r}")
    return group, port


class VehicleUrl(NamedTuple):
    """Where the autopilot is."""

    mode: Literal["udpin", "udpout"]
    """udpin: we listen, and answer to whoever speaks; udpout: we speak first."""
    address: Address

    def __str__(self) -> str:
        return f"{self.mode}:{self.address[0]}:{self.address[1]}"


def parse_vehicle_url(url: str) -> VehicleUrl:
    """Connection strings of pymavlink and MAVSDK: `udpin:host:port`, `udpin://host:port`, `udpout:...`, `udpout://...`.

    `udp://:port` and `udp://0.0.0.0:port` listen, `udp://host:port` with another host speaks first, as with MAVSDK.
    Raises `ConfigError` for other schemes, saying which exist.
    """
    scheme, colon, rest = url.partition(":")
    if not colon or scheme not in ("udp", "udpin", "udpout"):
        raise ConfigError(f"expected udpin:host:port or udpout:host:port (for example {_EXAMPLE}), got {url!r}")
    rest = rest.removeprefix("//")
    if rest.startswith(":"):
        rest = "0.0.0.0" + rest
    address = parse_address(rest, any_port=scheme != "udpout")
    if scheme == "udpin" or (scheme == "udp" and address[0] in _WILDCARDS):
        return VehicleUrl("udpin", address)
    if address[0] in _WILDCARDS or not address[1]:
        raise ConfigError(f"expected the autopilot's host and port, got {url!r}")
    return VehicleUrl("udpout", address)


def resolve(address: Address, name: str) -> Address:
    """The IPv4 address of a host. Asks the name service, so it may take seconds. Raises `LinkError`."""
    try:
        found = socket.getaddrinfo(*address, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise LinkError(f"{name}: {address[0]}: {reason.lower()}") from None
    host, port = found[0][4][:2]
    return str(host), int(port)
