"""Data that neighbours hand over to each other, and that other nodes hear."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.agent.peers import Peers
from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.messages import (
    Accept,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionReport,
    Handover,
    Offer,
)
from rass_mav.core.node import Node
from rass_mav.core.replicas.overheard import KEPT_TURNS, PART
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.reader import FrameReader
from rass_mav.wire import encode

from .books import check_node
from .build import beacon, data, datum, loss, make_node, of, statement

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


def test_an_overheard_datum_is_kept_in_memory_only() -> None:
    node, item = bystander(), datum()
    keep(node, item)
    assert item.id not in node.holdings
    assert list(node.store.ids()) == []
    assert not node.store.unwritten
    assert node.figures()["overheard"] == 1
    # It counts as free space, and is neither handed over nor offered.
    assert node.holdings.free() == 1000
    assert of(Data, node.step(1.0)) == []
    check_node(node)


def test_without_the_setting_nothing_is_kept() -> None:
    assert bystander().overhears
    node, base = bystander(overhear=False), make_node(0, base=True)
    for hearer in (node, base):
        pass_by(hearer, datum())
        assert not hearer.overheard
        assert list(hearer.store.ids()) == []


def test_a_drone_without_replicas_keeps_nothing() -> None:
    node = make_node(1, overhear=True, capacity_items=1000)
    node.receive(beacon(CUSTODIAN), 0.0)
    pass_by(node, datum())
    assert not node.overheard


def test_strangers_damaged_data_and_what_has_arrived_are_not_kept() -> None:
    node, item = bystander(), datum()
    damaged = item._replace(payload=b"another")
    arrived = datum(sequence=1)
    node.receive(statement(arrived.id), 0.0)
    pass_by(node, item, sender=99)
    pass_by(node, damaged, arrived)
    assert not node.overheard


def test_a_node_does_not_keep_what_was_created_in_its_name() -> None:
    node = bystander()
    forged = make_datum(DatumId(node.id, node.store.epoch, 3), 0, 0.0, b"forged")
    pass_by(node, forged)
    assert not node.overheard
    assert node.alarms.counts == {Alarm.ID_CONFLICT: 1}


def test_a_datum_that_a_neighbour_has_lost_comes_back() -> None:
    node, item = bystander(), datum()
    keep(node, item)
    assert words(node, 7, (item.id, CopyStatus.WANTED)) == [(7, item.id, CopyStatus.HERE)]
    assert item.id in node.overheard
    assert words(node, 7, (item.id, CopyStatus.AGAIN)) == [(7, item.id, CopyStatus.TAKEN)]
    holding = node.holdings.custody[item.id]
    assert holding.crc == item.crc
    assert not node.overheard
    # TAKEN waits for the disk.
    assert node.store.unwritten
    check_node(node)


def test_a_corrupt_one_is_of_no_use() -> None:
    node, item = bystander(), datum()
    keep(node, item)
    node.overheard[item.id] = item._replace(payload=b"reasing")
    assert words(node, 7, (item.id, CopyStatus.WANTED)) == []
    assert not node.overheard
    check_node(node)


@pytest.mark.parametrize("reported", ["by a note", "by a base"])
def test_a_datum_that_was_reported_lost_comes_back(reported: str) -> None:
    node, item = bystander(), datum()
    keep(node, item)
    if reported == "by a note":
        answers = node.receive(DeletionReport(7, node.id, (loss(12, item.id, 1),)), 1.0)
        assert of(Committed, answers) == [Committed(node.id, 7, ((12, 0),), ())]
    else:
        node.receive(statement(item.id, lost=True), 1.0)
    assert item.id in node.holdings.custody


def test_a_receipt_ends_it() -> None:
    node, item, other = bystander(), datum(), datum(sequence=1)
    keep(node, item)
    keep(node, other)
    node.receive(statement(item.id), 1.0)
    assert list(node.overheard) == [other.id]
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


def test_an_expired_one_is_forgotten() -> None:
    node, item = bystander(lifetime_s=10.0), datum()
    keep(node, item)
    node.step(9.0)
    assert item.id in node.overheard
    node.step(11.0)
    assert not node.overheard


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


def test_what_is_handed_over_replaces_it_whatever_was_overheard_under_its_id() -> None:
    """A forged frame must not make a node refuse the true datum."""
    node, item = bystander(), datum()
    keep(node, make_datum(item.id, 0, 0.0, b"forged"))
    [answer] = node.receive(data(CUSTODIAN, node.id, (12, item)), 1.0)
    assert answer == Committed(node.id, CUSTODIAN, ((12, item.crc),), ())
    assert node.store.get(item.id) == item.arrived()
    assert not node.overheard
    check_node(node)


def test_nothing_that_is_held_changes_because_of_what_is_overheard() -> None:
    node, item, replica = bystander(), datum(), datum(sequence=1)
    node.receive(data(CUSTODIAN, node.id, (12, item)), 1.0)
    node.receive(Data(CUSTODIAN, node.id, (Handover(13, replica),), True), 1.0)
    before = {id: node.store.get(id) for id in node.store.ids()}
    for id in before:
        pass_by(node, make_datum(id, 0, 0.0, b"forged"))
    assert {id: node.store.get(id) for id in node.store.ids()} == before
    assert not node.overheard


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


def test_a_base_takes_what_it_overhears_and_answers_nobody() -> None:
    base, item = make_node(0, base=True, overhear=True), datum()
    pass_by(base, item)
    assert base.store.get(item.id) == item.arrived()
    # When the datum comes to it, it has it already.
    [answer] = base.receive(data(FORWARDER, base.id, (12, item)), 1.0)
    assert answer == Committed(base.id, FORWARDER, ((12, item.crc),), ())


def test_a_base_that_overhears_another_content_keeps_the_one_it_has() -> None:
    base, item = make_node(0, base=True, overhear=True), datum()
    pass_by(base, item, make_datum(item.id, 0, 0.0, b"forged"), datum(sequence=1)._replace(payload=b"damaged"))
    assert list(base.store.ids()) == [item.id]
    assert base.store.get(item.id) == item.arrived()
    assert list(base.store.apart()) == []


def test_giving_up_custody_is_not_possible_by_overhearing() -> None:
    """A node hears its own datum handed on by the next hop: it may be another copy, or not on disk there."""
    node = bystander()
    id = node.put(b"reading", 0.0)
    item = node.store.get(id)
    assert item is not None
    pass_by(node, item, sender=FORWARDER)
    assert id in node.holdings.custody
    node.custody_store.drop(node.holdings.custody[id], Fate.PASSED_ON)
    assert id not in node.holdings


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
