"""The autopilot's port: how it is written, and UDP both ways. Streams are in test_link_stream.py."""

from __future__ import annotations

import socket

import pytest

from rass_mav.errors import ConfigError, LinkError
from rass_mav.link.address import VehicleUrl, parse_address, parse_multicast, parse_vehicle_url, show_address
from rass_mav.link.vehicle_udp import VehicleLink
from tests.waking import Waking

ANY = ("127.0.0.1", 0)


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14550"),
        ("udpin://0.0.0.0:14550", "udpin:0.0.0.0:14550"),
        ("udpin://:14550", "udpin:0.0.0.0:14550"),
        ("udp://:14540", "udpin:0.0.0.0:14540"),
        ("udpout:192.168.1.2:14550", "udpout:192.168.1.2:14550"),
        ("udpout://autopilot.local:14550", "udpout:autopilot.local:14550"),
        ("udp://192.168.1.2:14550", "udpout:192.168.1.2:14550"),
        ("tcp:127.0.0.1:5777", "tcp:127.0.0.1:5777"),
        ("tcp://autopilot.local:5760", "tcp:autopilot.local:5760"),
        ("tcpout://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
        ("serial:/dev/ttyAMA0:921600", "serial:/dev/ttyAMA0:921600"),
        ("serial:///dev/ttyAMA0:921600", "serial:/dev/ttyAMA0:921600"),
        ("/dev/ttyAMA0,921600", "serial:/dev/ttyAMA0:921600"),
        ("/dev/ttyAMA0:921600", "serial:/dev/ttyAMA0:921600"),
        ("/dev/serial/by-path/pci-0:1,2,57600", "serial:/dev/serial/by-path/pci-0:1,2:57600"),
    ],
)
def test_spellings_of_pymavlink_and_mavsdk(url: str, expected: str) -> None:
    assert str(parse_vehicle_url(url)) == expected


@pytest.mark.parametrize(
    "url",
    ["", "udpin", "udpin:14550", "udpin:host", "udpin:a:b", "udpin:a:70000", "udpin:a:-1", "udpin:a:٣", "tcp:a",
     "tcpin:0.0.0.0:5760", "tcp::5760", "tcp:0.0.0.0:5760", "/dev/ttyAMA0", "/dev/ttyAMA0,", "/dev/ttyAMA0,fast",
     "serial:", "serial:ttyAMA0:57600", "serial:/dev/ttyAMA0", "/dev/ttyAMA0,9", ",57600",
     "udpout:0.0.0.0:14550", "udpout::14550", "udpout:a:0", "udpin:a b:1", "udpin:[::1]:14550"],
)  # fmt: skip
def test_what_is_no_connection_string_says_what_is(url: str) -> None:
    with pytest.raises(ConfigError, match=r"^expected "):
        parse_vehicle_url(url)


def test_addresses() -> None:
    assert parse_address("192.168.4.7:14600") == ("192.168.4.7", 14600)
    assert parse_address("[::1]:0", any_port=True, ipv6=True) == ("::1", 0)
    assert parse_address("192.168.4.7:14600", ipv6=True) == ("192.168.4.7", 14600)
    for text in ("192.168.4.7:14600", "[fe80::1]:80", "base.local:8080"):
        assert show_address(parse_address(text, ipv6=True)) == text
    for wrong in ("::1", "[::1]", "[::1]:70000", "[base]:80", "[]:80", "[::1:80", "::1]:80", "[[::1]]:80"):
        with pytest.raises(ConfigError):
            parse_address(wrong, ipv6=True)
    with pytest.raises(ConfigError):
        parse_address("[::1]:80")
    assert parse_multicast("239.255.82.83:14601") == ("239.255.82.83", 14601)
    for wrong in ("192.168.4.7:14601", "group:14601", "239.255.82.83"):
        with pytest.raises(ConfigError):
            parse_multicast(wrong)


async def test_udpin_answers_to_whoever_spoke_last() -> None:
    link = VehicleLink(VehicleUrl("udpin", ANY))
    waking = Waking(link.start)
    link.send(b"to nobody yet")
    for text in (b"one", b"two"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            autopilot.settimeout(5)
            autopilot.bind(ANY)
            autopilot.sendto(text, link.address)
            assert await waking.next(link.receive) == [text]
            link.send(b"answer to " + text)
            assert autopilot.recvfrom(100) == (b"answer to " + text, link.address)
    assert link.counters() == (2, 2, 0, 1, 0)
    link.close()


async def test_udpout_speaks_first_and_hears_only_the_autopilot() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        autopilot.settimeout(5)
        autopilot.bind(ANY)
        link = VehicleLink(VehicleUrl("udpout", autopilot.getsockname()))
        waking = Waking(link.start)
        link.send(b"heartbeat")
        data, source = autopilot.recvfrom(100)
        assert data == b"heartbeat"
        stranger.sendto(b"stranger", source)
        autopilot.sendto(b"telemetry", source)
        assert await waking.next(link.receive) == [b"telemetry"]
        link.close()


async def test_an_autopilot_that_is_not_there_yet_does_no_harm() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(ANY)
        address = autopilot.getsockname()
    link = VehicleLink(VehicleUrl("udpout", address))
    waking = Waking(link.start)
    for _ in range(10):
        link.send(b"heartbeat")  # refused: every second one fails with the refusal of the one before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(address)
        autopilot.sendto(b"here I am", link.address)
        assert await waking.next(link.receive) == [b"here I am"]
    counters = link.counters()
    assert counters.sent + counters.dropped_out == 10
    link.close()


def test_a_port_in_use() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(ANY)
        port = other.getsockname()[1]
        with pytest.raises(LinkError, match=f"^udpin:127.0.0.1:{port}: address already in use by process .*ss -lunp"):
            VehicleLink(VehicleUrl("udpin", ("127.0.0.1", port)))
