"""Interfaces as the kernel has them: real ones, in a network of their own."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest

from rass_mav.core.messages import BROADCAST
from rass_mav.errors import LinkError
from rass_mav.link.interface import carrier, carriers, find_interface, interface_to, interfaces
from rass_mav.link.udp import Peer, UdpLink
from tests.namespaces import DOWN, JOINED, NOT_JOINED, in_namespace, ip

ANY = ("0.0.0.0", 0)
EVERYBODY = ("192.168.4.255", 14600)


def test_all_addresses_of_all_interfaces() -> None:
    def work() -> list[tuple[str, str, str | None]]:
        return [(i.name, i.address, i.broadcast) for i in interfaces()]

    more = (
        "addr add 10.9.0.7/16 dev wlan0",  # without brd: the kernel broadcasts there all the same
        "addr add 10.8.0.7/32 dev wlan0",
        "addr add 10.7.0.7/24 brd 10.7.0.127 dev wlan0 label wlan0:two",
    )
    assert in_namespace([*JOINED, *more], work) == [
        ("lo", "127.0.0.1", "127.255.255.255"),
        ("wlan0", "192.168.4.7", "192.168.4.255"),
        ("wlan0", "10.9.0.7", "10.9.255.255"),
        ("wlan0", "10.8.0.7", None),
        ("wlan0", "10.7.0.7", "10.7.0.127"),
    ]


def test_more_addresses_than_a_first_look_has_room_for() -> None:
    many = [f"addr add 10.1.{number}.1/24 dev wlan0" for number in range(100)]
    assert len(in_namespace([*JOINED, *many], interfaces)) == 102


@pytest.mark.parametrize(
    ("setup", "up", "carries", "trouble"),
    [
        (JOINED, True, True, ""),
        (NOT_JOINED, True, False, "wlan0 has no carrier"),
        (DOWN, False, False, "wlan0 is down"),
    ],
    ids=["joined", "not joined", "down"],
)
def test_whether_an_interface_carries(setup: tuple[str, ...], up: bool, carries: bool, trouble: str) -> None:
    found = in_namespace(setup, partial(carrier, "wlan0"))
    assert found == ("wlan0", up, carries)
    assert found.trouble == trouble
    assert not trouble or "wlan0" in found.remedy


def test_loopback_carries_and_what_is_not_there_is_down() -> None:
    assert carrier("lo") == ("lo", True, True)
    assert carrier("wlan77") == ("wlan77", False, False)


def test_by_name_or_by_address() -> None:
    def work() -> list[str]:
        answers = [find_interface("wlan0").address, find_interface("192.168.4.7").name]
        for other in ("wlan7", "10.1.1.1", "air"):
            try:
                find_interface(other)
            except LinkError as error:
                answers.append(error.text)
        return answers

    there = "(there is lo 127.0.0.1 with broadcast 127.255.255.255, wlan0 192.168.4.7 with broadcast 192.168.4.255)"
    assert in_namespace(JOINED, work) == [
        "192.168.4.7",
        "wlan0",
        f"there is no interface wlan7 {there}",
        f"10.1.1.1 is not an address of this computer {there}",
        "air has no IPv4 address yet",
    ]


@pytest.mark.parametrize("setup", [JOINED, DOWN], ids=["joined", "down"])
def test_what_lies_in_an_interfaces_network_belongs_to_it_even_while_it_is_down(setup: tuple[str, ...]) -> None:
    def work() -> list[str | None]:
        # A default route over another interface, where the kernel would send what it knows no better way for.
        ip("link add eth0 type veth peer name wall", "link set eth0 up", "link set wall up")
        ip("addr add 10.0.0.2/24 dev eth0", "route add default via 10.0.0.1")
        known = interfaces()
        ways = [interface_to(host, known) for host in ("192.168.4.255", "192.168.4.9", "127.0.0.1", "239.1.2.3")]
        return [way and way.name for way in ways]

    assert in_namespace(setup, work) == ["wlan0", "wlan0", "lo", "eth0"]


def test_multicast_leaves_by_the_interface_that_was_chosen() -> None:
    def work() -> list[list[str]]:
        return [[way.name for way in carriers(["239.1.2.3"], chosen)] for chosen in (None, "wlan0", "192.168.4.7")]

    assert in_namespace(JOINED, work) == [[], ["wlan0"], ["wlan0"]]


def troubles(link: UdpLink) -> str:
    trouble = link.trouble
    link.close()
    return trouble


def test_a_link_knows_why_nothing_can_leave() -> None:
    def work() -> list[str]:
        found = [troubles(UdpLink(ANY, broadcast=EVERYBODY))]
        ip("link set air down")
        for where in (None, "wlan0", "192.168.4.7"):
            found.append(troubles(UdpLink(ANY, broadcast=EVERYBODY, interface=where)))
        found.append(troubles(UdpLink(ANY, broadcast=("255.255.255.255", 14600), interface="192.168.4.7")))
        found.append(troubles(UdpLink(ANY, multicast=("239.1.2.3", 14600), interface="wlan0")))
        ip("link set wlan0 down")
        found.append(troubles(UdpLink(ANY, peers=[Peer(("192.168.4.9", 14600))])))
        found.append(troubles(UdpLink(ANY, peers=[Peer(("192.168.4.9", 14600)), Peer(("127.0.0.1", 14600))])))
        ip("addr flush dev wlan0")
        found.append(troubles(UdpLink(ANY, broadcast=EVERYBODY)))
        found.append(troubles(UdpLink(ANY, broadcast=("255.255.255.255", 14600))))
        found.append(troubles(UdpLink(ANY)))
        return found

    assert in_namespace(JOINED, work) == [
        "",
        *5 * ["wlan0 has no carrier"],
        "wlan0 is down",
        "",
        "192.168.4.255 is the broadcast address of no interface",
        "no interface leads to the neighbours",
        "",
    ]


def test_what_is_sent_without_a_carrier_is_counted_as_sent() -> None:
    """The kernel takes it and drops it. So the counters alone tell nobody that the network is away."""

    def work() -> tuple[int, int]:
        async def scenario() -> tuple[int, int]:
            link = UdpLink(ANY, broadcast=EVERYBODY)
            link.send(b"x", BROADCAST)
            await asyncio.sleep(0)  # it leaves
            counters = link.counters()
            link.close()
            return counters.sent, counters.dropped_out

        return asyncio.run(scenario())

    assert in_namespace(NOT_JOINED, work) == (1, 0)
    assert in_namespace(DOWN, work) == (0, 1)
