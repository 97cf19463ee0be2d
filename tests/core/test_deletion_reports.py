"""Deletion reports: how they travel, and that none of them costs a datum."""

from __future__ import annotations

import pytest

from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import Committed, DeletionReport
from rass_mav.core.news.deletion_reports import MAX_NOTES, NOTES_IN_FRAME, DeletionReports, Note, NoteOffer
from rass_mav.core.news.statements import note_crc
from rass_mav.core.node import Node
from rass_mav.wire import encode
from rass_mav.wire.codec import MAX_TUNNEL
from tests.some import some

from .build import data, datum, loss, make_node, of, talk
from .durable import DurableStore
from .test_node import with_base

ID = DatumId(9, 77, 0)


def note(sender: int, target: int, *entries: tuple[int, DatumId, int]) -> DeletionReport:
    return DeletionReport(sender, target, tuple(loss(*entry) for entry in entries))


def handed(id: DatumId, custodian: int, reason: int = 1) -> Note:
    """What a neighbour hands on."""
    return Note(reason, note_crc(id, reason), custodian)


class Notes(DeletionReports):
    """With the exchange that it asks in."""

    def __init__(self, store: DurableStore) -> None:
        self.exchange = Exchange(0)
        super().__init__(store, self.exchange)

    def offer(self, number: int, sender: int) -> NoteOffer | None:
        """What an answer to this number is about."""
        offer = self.exchange.answered(number, sender)
        assert offer is None or isinstance(offer, NoteOffer)
        return offer

    def answer(self, said: DeletionReport) -> None:
        """Its target takes the first note of a message."""
        if (offer := self.offer(said.entries[0].number, said.target)) is not None:
            self.committed(offer)


def corrupt(node: Node, id: DatumId) -> None:
    node.store.flip_bit(id)  # type: ignore[attr-defined]


# -- the notes of one node ---------------------------------------------------------------------------------------------


def test_a_frame_holds_as_many_notes_as_are_sent_at_a_time() -> None:
    full = note(1, 2, *[(n, ID, 1) for n in range(NOTES_IN_FRAME)])
    assert [len(frame) <= MAX_TUNNEL for frame in encode(full, 0.0)] == [True]
    assert len(encode(note(1, 2, *[(n, ID, 1) for n in range(NOTES_IN_FRAME + 1)]), 0.0)) == 2


def test_another_next_hop_gets_other_numbers() -> None:
    notes = Notes(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    first, second = notes.turn(1, 5, 0.0), notes.turn(1, 6, 0.0)
    assert first is not None
    assert second is not None
    assert (first.target, second.target) == (5, 6)
    notes.answer(first)
    assert ID in notes.waiting
    notes.answer(second)
    assert ID not in notes.waiting


def test_a_note_that_comes_round_is_not_deleted_by_a_late_answer() -> None:
    notes = Notes(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    said = some(notes.turn(1, 5, 0.0))
    assert notes.take(ID, handed(ID, 6))
    notes.answer(said)
    assert ID in notes.waiting


def test_notes_are_bounded_and_of_only_own_ones_the_oldest_goes() -> None:
    store = DurableStore(1)
    notes = Notes(store)
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
    assert len(Notes(store).waiting) == MAX_NOTES
    assert len(dict(store.losses())) == MAX_NOTES


def test_a_flood_takes_no_room_from_own_notes_nor_from_other_neighbours() -> None:
    store = DurableStore(1)
    notes = Notes(store)
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
    notes = Notes(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    for flipped in (1 ^ 2, 1 ^ 1 << 30):
        notes.waiting[ID] = notes.waiting[ID]._replace(reason=flipped)
        assert notes.turn(1, 5, 0.0) is None
        # The disk knows what it was.
        said = some(notes.turn(1, 5, 0.0))
        assert said.entries[0]._replace(number=1) == loss(1, ID, 1)


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
    assert nodes[0].figures()["reported_lost"] == 0
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
    notes = Notes(DurableStore(1))
    notes.make(ID, Fate.CORRUPTED)
    number = some(notes.turn(1, 5, 0.0)).entries[0].number
    notes.refused(some(notes.offer(number, 5)))
    again = some(notes.turn(1, 5, 0.0))
    assert again.entries[0].number not in (0, number)


def test_notes_that_nobody_takes_do_not_keep_the_others_waiting() -> None:
    """A liar hands on words of damage, of which the base has as many as it keeps."""
    notes = Notes(DurableStore(1))
    unwanted = {DatumId(60, 1, n) for n in range(2 * NOTES_IN_FRAME)}
    for id in unwanted:
        assert notes.take(id, handed(id, 9, 7))
    notes.make(ID, Fate.CORRUPTED)
    said: set[DatumId] = set()
    for _ in range(3):
        frame = some(notes.turn(1, 5, 0.0))
        for number, id, *_ in frame.entries:
            said.add(id)
            (notes.refused if id in unwanted else notes.committed)(some(notes.offer(number, 5)))
    assert said == {*unwanted, ID}
    assert notes.waiting.keys() == unwanted


def test_a_proof_travels_and_outlives_a_restart() -> None:
    store = DurableStore(1)
    notes = Notes(store)
    assert notes.take(ID, handed(ID, 9)._replace(proof=b"of node 7"))
    store.commit()
    for again in (notes, Notes(store)):
        frame = some(again.turn(1, 5, 0.0))
        assert [entry.proof for entry in frame.entries] == [b"of node 7"]


def test_a_forged_note_does_not_take_the_place_of_a_true_one() -> None:
    notes = Notes(DurableStore(1))
    assert notes.take(ID, handed(ID, 9)._replace(proof=b"forged"))
    assert not notes.take(ID, handed(ID, 8)._replace(proof=b"true"))
    frame = some(notes.turn(1, 5, 0.0))
    notes.answer(frame)
    assert notes.take(ID, handed(ID, 8)._replace(proof=b"true"))


# -- who takes a note, and who swallows it -----------------------------------------------------------------------------
