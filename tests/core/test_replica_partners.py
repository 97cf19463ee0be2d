"""Replicas when a partner goes, a word is lost or late, or room is short."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.core.custody.percolation import MOVING_TURNS
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import (
    Beacon,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
    PassedOn,
)
from rass_mav.core.node import Node
from rass_mav.core.replicas.replicas import ASK_STEPS, MAX_PASSED

from .books import check_node, replicas, replicas_of
from .build import MANY, beacon, data, datum, make_node, of
from .replica_net import CHAIN, RISKS, Net, at_rest, handed_over

# -- partners that go --------------------------------------------------------------------------------------------------


def test_when_the_custodian_is_gone_its_data_are_taken_back() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.off.add(3)
    net.step(20)
    # Some lost beacons are no reason.
    assert 2 not in net.custody(id)
    net.step(10)
    assert 2 in net.custody(id)
    assert net.active(id) == [1]


def test_a_wiped_custodian_has_nothing_any_more() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.stores[3] = type(net.stores[3])(epoch=77)
    net.start(3)
    net.step()
    net.step()
    assert net.custody(id) != []
    assert list(net.stores[3].losses()) == []


@pytest.mark.parametrize("numbers_lost", [False, True])
def test_a_custodian_whose_battery_was_pulled_is_the_same_custodian(numbers_lost: bool) -> None:
    """Also if it gives its new data another epoch, for it may have lost numbers: it has what it held."""
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    store = net.stores[3]
    store.commit()
    net.stores[3] = store.crashed()
    net.stores[3].life = store.life
    if numbers_lost:
        net.stores[3].epoch = store.epoch + 1
    net.start(3)
    net.step(15)
    assert net.custody(id) == [3]
    assert net.active(id) == [2]
    made = net.put(3)
    assert made.epoch == net.stores[3].epoch


def test_when_the_holder_is_gone_another_one_is_found() -> None:
    net = Net({**RISKS, 4: 0.4}, [*CHAIN, (3, 4)])
    id = at_rest(net)
    assert net.holder(3, id) == 2
    net.off.add(2)
    net.step(31)
    assert net.holder(3, id) == 4
    assert net.active(id) == [2, 4]


def test_a_restarted_node_counts_all_it_has_as_custody() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    for store in net.stores.values():
        store.commit()
        store.close()
    net.stores[2] = net.stores[2].crashed()
    net.start(2)
    assert net.custody(id) == [2, 3]
    # It moves on like any other, and 3 has it already.
    net.step(15)
    assert net.custody(id) == [3]
    assert net.active(id) == [2]


# -- words that are lost or late ---------------------------------------------------------------------------------------


def test_a_lost_passed_on_is_asked_for() -> None:
    net = Net(RISKS, CHAIN)
    id = handed_over(net)
    net.loses = lambda message: type(message) is PassedOn
    net.step(2)
    assert net.of(PassedOn) == [PassedOn(2, 1, (id,))]
    net.loses = lambda message: False
    assert net.custody(id) == [3]
    assert net.active(id) == [1, 2]
    asked: list[Message] = []
    for _ in range(ASK_STEPS):
        net.step()
        asked += [m for m in net.of(CopyStatuses) if m.sender == 1]
    assert asked == [CopyStatuses(1, 2, (CopyStatusEntry(id, CopyStatus.STILL),))]
    assert net.active(id) == [2]


def test_a_holder_asks_once_in_so_many_steps() -> None:
    net = Net(RISKS, CHAIN)
    at_rest(net)
    asked = 0
    for _ in range(3 * ASK_STEPS):
        net.step()
        asked += len(net.of(CopyStatuses))
    assert asked == 3


def test_a_holder_that_the_custodian_forgot_is_found_again() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.stores[3].commit()
    net.stores[3] = net.stores[3].crashed()
    net.start(3)
    net.step(ASK_STEPS + 1)
    assert net.custody(id) == [3]
    assert net.holder(3, id) == 2
    assert net.active(id) == [2]


def test_a_datum_that_the_custodian_lost_unseen_is_sent_again() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    # A crash just after a corrupt copy was removed, before anybody could be asked.
    net.nodes[3].store.remove(id, Fate.CORRUPTED)
    net.stores[3].commit()
    net.stores[3] = net.stores[3].crashed()
    net.start(3)
    net.step(ASK_STEPS + 2)
    assert net.custody(id) == [3]


def test_a_late_passed_on_does_not_touch_custody() -> None:
    net = Net(RISKS, CHAIN)
    id = handed_over(net)
    # 1 gets the datum back while 2 still names it as its holder.
    node = net.nodes[1]
    copy = net.stores[2].get(id)
    assert copy is not None
    [answer] = of(Committed, node.receive(data(2, 1, (9, copy)), net.now))
    assert answer == Committed(1, 2, ((9, copy.crc),), ())
    assert id in node.holdings.custody
    assert replicas(node) == 0
    node.receive(PassedOn(2, 1, (id,)), net.now)
    assert id in node.holdings.custody
    assert node.store.get(id) is not None


def test_nobody_but_the_custodian_ends_a_replica() -> None:
    net = Net(RISKS, CHAIN)
    id = handed_over(net)
    net.nodes[1].receive(PassedOn(3, 1, (id,)), net.now)
    assert net.active(id) == [1]


def test_custody_of_a_datum_kept_as_a_replica_is_taken_only_with_a_good_copy() -> None:
    net = Net(RISKS, CHAIN)
    id = handed_over(net)
    copy = net.stores[2].get(id)
    assert copy is not None
    net.strike(1, id)
    said = net.nodes[1].receive(data(2, 1, (9, copy)), net.now)
    assert of(Committed, said) == [Committed(1, 2, ((9, copy.crc),), ())]
    kept = net.stores[1].get(id)
    assert kept is not None
    assert kept.intact
    assert id in net.nodes[1].holdings.custody


def test_a_repeated_hand_over_of_what_was_passed_on_is_answered_with_both_words() -> None:
    net = Net(RISKS, CHAIN)
    net.step()
    id = net.put(1)
    # The answers to 1, and those that beacons repeat.
    net.loses = lambda message: isinstance(message, Beacon | Committed) and message.sender == 2
    net.step(2)
    assert net.custody(id) == [1, 3]
    net.loses = lambda message: False
    # It has heard 2 hand the datum to 3, so it waits longer.
    net.step(MOVING_TURNS + 1)
    assert net.custody(id) == [3]
    net.step()
    assert net.active(id) == [2]


# -- room --------------------------------------------------------------------------------------------------------------


def full_of_replicas(capacity: int, **more: Any) -> tuple[Node, list[DatumId]]:
    """A node whose every place holds an active replica, kept for node 1."""
    node = make_node(2, mirror=True, capacity_items=capacity, **more)
    data = [datum(sequence=s) for s in range(capacity)]
    for s, d in enumerate(data):
        node.receive(Data(1, 2, (Handover(s + 1, d),), True), 0.0)
    assert replicas(node) == capacity
    return node, [d.id for d in data]


def test_replicas_yield_to_custody_the_oldest_first_and_who_counts_on_them_is_told() -> None:
    node, ids = full_of_replicas(3)
    assert node.holdings.free() == 3
    new = datum(sequence=9)
    said = node.receive(data(3, 2, (7, new)), 0.0)
    assert said == [
        Committed(2, 3, ((7, new.crc),), ()),
        CopyStatuses(2, 1, (CopyStatusEntry(ids[0], CopyStatus.NONE),)),
    ]
    assert set(node.holdings) == {new.id, *ids[1:]}
    own = node.put(b"own", 0.0)
    assert set(node.holdings) == {new.id, own, ids[2]}


def test_replicas_that_nobody_counts_on_go_first() -> None:
    node, ids = full_of_replicas(3, mirror_until_receipt=True)
    node.receive(PassedOn(1, 2, (ids[2],)), 0.0)
    new = datum(sequence=9)
    said = node.receive(data(3, 2, (7, new)), 0.0)
    assert of(CopyStatuses, said) == []
    assert set(node.holdings) == {new.id, *ids[:2]}


def test_a_replica_never_takes_the_place_of_custody_or_of_a_replica_that_counts() -> None:
    node, ids = full_of_replicas(2, mirror_until_receipt=True)
    late = datum(sequence=9)
    assert node.receive(Data(3, 2, (Handover(7, late),), True), 0.0) == [Committed(2, 3, (), (7,))]
    node.receive(PassedOn(1, 2, (ids[1],)), 0.0)
    assert node.receive(Data(3, 2, (Handover(8, late),), True), 0.0) == [Committed(2, 3, ((8, late.crc),), ())]
    assert set(node.holdings) == {ids[0], late.id}


def test_replicas_yield_bytes_too() -> None:
    node = make_node(2, mirror=True, capacity_bytes=10)
    node.receive(Data(1, 2, (Handover(1, datum(payload=b"1234567")),), True), 0.0)
    assert node.holdings.room_for(10, own=False)
    id = node.put(b"12345", 0.0)
    assert list(node.holdings) == [id]
    node.receive(Data(1, 2, (Handover(2, datum(payload=b"12345")),), True), 0.0)
    assert node.holdings.replica_bytes == 5
    assert node.receive(Data(1, 2, (Handover(3, datum(sequence=1)),), True), 0.0) == [Committed(2, 1, (), (3,))]


def test_replicas_yield_the_quota_and_the_beacon_counts_it_as_free() -> None:
    net = Net({2: 0.0}, [], capacity_items=None, inline_bytes=7)
    net.stores[2] = type(net.stores[2])(5, quota_bytes=14)
    node = net.start(2)
    for s in range(2):
        node.receive(Data(1, 2, (Handover(s + 1, datum(sequence=s)),), True), 0.0)
    assert replicas(node) == 2
    assert not node.store.room_for(7)
    [said] = node.step(1.0)
    assert said.free == MANY  # type: ignore[union-attr]
    for _ in range(2):
        node.put(b"1234567", 1.0)
    assert replicas(node) == 0
    [said, *_] = node.step(2.0)
    assert said.free == 0  # type: ignore[union-attr]


def test_the_memory_of_what_was_passed_on_is_bounded() -> None:
    net = Net({1: 0.9, 2: 0.0}, [(1, 2)], bandwidth_items=1000, capacity_items=1000)
    net.step()
    for _ in range(MAX_PASSED + 5):
        net.put(1)
    net.step()
    node = net.nodes[1]
    assert len(node.holdings.replica) == MAX_PASSED + 5
    assert len(replicas_of(node)._passed) == MAX_PASSED


@pytest.mark.parametrize("word", list(CopyStatus))
@pytest.mark.parametrize("damaged", [False, True])
def test_words_that_name_a_datum_twice_are_words_about_one_datum(word: CopyStatus, damaged: bool) -> None:
    node, d = make_node(2, mirror=True), datum()
    node.receive(data(3, 2, (5, d)), 0.0)
    for sender in (3, 4):
        node.receive(beacon(sender), 0.0)
    node.step(1.0)
    node.store.commit()  # type: ignore[attr-defined]
    if damaged:
        node.store.flip_bit(d.id)  # type: ignore[attr-defined]
    node.receive(CopyStatuses(3, 2, (CopyStatusEntry(d.id, word),) * 2), 1.2)
    check_node(node)
    assert (d.id in node.holdings.custody) or damaged
