"""What a node does with receipts: what they may end, and who contradicts them."""

from __future__ import annotations

import pytest

from rass_mav.core.alarms import Alarm
from rass_mav.core.custody.flow import Flow
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import Datum
from rass_mav.core.messages import Accept, Committed, Data, Receipt, SequenceMark
from rass_mav.core.news.statements import make_sequence_mark
from rass_mav.core.observer import Observer
from rass_mav.core.store import MAX_APART_OF_ONE
from rass_mav.wire import decode, encode

from .build import beacon, data, datum, make_node, of, statement
from .test_node import with_base


@pytest.mark.parametrize("mirror", [False, True])
def test_a_receipt_ends_no_custody_and_is_no_reason_to_say_committed(mirror: bool) -> None:
    node = make_node(1, mirror=mirror, capacity_items=1)
    d, other = datum(), datum(sequence=1)
    node.receive(data(7, 1, (5, d)), 0.0)
    node.receive(statement(d.id, other.id), 0.0)
    assert list(node.holdings.custody) == [d.id]
    [refused] = node.receive(data(8, 1, (9, other)), 0.0)
    assert refused == Committed(1, 8, (), (9,))
    # With room it is taken like any other, and goes to the base.
    roomy = make_node(2)
    roomy.receive(statement(d.id), 0.0)
    assert roomy.receive(data(8, 2, (9, d)), 0.0) == [Committed(2, 8, ((9, d.crc),), ())]
    assert list(roomy.holdings.custody) == [d.id]


def test_a_receipt_near_the_end_of_all_numbers_does_no_harm() -> None:
    last = (1 << 32) - 1
    base = make_node(0, base=True, receipt_steps=1)
    handed = [datum(sequence=last - n) for n in range(17)]
    base.receive(data(7, 0, *[(n + 1, d) for n, d in enumerate(handed)]), 0.0)
    drone = make_node(1, mirror=True)
    for t in range(4):
        for receipt in of(Receipt, base.step(float(t))):
            [payload] = encode(receipt, 0.0)
            heard = decode(payload, 0.0)
            drone.receive(heard, float(t))
            base.receive(heard, float(t))
    assert all(d.id in drone.custody_store.arrived for d in handed)
    assert datum(sequence=0).id not in drone.custody_store.arrived
    base.receive(statement(*[d.id for d in handed], base=3), 5.0)
    base.step(6.0)
    base.store.commit()  # type: ignore[attr-defined]
    again = make_node(0, base=True, store=base.store.crashed(), now=7.0, receipt_steps=1)  # type: ignore[attr-defined]
    assert all(d.id in again.custody_store.arrived for d in handed)
    again.step(8.0)


# -- one id, one content -----------------------------------------------------------------------------------------------


class Apart(Observer):
    def __init__(self) -> None:
        self.kept: list[Datum] = []

    def kept_apart(self, datum: Datum) -> None:
        self.kept.append(datum)


@pytest.mark.parametrize("heard", [False, True])
def test_a_second_content_under_one_id_is_kept_at_the_base_and_told(heard: bool) -> None:
    observer = Apart()
    base = make_node(0, base=True, observer=observer)
    d, other = datum(), datum(payload=b"another")
    base.receive(data(7, 0, (5, d)), 0.0)
    if heard:
        base.receive(statement(d.id, base=3), 0.0)
    for _ in range(2):
        assert base.receive(data(8, 0, (6, other)), 0.0) == [Committed(0, 8, ((6, other.crc),), ())]
    stored = base.store.get(d.id)
    assert stored is not None
    assert stored.payload == d.payload
    assert base.store.unwritten
    base.store.commit()  # type: ignore[attr-defined]
    assert base.store.get_apart(other.id, other.crc) == other
    assert base.alarms.counts[Alarm.TWO_CONTENTS] >= 1
    assert observer.kept[0] == other


def test_second_contents_are_bounded_and_refused_beyond() -> None:
    base = make_node(0, base=True)
    base.receive(data(7, 0, (5, datum())), 0.0)
    answers = [base.receive(data(8, 0, (n + 1, datum(payload=b"%d" % n))), 0.0) for n in range(MAX_APART_OF_ONE + 2)]
    refused = [answer.refused for [answer] in answers if isinstance(answer, Committed)]
    assert refused[:MAX_APART_OF_ONE] == [()] * MAX_APART_OF_ONE
    assert refused[MAX_APART_OF_ONE:] == [(MAX_APART_OF_ONE + 1,), (MAX_APART_OF_ONE + 2,)]


def test_a_large_second_content_is_taken_too() -> None:
    base = make_node(0, base=True)
    d, other = datum(payload=b"a" * 300), datum(payload=b"b" * 300)
    for sender, content in ((7, d), (8, other)):
        base.receive(beacon(sender), 0.0)
        sending = Sending(content, 0, 5, 123)
        [accept] = base.receive(sending.offer(sender, 0.0), 0.0)
        assert isinstance(accept, Accept)
        assert sending.open(accept.handle, 0, 0.0)
        chunks = [sending.chunk(position, Flow(0.0), 0.0) for position in sending.due(fresh=True)]
        answers = [answer for chunk in chunks for answer in base.receive(chunk, 0.0)]
        assert Committed(0, sender, ((5, content.crc),), ()) in answers
    assert base.alarms.counts == {Alarm.TWO_CONTENTS: 1}


def test_a_base_counts_on_what_its_store_has_and_not_on_its_index() -> None:
    base, d = make_node(0, base=True), datum()
    base.receive(data(7, 0, (5, d)), 0.0)
    base.store.flip_bit(d.id)  # type: ignore[attr-defined]
    # The row is damaged: the copy that is offered takes its place.
    assert base.receive(data(8, 0, (6, d)), 0.0) == [Committed(0, 8, ((6, d.crc),), ())]
    stored = base.store.get(d.id)
    assert stored is not None
    assert stored.intact


def test_a_drone_that_accepted_a_datum_says_committed_for_no_other_content() -> None:
    node = with_base(make_node(1))
    d, other = datum(), datum(payload=b"another")
    node.receive(data(7, 1, (5, d)), 0.0)
    [sent] = of(Data, node.step(1.0))
    node.receive(Committed(0, 1, tuple((h.number, h.datum.crc) for h in sent.handovers), ()), 1.0)
    assert node.receive(data(7, 1, (5, d)), 1.0) == [Committed(1, 7, ((5, d.crc),), ())]
    assert list(node.holdings.custody) == []
    node.receive(data(7, 1, (5, other)), 1.0)
    assert list(node.holdings.custody) == [other.id]


def test_what_only_waits_for_its_receipt_makes_way_for_another_content() -> None:
    """The base never confirms one of the two, and it alone can keep both. The other one must not stay where it is."""
    node = with_base(make_node(1, mirror=True))
    d, other = datum(), datum(payload=b"another")
    node.receive(data(7, 1, (5, d)), 0.0)
    [sent] = of(Data, node.step(1.0))
    assert node.receive(data(8, 1, (6, other)), 1.0) == [Committed(1, 8, (), (6,))], "it is in custody"
    node.receive(Committed(0, 1, tuple((h.number, h.datum.crc) for h in sent.handovers), ()), 1.0)
    assert d.id in node.holdings.passed_on
    assert node.receive(data(8, 1, (7, other)), 1.0) == [Committed(1, 8, ((7, other.crc),), ())]
    stored = node.store.get(d.id)
    assert stored == other.arrived()
    assert list(node.holdings.custody) == [other.id]


# -- what an origin says of its own numbers ----------------------------------------------------------------------------


def test_an_origin_denies_what_it_has_not_given_and_once_in_six_turns_at_most() -> None:
    node = make_node(1, receipt_steps=1)
    id = node.put(b"x", 0.0)
    node.receive(statement(id), 0.0)
    assert Alarm.DENIED not in node.alarms.counts
    for serial in range(12):
        node.receive(statement(id._replace(sequence=7 + serial), serial=serial + 1), 0.0)
    assert node.alarms.counts[Alarm.DENIED] == 12
    assert id._replace(sequence=7) not in node.custody_store.arrived
    assert id in node.custody_store.arrived
    said = []
    for t in range(1, 13):
        node.receive(statement(id._replace(sequence=7), serial=1), float(t))
        said.append(of(SequenceMark, node.step(float(t))))
    assert [len(some) for some in said] == [1, 0, 0, 0, 0, 0] * 2
    assert said[0] == [make_sequence_mark(1, id.epoch, 1)]
    # It is of no use to repeat what was denied.
    assert id._replace(sequence=7) not in node.custody_store.arrived
    # What is said of an epoch that is over it cannot know.
    node.receive(statement(id._replace(epoch=5, sequence=7), serial=30), 0.0)
    assert id._replace(epoch=5, sequence=7) in node.custody_store.arrived


def test_a_base_that_has_what_its_origin_denies_tells_the_ground() -> None:
    base = make_node(0, base=True)
    base.receive(data(7, 0, (5, datum(sequence=3))), 0.0)
    base.receive(make_sequence_mark(9, 77, 4), 0.0)
    assert base.alarms.counts == {}
    base.receive(make_sequence_mark(9, 77, 3), 0.0)
    assert base.alarms.counts == {Alarm.DENIED: 1}
