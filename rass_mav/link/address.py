"""Addresses as people write them."""

from __future__ import annotations

import ipaddress
import socket
from typing import Literal, NamedTuple

from rass_mav.errors import ConfigError, LinkError, why

from .base import Address

#: The usual addresses of MAVLink, for examples in messages.
_EXAMPLE = "udpin:0.0.0.0:14550"
_SERIAL_EXAMPLE = "serial:/dev/ttyAMA0:921600"
_WILDCARDS = ("", "0.0.0.0")


def parse_address(text: str, *, any_port: bool = False, ipv6: bool = False) -> Address:
    """`host:port` as (host, port); IPv4 or a name. `any_port`: port 0 is allowed, and the system chooses one. `ipv6`:
    `[address]:port` too.

    Raises `ConfigError`: `expected host:port, got ...`.
    """
    host, colon, port = text.rpartition(":")
    least = 0 if any_port else 1
    if ipv6 and host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
        good = _is_ipv6(host)
    else:
        good = bool(host) and ":" not in host and not any(c.isspace() or c == "/" for c in host)
    if not colon or not good:
        kinds = "IPv4 address, [IPv6 address] or name" if ipv6 else "IPv4 address or name"
        raise ConfigError(f"expected host:port ({kinds}), got {text!r}")
    if not (port.isascii() and port.isdecimal() and len(port) <= 5 and least <= int(port) <= 65535):
        raise ConfigError(f"expected a port {least}..65535 after the colon, got {text!r}")
    return host, int(port)


def show_address(address: Address) -> str:
    """An address as `parse_address` reads it."""
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _is_ipv6(host: str) -> bool:
    try:
        return bool(ipaddress.IPv6Address(host))
    except ValueError:
        return False


def parse_multicast(text: str) -> Address:
    """`group:port`. Raises `ConfigError` if the group is not an IPv4 multicast address."""
    group, port = parse_address(text)
    try:
        good = ipaddress.IPv4Address(group).is_multicast
    except ValueError:
        good = False
    if not good:
        raise ConfigError(f"expected a multicast group 224.0.0.0 .. 239.255.255.255 and a port, got {text!r}")
    return group, port


class VehicleUrl(NamedTuple):
    """The autopilot's address, whatever notation was used."""

    mode: Literal["udpin", "udpout", "tcp", "serial"]
    """udpin: we listen, and answer the sender; udpout: we send first; tcp: we connect; serial: a device."""
    address: Address
    """(host, port); for a serial device (path, bit/s)."""

    def __str__(self) -> str:
        return f"{self.mode}:{self.address[0]}:{self.address[1]}"


def parse_vehicle_url(url: str) -> VehicleUrl:
    """Parse a connection string in the notation of pymavlink or of MAVSDK.

    `udpin:host:port`, `udpout:host:port`, `tcp:host:port`, with or without `//` before the host. As with MAVSDK,
    `udp://:port` and `udp://0.0.0.0:port` listen, `udp://host:port` with another host sends first, and `tcpout` is
    `tcp`. A serial port is `serial:device:baud` with or without `//`, `device,baud` or `device:baud`.
    Raises `ConfigError` for other schemes, with a list of the valid ones.
    """
    if url.startswith("/"):
        return VehicleUrl("serial", parse_serial(url))
    scheme, colon, rest = url.partition(":")
    if scheme == "serial" and colon:
        return VehicleUrl("serial", parse_serial(url))
    if not colon or scheme not in ("udp", "udpin", "udpout", "tcp", "tcpout"):
        raise ConfigError(
            f"expected udpin:host:port, udpout:host:port, tcp:host:port or serial:device:baud (for example"
            f" {_EXAMPLE} or {_SERIAL_EXAMPLE}), got {url!r}"
        )
    rest = rest.removeprefix("//")
    if rest.startswith(":"):
        rest = "0.0.0.0" + rest
    listens = scheme in ("udp", "udpin")
    address = parse_address(rest, any_port=listens)
    if scheme == "udpin" or (listens and address[0] in _WILDCARDS):
        return VehicleUrl("udpin", address)
    if address[0] in _WILDCARDS or not address[1]:
        raise ConfigError(f"expected the autopilot's host and port, got {url!r}")
    return VehicleUrl("tcp" if scheme.startswith("tcp") else "udpout", address)


def parse_serial(text: str) -> Address:
    """A serial port as (device, bit/s): `/dev/ttyAMA0,921600`, `/dev/ttyAMA0:921600`, with `serial:` or `serial://`.

    Raises `ConfigError`. There is no default speed, because a wrong one looks like a broken cable.
    """
    plain = text.removeprefix("serial:")
    if plain.startswith("//"):
        plain = plain[2:]
    cut = max(plain.rfind(","), plain.rfind(":"))
    device, baud = plain[:cut], plain[cut + 1 :]
    if cut < 0 or not device.startswith("/") or not (baud.isascii() and baud.isdecimal() and len(baud) <= 8):
        raise ConfigError(f"expected a device and its speed in bit/s (for example {_SERIAL_EXAMPLE}), got {text!r}")
    if int(baud) < 300:
        raise ConfigError(f"expected a speed of at least 300 bit/s, got {text!r}")
    return device, int(baud)


def resolve(address: Address, name: str) -> Address:
    """The IPv4 address of a host. It asks the name service, so it may take seconds. Raises `LinkError`."""
    try:
        found = socket.getaddrinfo(*address, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{name}: {address[0]}: {why(error)}") from None
    host, port = found[0][4][:2]
    return str(host), int(port)
