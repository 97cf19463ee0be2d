"""Deletion reports: how they travel, and that none of them costs a datum."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import Committed, Data, DeletionReport
from rass_mav.core.news.deletion_reports import MAX_NOTES, NOTES_IN_FRAME, DeletionReports, Note, fate_of
from rass_mav.core.news.statements import note_crc
from rass_mav.core.node import Node
from rass_mav.wire import encode
from rass_mav.wire.codec import MAX_TUNNEL

from .build import data, datum, loss, make_node, of, statement, talk
from .durable import DurableStore
from .replica_net import Net as ReplicaNet
from .test_node import with_base

ID = DatumId(9, 77, 0)


def note(sender: int, target: int, *entries: tuple[int, DatumId, int]) -> DeletionReport:
    return DeletionReport(sender, target, tuple(loss(*entry) for entry in entries))


def handed(id: DatumId, custodian: int, reason: int = 1) -> Note:
    """What a neighbour hands on."""
    return Note(reason, note_crc(id, reason), custodian)


def corrupt(node: Node, id: DatumId) -> None:
    node.store.flip_bit(id)  # type: ignore[attr-defined]


# -- the notes of one node ---------------------------------------------------------------------------------------------


def test_a_frame_holds_as_many_notes_as_are_sent_at_a_time() -> None:
    full = note(1, 2, *[(n, ID, 1) for n in range(NOTES_IN_FRAME)])
    assert [len(frame) <= MAX_TUNNEL for frame in encode(full, 0.0)] == [True]
    assert len(encode(note(1, 2, *[(n, ID, 1) for n in range(NOTES_IN_FRAME + 1)]), 0.0)) == 2


def test_a_corrupt_datum_is_told_to_the_next_hop_until_it_answers() -> None:
    node = make_node(1, receipt_steps=1)
    id = node.put(b"x", 0.0)
    corrupt(node, id)
    assert of(DeletionReport, node.step(0.0)) == []  # nobody is around
    with_base(node)
    [first] = of(DeletionReport, node.step(1.0))
    [again] = of(DeletionReport, node.step(2.0))
    assert first == again
    assert (first.target, first.entries[0].id, first.entries[0].reason) == (0, id, 1)
    number = first.entries[0].number
    # Other numbers and other neighbours mean nothing.
    node.receive(Committed(0, 1, ((number + 1, 0),), ()), 2.0)
    node.receive(Committed(5, 1, ((number, 0),), ()), 2.0)
    assert list(node.store.losses()) == [(id, Fate.CORRUPTED)]
    node.receive(Committed(0, 1, ((number, 0),), ()), 2.0)
    assert list(node.store.losses()) == []
    assert of(DeletionReport, node.step(3.0)) == []
    assert node.store.counters()["corrupted"] == 1


def test_an_expired_datum_is_told_too() -> None:
    node = with_base(make_node(1, lifetime_s=5.0, receipt_steps=1, bandwidth_items=1))
    ids = [node.put(b"x", 0.0) for _ in range(3)]
    [said] = of(DeletionReport, with_base(node, 6.0, number=1).step(6.0))
    assert {(entry.id, entry.reason) for entry in said.entries} == {(id, 2) for id in ids}


def test_notes_are_said_in_turn_only() -> None:
    node = with_base(make_node(1, receipt_steps=4))
    id = node.put(b"x", 0.0)
    corrupt(node, id)
    said = []
    for t in range(12):
        with_base(node, float(t), number=t + 1)
        said.append(len(of(DeletionReport, node.step(float(t)))))
    assert sum(said) == 3
    assert said[:4] == said[4:8] == said[8:]


def test_another_next_hop_gets_other_numbers() -> None:
    notes = DeletionReports(DurableStore(1))
    numbers = itertools.count(1)
    notes.make(ID, Fate.CORRUPTED)
    first, second = notes.turn(1, 5, numbers.__next__), notes.turn(1, 6, numbers.__next__)
    assert first is not None
    assert second is not None
    assert (first.target, second.target) == (5, 6)
    notes.committed(first.entries[0].number, 5)
    assert ID in notes.waiting
    notes.committed(second.entries[0].number, 6)
    assert ID not in notes.waiting


def test_a_note_that_comes_round_is_not_deleted_by_a_late_answer() -> None:
    notes = DeletionReports(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    said = notes.turn(1, 5, itertools.count(1).__next__)
    assert said is not None
    assert notes.take(ID, handed(ID, 6))
    notes.committed(said.entries[0].number, 5)
    assert ID in notes.waiting


def test_notes_are_bounded_and_of_only_own_ones_the_oldest_goes() -> None:
    store = DurableStore(1)
    notes = DeletionReports(store)
    for sequence in range(MAX_NOTES + 3):
        notes.make(DatumId(9, 77, sequence), Fate.CORRUPTED)
    assert list(notes.waiting) == [DatumId(9, 77, s) for s in range(3, MAX_NOTES + 3)]
    assert dict(store.losses()).keys() == notes.waiting.keys()
    assert store.counters() == {"notes_dropped": 3}
    other = DatumId(8, 77, 0)
    assert not notes.take(other, handed(other, 5))
    known = DatumId(9, 77, 5)
    assert notes.take(known, handed(known, 5))
    assert len(notes.waiting) == MAX_NOTES
    # A table of an earlier version may be longer.
    store.lose(DatumId(9, 77, 999), Fate.CORRUPTED)
    assert len(DeletionReports(store).waiting) == MAX_NOTES
    assert len(dict(store.losses())) == MAX_NOTES


def test_a_flood_takes_no_room_from_own_notes_nor_from_other_neighbours() -> None:
    store = DurableStore(1)
    notes = DeletionReports(store)
    own = [DatumId(1, 77, s) for s in range(100)]
    for id in own[:50]:
        notes.make(id, Fate.CORRUPTED)
    flood = [DatumId(9, 1, s) for s in range(1000)]
    taken = [notes.take(id, handed(id, 7)) for id in flood]
    assert sum(taken) == MAX_NOTES - 50
    for id in own[50:]:
        notes.make(id, Fate.EXPIRED)
    # Another neighbour, and another origin by way of the same one, get their share.
    others = [DatumId(2, 1, s) for s in range(20)]
    assert all(notes.take(id, handed(id, 5)) for id in others)
    relayed = [DatumId(3, 1, s) for s in range(10)]
    assert all(notes.take(id, handed(id, 7)) for id in relayed)
    assert {*own, *others, *relayed} <= notes.waiting.keys()
    assert len(notes.waiting) == MAX_NOTES
    assert dict(store.losses()).keys() == notes.waiting.keys()


def test_a_note_whose_checksum_does_not_fit_is_neither_taken_nor_answered() -> None:
    for node in (make_node(1), make_node(1, base=True)):
        good, bad = DatumId(9, 77, 1), DatumId(9, 77, 2)
        message = DeletionReport(7, 1, (loss(5, good, 1), loss(6, bad, 1)._replace(reason=2)))
        assert node.receive(message, 0.0) == [Committed(1, 7, ((5, 0),), ())]
        assert dict(node.store.losses()) == {good: Fate.CORRUPTED}
        assert node.receive(DeletionReport(7, 1, message.entries[1:]), 0.0) == []


def test_a_note_that_was_struck_in_memory_is_not_handed_on() -> None:
    notes = DeletionReports(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    for flipped in (1 ^ 2, 1 ^ 1 << 30):
        notes.waiting[ID] = notes.waiting[ID]._replace(reason=flipped)
        assert notes.turn(1, 5, itertools.count(1).__next__) is None
        # The disk knows what it was.
        said = notes.turn(1, 5, itertools.count(1).__next__)
        assert said is not None
        assert said.entries[0] == loss(1, ID, 1)


def test_a_reason_that_is_not_known_is_carried_along() -> None:
    node = make_node(1, receipt_steps=1)
    node.receive(note(7, 1, (6, ID, 77)), 0.0)
    [said] = of(DeletionReport, with_base(node).step(1.0))
    assert said.entries[0][1:] == loss(0, ID, 77)[1:]


@pytest.mark.parametrize(
    ("fate", "alarm", "figure"),
    [(Fate.UNKNOWN, Alarm.UNKNOWN, "told_unknown"), (Fate.DAMAGED, Alarm.DAMAGED, "told_damaged")],
)
def test_word_of_damage_travels_to_the_base_which_tells_the_ground(fate: Fate, alarm: Alarm, figure: str) -> None:
    stores = {i: DurableStore(1000 + i) for i in range(3)}
    about = DatumId(2, 77, 0)
    # As a store that was found damaged says it. A datum with the same numbers is another thing.
    stores[2].lose(about, fate)
    nodes = {i: make_node(i, base=i == 0, store=stores[i], receipt_steps=1) for i in range(3)}
    nodes[2].receive(data(7, 2, (5, datum(2))), 0.0)
    nodes[1].receive(data(7, 1, (5, datum(2))), 0.0)
    near = {0: [1], 1: [0, 2], 2: [1]}
    for t in range(1, 14):
        for i, node in nodes.items():
            out = node.step(float(t))
            talk({j: nodes[j] for j in (i, *near[i])}, out, float(t))
    assert [dict(stores[i].losses()) for i in range(3)] == [{about: fate}, {}, {}]
    assert nodes[0].figures()[figure] == 1
    assert nodes[0].figures()["is_reported_lost"] == 0
    assert nodes[0].alarms.counts == {alarm: 1}
    assert not any(node.receipts.is_reported_lost(about) for node in nodes.values())
    # The base knows it after a restart, and rings no more for it.
    stores[0].commit()
    again = make_node(0, base=True, store=stores[0].crashed())
    assert again.figures()[figure] == 1
    [answer] = again.receive(note(7, 0, (9, about, {Fate.UNKNOWN: 6, Fate.DAMAGED: 7}[fate])), 0.0)
    assert answer == Committed(0, 7, ((9, 0),), ())
    assert again.alarms.counts == {}


def test_a_refused_note_is_offered_again() -> None:
    notes = DeletionReports(DurableStore(1))
    numbers = itertools.count(1)
    notes.make(ID, Fate.CORRUPTED)
    notes.turn(1, 5, numbers.__next__)
    notes.refused(1, 5)
    again = notes.turn(1, 5, numbers.__next__)
    assert again is not None
    assert again.entries[0].number == 2


def test_notes_that_nobody_takes_do_not_keep_the_others_waiting() -> None:
    """A liar hands on words of damage, of which the base has as many as it keeps."""
    notes = DeletionReports(DurableStore(1))
    numbers = itertools.count(1)
    unwanted = {DatumId(60, 1, n) for n in range(2 * NOTES_IN_FRAME)}
    for id in unwanted:
        assert notes.take(id, handed(id, 9, 7))
    notes.make(ID, Fate.CORRUPTED)
    said: set[DatumId] = set()
    for _ in range(3):
        frame = notes.turn(1, 5, numbers.__next__)
        assert frame is not None
        for number, id, *_ in frame.entries:
            said.add(id)
            (notes.refused if id in unwanted else notes.committed)(number, 5)
    assert said == {*unwanted, ID}
    assert notes.waiting.keys() == unwanted


def test_a_proof_travels_and_outlives_a_restart() -> None:
    store = DurableStore(1)
    notes = DeletionReports(store)
    assert notes.take(ID, handed(ID, 9)._replace(proof=b"of node 7"))
    store.commit()
    for again in (notes, DeletionReports(store)):
        frame = again.turn(1, 5, itertools.count(1).__next__)
        assert frame is not None
        assert [entry.proof for entry in frame.entries] == [b"of node 7"]


def test_a_forged_note_does_not_take_the_place_of_a_true_one() -> None:
    notes = DeletionReports(DurableStore(1))
    assert notes.take(ID, handed(ID, 9)._replace(proof=b"forged"))
    assert not notes.take(ID, handed(ID, 8)._replace(proof=b"true"))
    frame = notes.turn(1, 5, itertools.count(1).__next__)
    assert frame is not None
    notes.committed(frame.entries[0].number, 5)
    assert notes.take(ID, handed(ID, 8)._replace(proof=b"true"))


def test_notes_outlive_a_restart() -> None:
    store = DurableStore(1)
    node = with_base(make_node(1, store=store, receipt_steps=1))
    id = node.put(b"x", 0.0)
    corrupt(node, id)
    node.step(0.0)
    store.commit()
    again = make_node(1, store=store.crashed(), receipt_steps=1, newborn=True)
    [said] = of(DeletionReport, with_base(again).step(1.0))
    assert said.entries[0].id == id


@pytest.mark.parametrize("settings", [{"receipts": False}, {"acknowledged": False}])
def test_without_receipts_or_without_custody_there_are_no_notes(settings: dict[str, Any]) -> None:
    node = with_base(make_node(1, receipt_steps=1, **settings))
    id = node.put(b"x", 0.0)
    corrupt(node, id)
    assert of(DeletionReport, node.step(1.0)) == []
    assert list(node.store.losses()) == [(id, Fate.CORRUPTED)]
    assert node.receive(note(7, 1, (5, ID, 1)), 1.0) == []


# -- who takes a note, and who swallows it -----------------------------------------------------------------------------


def test_a_note_goes_from_hand_to_hand_to_the_base_which_says_so() -> None:
    nodes = {i: make_node(i, base=i == 0, receipt_steps=1) for i in range(3)}
    id = nodes[2].put(b"x", 0.0)
    corrupt(nodes[2], id)
    near = {0: [1], 1: [0, 2], 2: [1]}
    for t in range(1, 14):
        for i, node in nodes.items():
            out = node.step(float(t))
            talk({j: nodes[j] for j in (i, *near[i])}, out, float(t))
    assert dict(nodes[0].store.losses()) == {id: Fate.CORRUPTED}
    assert nodes[0].archive is not None
    assert nodes[0].archive.is_reported_lost == 1
    for i in (1, 2):
        assert list(nodes[i].store.losses()) == []
        assert nodes[i].receipts is not None
        assert nodes[i].receipts.is_reported_lost(id)
        assert id not in nodes[i].custody_store.arrived


def test_a_base_takes_each_reason_and_a_datum_that_turns_up_is_lost_no_longer() -> None:
    store = DurableStore(1)
    base = make_node(0, base=True, store=store, receipt_steps=1)
    reasons = [1, 2, 3, 4, 5, 77]
    [answer] = base.receive(note(7, 0, *[(n + 1, DatumId(9, 77, n), r) for n, r in enumerate(reasons)]), 0.0)
    assert answer == Committed(0, 7, tuple((n + 1, 0) for n in range(6)), ())
    assert [fate for _, fate in sorted(store.losses())] == [fate_of(r) for r in reasons]
    assert fate_of(77) is Fate.VANISHED
    d = datum(9, 0)
    [answer] = base.receive(data(7, 0, (5, d)), 0.0)
    assert answer == Committed(0, 7, ((5, d.crc),), ())
    assert d.id in base.custody_store.arrived
    assert d.id not in dict(store.losses())
    store.commit()
    again = make_node(0, base=True, store=store.crashed())
    assert again.archive is not None
    assert (again.archive.is_reported_lost, d.id in again.custody_store.arrived) == (5, True)
    # A note about what has arrived is of no use any more.
    [answer] = base.receive(note(7, 0, (9, d.id, 1)), 0.0)
    assert answer == Committed(0, 7, ((9, 0),), ())
    assert d.id not in dict(base.store.losses())


def test_who_holds_a_good_copy_swallows_the_note() -> None:
    node = make_node(1)
    d = datum()
    node.receive(data(7, 1, (5, d)), 0.0)
    [answer] = node.receive(note(7, 1, (6, d.id, 1)), 0.0)
    assert answer == Committed(1, 7, ((6, 0),), ())
    assert list(node.holdings.custody) == [d.id]
    assert list(node.store.losses()) == []


def test_a_note_about_a_copy_that_is_corrupt_here_too_goes_on() -> None:
    node = make_node(1)
    d = datum()
    node.receive(data(7, 1, (5, d)), 0.0)
    corrupt(node, d.id)
    node.receive(note(7, 1, (6, d.id, 1)), 0.0)
    assert list(node.holdings.custody) == []
    assert list(node.store.losses()) == [(d.id, Fate.CORRUPTED)]


def test_who_gets_the_datum_has_no_note_of_it_any_more() -> None:
    node = make_node(1)
    d = datum()
    node.receive(note(7, 1, (6, d.id, 1)), 0.0)
    assert dict(node.store.losses()) == {d.id: Fate.CORRUPTED}
    node.receive(data(7, 1, (5, d)), 0.0)
    assert list(node.store.losses()) == []


def test_a_receipt_ends_no_note() -> None:
    node = make_node(1)
    lost = [DatumId(9, 77, s) for s in range(3)]
    for id in lost[:2]:
        node.receive(note(7, 1, (6, id, 1)), 0.0)
    node.receive(statement(lost[0], lost[2]), 0.0)
    node.receive(statement(lost[1], serial=1, lost=True), 0.0)
    node.receive(note(7, 1, (9, lost[2], 1)), 0.0)
    assert [id for id, _ in node.store.losses()] == lost


def test_a_good_copy_is_kept_and_handed_on_though_a_base_was_told_that_it_is_lost() -> None:
    node = make_node(1)
    d = datum()
    node.receive(data(7, 1, (5, d)), 0.0)
    node.receive(statement(d.id, lost=True), 0.0)
    assert list(node.holdings.custody) == [d.id]
    # It is not answered as if it had arrived, either.
    [answer] = node.receive(data(7, 1, (8, datum(sequence=1))), 0.0)
    assert answer.committed == ((8, datum(sequence=1).crc),)  # type: ignore[union-attr]
    [sent] = of(Data, with_base(node, 1.0).step(1.0))
    assert d.id in [h.datum.id for h in sent.handovers]


def test_a_replica_is_taken_into_custody_when_the_datum_is_told_lost() -> None:
    net = ReplicaNet({1: 0.4, 2: 0.2, 3: 0.1}, [(1, 2), (2, 3)], mirror_until_receipt=True, receipts=True)
    id = net.put(1)
    net.step(4)
    assert net.custody(id) == [3]
    assert 1 in net.replicas(id)
    net.nodes[1].receive(statement(id, lost=True), net.now)
    assert id in net.nodes[1].holdings.custody
    # 2 has a replica, which ends with a receipt; custody does not.
    assert id in net.nodes[2].holdings
    for node in net.nodes.values():
        node.receive(statement(id, serial=1), net.now)
    assert net.custody(id) == [1, 3]
    assert id not in net.nodes[2].holdings
