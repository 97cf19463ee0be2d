"""Data that neighbours hand over to each other, and that other nodes hear."""

from __future__ import annotations

from typing import Any

from rass_mav.agent.peers import Peers
from rass_mav.core.custody.overheard import KEPT_TURNS, PART
from rass_mav.core.datum import TERMS, Datum, DatumId, Terms, make_datum
from rass_mav.core.messages import (
    Accept,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Offer,
)
from rass_mav.core.node import Node
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.wire import encode

from .books import check_node
from .build import beacon, data, datum, make_node, of

CUSTODIAN, FORWARDER = 5, 6


def bystander(**settings: Any) -> Node:
    """A drone that hears node 5 hand data over to node 6, and has much space, so that it keeps them."""
    node = make_node(1, mirror=True, **{"overhear": True, "capacity_items": 1000, **settings})
    for sender in (CUSTODIAN, FORWARDER):
        node.receive(beacon(sender), 0.0)
    return node


def pass_by(node: Node, *items: Datum, sender: int = CUSTODIAN, now: float = 0.5) -> None:
    """The node hears a hand-over. It never answers."""
    for item in items:
        assert node.receive(data(sender, FORWARDER, (77, item)), now) == []


def keep(node: Node, item: Datum) -> None:
    """The same, with a datum that it keeps."""
    pass_by(node, item)
    assert item.id in node.overheard


def words(node: Node, sender: int, *entries: tuple[DatumId, CopyStatus], now: float = 1.0) -> list[Any]:
    """What a node answers to words, by target and word."""
    answers = node.receive(CopyStatuses(sender, 0xFFFF, tuple(CopyStatusEntry(*entry) for entry in entries)), now)
    return [(w.target, *entry) for w in of(CopyStatuses, answers) for entry in w.entries]


def test_a_corrupt_one_is_of_no_use() -> None:
    node, item = bystander(), datum()
    keep(node, item)
    node.overheard[item.id] = item._replace(payload=b"reasing")
    assert words(node, 7, (item.id, CopyStatus.WANTED)) == []
    assert not node.overheard
    check_node(node)


def test_one_that_has_expired_by_its_own_terms_is_of_no_use() -> None:
    for ttl_s, now, found in ((3, 2.0, True), (3, 4.0, False), (None, 4.0, True)):
        node = bystander()
        item = make_datum(DatumId(20, 5, 1), TERMS, 0.0, Terms(9, ttl_s).pack() + b"reading")
        keep(node, item)
        node.step(now)
        answers = words(node, 7, (item.id, CopyStatus.WANTED), now=now)
        assert answers == ([(7, item.id, CopyStatus.HERE)] if found else [])
        assert (item.id in node.overheard) is found
        check_node(node)


def test_it_is_forgotten_in_the_end() -> None:
    node, item = bystander(), datum()
    keep(node, item)
    for turn in range(1, KEPT_TURNS + 2):
        node.receive(beacon(CUSTODIAN, turn), float(turn))
        assert item.id in node.overheard
        if turn == KEPT_TURNS - 1:
            break
        node.step(float(turn))
    node.step(KEPT_TURNS + 2.0)
    assert not node.overheard
    check_node(node)


def test_it_gives_way_to_custody_and_to_replicas() -> None:
    node = bystander(capacity_items=8)
    heard = [datum(origin, sequence=1) for origin in range(20, 60)]
    for item in heard:
        pass_by(node, item)
    kept = len(node.overheard)
    assert kept
    for sequence in range(7):
        [answer] = node.receive(data(CUSTODIAN, node.id, (100 + sequence, datum(sequence=sequence))), 1.0)
        assert answer.committed  # type: ignore[union-attr]
        check_node(node)
    node.put(b"own", 1.0)
    check_node(node)
    assert not node.overheard
    node = bystander(capacity_items=8)
    for item in heard:
        pass_by(node, item)
    for sequence in range(8):
        replica = Data(CUSTODIAN, node.id, (Handover(100 + sequence, datum(sequence=sequence)),), True)
        [answer] = of(Committed, node.receive(replica, 1.0))
        assert answer.committed
        check_node(node)
    assert not node.overheard
    assert len(node.holdings.replica) == 8


def test_one_neighbour_and_one_origin_get_only_a_part() -> None:
    most = 100 // PART
    node = bystander(capacity_items=100)
    for origin in range(10, 1000):
        pass_by(node, datum(origin))
    assert len(node.overheard) == most
    node = make_node(1, mirror=True, overhear=True, capacity_items=100)
    for sender in range(100, 200):
        node.receive(beacon(sender), 0.0)
        for sequence in range(20):
            pass_by(node, datum(sequence=20 * sender + sequence), sender=sender)
    assert len(node.overheard) == most
    check_node(node)


def test_the_fuller_the_store_the_less_is_kept() -> None:
    kept = []
    for held in (60, 90, 100):
        node = bystander(capacity_items=100)
        for _ in range(held):
            node.put(b"own", 0.5)
        for origin in range(10, 15):
            pass_by(node, datum(origin))
        kept.append(len(node.overheard))
    assert kept[0] == 5
    assert 5 > kept[1] > kept[2] == 0


def test_only_hand_overs_to_others_are_let_through_and_only_on_request() -> None:
    peers = Peers(1, FrameWriter(1, 191), 33200)
    [passing] = encode(data(CUSTODIAN, FORWARDER, (77, datum())), 0.0)
    [answer] = encode(Committed(FORWARDER, CUSTODIAN, ((77, 1),), ()), 0.0)
    [offer] = encode(Offer(CUSTODIAN, FORWARDER, 78, DatumId(9, 1, 0), 0, 0.0, 0, 1, 5000, 123), 0.0)
    [accept] = encode(Accept(FORWARDER, CUSTODIAN, 78, 7, 0), 0.0)
    for payload, overhears, heard in (
        *((of_hand_over, on, on) for of_hand_over in (passing, offer, accept) for on in (True, False)),
        (answer, True, False),
    ):
        peers.overhears = overhears
        [frame] = FrameReader().datagram(FrameWriter(2, 191).tunnel(payload, payload_type=33200))
        message = peers.understood(frame, 0.0)
        assert (message is not None) == heard
