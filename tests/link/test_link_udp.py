"""UDP links with real sockets on 127.0.0.1."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import socket

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import BROADCAST
from rass_mav.errors import LinkError
from rass_mav.link.base import MAX_INBOX, MAX_INBOX_BYTES, MAX_OUTBOX, MAX_TURN, MAX_TURN_BYTES, Datagram, Inbox
from rass_mav.link.budget import DATAGRAM_BYTES
from rass_mav.link.interface import find_interface
from rass_mav.link.sockets import MAX_DATAGRAM, MAX_PER_WAKE, Sender
from rass_mav.link.udp import MAX_LEARNED, Peer, UdpLink
from tests.patience import PATIENCE_S

from .link_helpers import Ear

ANY = ("127.0.0.1", 0)


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(ANY)
        port: int = sock.getsockname()[1]
        return port


async def test_a_frame_for_a_peer_goes_to_it_alone_and_one_for_all_to_everybody() -> None:
    b, c = UdpLink(ANY), UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(b.address, 2), Peer(c.address)])
    ears = {link: Ear(link) for link in (a, b, c)}
    a.send(b"to 2", 2)
    a.send(b"to all", BROADCAST)
    a.send(b"to 9, who is not known", 9)
    # What is sent at once shares a datagram.
    assert await ears[b].frames(1) == [b"to 2" + b"to all" + b"to 9, who is not known"]
    assert await ears[c].frames(1) == [b"to all" + b"to 9, who is not known"]
    assert ears[b].heard[0].source == a.address
    assert a.reaches(2)
    assert not a.reaches(3)
    assert a.counters() == (2, 0, 0, 0, 0)
    assert b.counters() == (0, 1, 0, 0, 0)
    for link in ears:
        link.close()


@given(st.lists(st.integers(1, 2 * DATAGRAM_BYTES), min_size=1, max_size=40))
@settings(deadline=None)
def test_frames_share_datagrams_in_order_and_none_is_cut(sizes: list[int]) -> None:
    frames = [bytes([index]) * size for index, size in enumerate(sizes)]

    async def through() -> list[bytes]:
        b = UdpLink(ANY)
        a = UdpLink(ANY, peers=[Peer(b.address)])
        ear = Ear(b)
        for frame in frames:
            a.send(frame, BROADCAST)
        heard = await ear.until(lambda heard: sum(len(one.data) for one in heard) == sum(sizes))
        a.close()
        b.close()
        return [one.data for one in heard]

    datagrams = asyncio.run(through())
    assert b"".join(datagrams) == b"".join(frames)
    for before, after in itertools.pairwise(datagrams):
        assert before[-1] != after[0], "a frame is whole in one datagram"
        first = next(len(frame) for frame in frames if frame[0] == after[0])
        assert len(before) + first > DATAGRAM_BYTES, "it would have fitted"
    for datagram in datagrams:
        assert len(datagram) <= DATAGRAM_BYTES or len(set(datagram)) == 1


async def test_what_was_handed_over_before_a_link_closes_still_leaves() -> None:
    b = UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(b.address)])
    ear = Ear(b)
    a.send(b"the last", BROADCAST)
    a.close()
    assert await ear.frames(1) == [b"the last"]
    b.close()


async def test_a_learned_address_is_used_and_a_configured_one_stays() -> None:
    b, c = UdpLink(ANY), UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(b.address, 2)])
    hears_b, hears_c = Ear(b), Ear(c)
    a.learn(3, c.address)
    a.learn(2, c.address)
    a.send(b"x", 3)
    a.send(b"y", 2)
    assert await hears_c.frames(1) == [b"x"]
    assert await hears_b.frames(1) == [b"y"]
    for link in (a, b, c):
        link.close()


@pytest.mark.parametrize(("data", "peers"), [("broadcast", 1), ("broadcast", 2), ("unicast", 1)])
async def test_all_hear_what_is_broadcast_for_one(data: str, peers: int) -> None:
    all_hear = data == "broadcast"
    others = [UdpLink(ANY) for _ in range(peers)]
    alone = UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(other.address) for other in others], data=data)
    ears = [Ear(other) for other in (*others, alone)]
    a.learn(3, alone.address)
    a.send(b"for 3", 3)
    a.send(b"for all", BROADCAST)
    for ear in ears[:-1]:
        assert await ear.frames(1) == [b"for 3for all" if all_hear else b"for all"]
    if not all_hear:
        assert await ears[-1].frames(1) == [b"for 3"]
    assert a.broadcasts is all_hear
    for link in (a, alone, *others):
        link.close()


def test_the_table_of_learned_addresses_is_bounded_and_forgets_the_longest_silent() -> None:
    link = UdpLink(ANY)
    for node in range(MAX_LEARNED + 10):
        link.learn(node, ("127.0.0.1", 1000 + node))
        link.learn(0, ("127.0.0.1", 1000))
    assert link.reaches(0)
    assert not link.reaches(1)
    assert sum(link.reaches(node) for node in range(MAX_LEARNED + 10)) == MAX_LEARNED
    link.close()


@pytest.mark.parametrize("interface", ["127.0.0.1", "lo"])
async def test_two_nodes_on_one_host_hear_each_other_by_multicast_and_not_themselves(interface: str) -> None:
    group = ("239.255.82.83", free_port())
    try:
        a = UdpLink(ANY, multicast=group, interface=interface)
    except LinkError as error:
        pytest.skip(f"no multicast here: {error}")
    b = UdpLink(ANY, multicast=group, interface=interface)
    hears_a, hears_b = Ear(a), Ear(b)
    for index in range(3):
        a.send(b"from a %d" % index, BROADCAST)
        await asyncio.sleep(0)  # the next one leaves in a turn of its own
    assert await hears_b.frames(3) == [b"from a 0", b"from a 1", b"from a 2"]
    assert hears_b.heard[0].source == a.address, "answers go to the sender's own socket"
    b.send(b"from b", BROADCAST)
    assert await hears_a.frames(1) == [b"from b"]
    b.learn(1, hears_b.heard[0].source)
    b.send(b"for a", 1)
    assert (await hears_a.frames(2))[1] == b"for a"
    # Own frames arrive before those of others that were sent later, so they have been here.
    assert a.counters().echoes == 3
    a.close()
    b.close()


async def test_own_broadcasts_that_come_back_are_dropped() -> None:
    port = free_port()
    link = UdpLink(("0.0.0.0", port), broadcast=("127.255.255.255", port))
    other = UdpLink(ANY, peers=[Peer(("127.0.0.1", port))])
    ear = Ear(link)
    link.send(b"own", BROADCAST)
    other.send(b"foreign", BROADCAST)
    assert await ear.frames(1) == [b"foreign"]
    assert link.counters().echoes == 1
    link.close()
    other.close()


async def test_what_nobody_takes_stays_in_the_kernel_and_reading_goes_on_later() -> None:
    b = UdpLink(ANY)
    wakes: asyncio.Queue[None] = asyncio.Queue()
    b.start(lambda: wakes.put_nowait(None))
    total = MAX_INBOX + 40
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        for index in range(total):
            other.sendto(index.to_bytes(2, "big"), b.address)
    for _ in range(MAX_INBOX // MAX_PER_WAKE):
        await asyncio.wait_for(wakes.get(), PATIENCE_S)
    taken: list[Datagram] = []
    while len(taken) < total:
        await asyncio.wait_for(wakes.get(), PATIENCE_S)
        taken += b.receive()
    assert [int.from_bytes(d.data, "big") for d in taken] == list(range(total))
    b.close()


@pytest.mark.parametrize("size", [1, 158, MAX_DATAGRAM, MAX_INBOX_BYTES])
async def test_an_inbox_is_bounded_and_handed_out_in_turns(size: int) -> None:
    inbox = Inbox()
    wakes: asyncio.Queue[None] = asyncio.Queue()
    inbox.wake = lambda: wakes.put_nowait(None)
    count = 0
    while not inbox.full:
        inbox.put(Datagram(count.to_bytes(2, "big") + bytes(size), ("127.0.0.1", 1)))
        count += 1
    assert count <= MAX_INBOX
    assert count * size <= MAX_INBOX_BYTES + size
    taken: list[Datagram] = []
    while len(inbox):
        turn = inbox.take()
        assert 0 < len(turn) <= MAX_TURN
        assert sum(len(one.data) for one in turn) <= MAX_TURN_BYTES or len(turn) == 1
        assert not inbox.full
        assert wakes.empty(), "others come first"
        taken += turn
        if len(inbox):
            await asyncio.wait_for(wakes.get(), PATIENCE_S)
    assert inbox.take() == []
    assert [int.from_bytes(one.data[:2], "big") for one in taken] == list(range(count))
    assert inbox.taken == count


async def test_a_datagram_that_no_node_sends_is_cut() -> None:
    b = UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(b.address)])
    ear = Ear(b)
    for size in (MAX_DATAGRAM, 4096, 60_000):
        a.send(bytes(size), BROADCAST)
    assert [len(data) for data in await ear.frames(3)] == [MAX_DATAGRAM] * 3
    a.close()
    b.close()


async def test_datagrams_that_the_kernel_drops_are_counted() -> None:
    b = UdpLink(ANY)
    a = UdpLink(ANY, peers=[Peer(b.address)])
    for _ in range(20_000):
        a.send(bytes(DATAGRAM_BYTES), BROADCAST)
    await asyncio.sleep(0)  # the last one leaves
    counters = b.counters()
    assert counters.dropped_in > 0
    assert a.counters().sent + a.counters().dropped_out == 20_000
    a.close()
    b.close()


async def test_what_the_socket_does_not_take_waits_up_to_a_bound() -> None:
    # A socket pair blocks when its buffer is full, which UDP on a loopback never does.
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    theirs.setblocking(False)
    sender = Sender(ours, "pair")
    count = 0
    while sender.dropped < 5:
        sender.send(count.to_bytes(4, "big"), None)
        count += 1
    assert count == sender.sent + MAX_OUTBOX + 5
    got: list[int] = []
    while len(got) < count - 5:
        data = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(theirs, 16), PATIENCE_S)
        got.append(int.from_bytes(data, "big"))
    assert got == [*range(sender.sent - MAX_OUTBOX), *range(count - MAX_OUTBOX, count)]
    sender.stop()
    ours.close()
    theirs.close()


async def test_no_way_out_is_counted_and_told_once(caplog: pytest.LogCaptureFixture) -> None:
    # A socket bound to 127.0.0.1 has no way to the outside.
    link = UdpLink(ANY, peers=[Peer(("192.0.2.1", 14600))])
    for _ in range(5):
        link.send(b"x", BROADCAST)
        await asyncio.sleep(0)  # the next one leaves in a turn of its own
    assert link.counters().dropped_out == 5
    link.close()
    assert len([r for r in caplog.records if "cannot send" in r.message]) == 1


def test_a_port_in_use() -> None:
    first = UdpLink(ANY)
    host, port = first.address
    with pytest.raises(LinkError) as caught:
        UdpLink((host, port))
    first.close()
    assert caught.value.text.startswith(f"udp:127.0.0.1:{port}: address already in use by process {os.getpid()} (")
    assert "another node" not in caught.value.remedy  # it is this process
    assert caught.value.remedy.startswith("this process already uses it: ")
    assert caught.value.remedy.endswith(f" its own port; ss -lunp 'sport = :{port}'")
    assert str(caught.value) == f"{caught.value.text}; {caught.value.remedy}"


async def test_a_broadcast_on_a_named_interface_goes_to_its_network(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[object] = []
    monkeypatch.setattr(Sender, "send", lambda sender, frame, address: sent.append(address))
    found = {}
    for _, name in socket.if_nameindex():
        with contextlib.suppress(LinkError):  # it has no address
            found[name] = find_interface(name)
    assert found["lo"].address == "127.0.0.1"
    for name, interface in found.items():
        link = UdpLink(ANY, broadcast=("255.255.255.255", 14600), interface=name)
        named = UdpLink(ANY, broadcast=("10.1.2.255", 14600), interface=name)
        sent.clear()
        for one in (link, named):
            one.send(b"to all", BROADCAST)
            one.close()
        # Who says a network means it.
        assert sent == [(interface.broadcast or "255.255.255.255", 14600), ("10.1.2.255", 14600)]


def test_an_interface_that_is_not_there() -> None:
    with pytest.raises(LinkError, match=r"^udp:127\.0\.0\.1:0: there is no interface wlan77 \(there is lo "):
        UdpLink(ANY, multicast=("239.1.2.3", 14600), interface="wlan77")


def test_an_interface_that_is_not_ours() -> None:
    with pytest.raises(LinkError, match=r"^udp:127\.0\.0\.1:0: 203\.0\.113\.9 is not an address of this computer"):
        UdpLink(ANY, multicast=("239.1.2.3", 14600), interface="203.0.113.9")


def test_a_host_that_is_not_known() -> None:
    with pytest.raises(LinkError, match=r"no-such-host\.invalid: "):
        UdpLink(ANY, peers=[Peer(("no-such-host.invalid", 14600))])
