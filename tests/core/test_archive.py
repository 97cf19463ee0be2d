from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.archive import RECEIPT_BITS, RECEIPT_ENTRIES, Archive, SequenceSet
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Receipt, ReceiptEntry


def ids(*sequences: int, origin: int = 1) -> list[DatumId]:
    return [DatumId(origin, 5, s) for s in sequences]


@given(st.lists(st.tuples(st.sampled_from(["add", "close"]), st.integers(0, 30))))
def test_a_sequence_set_is_a_set(operations: list[tuple[str, int]]) -> None:
    compact = SequenceSet()
    plain: set[int] = set()
    for operation, number in operations:
        if operation == "add":
            assert compact.add(number) == (number not in plain)
            plain.add(number)
        else:
            compact.close(number)
            plain |= set(range(number))
        assert {n for n in range(40) if n in compact} == plain
        assert compact.closed not in compact.beyond


def test_a_receipt_tells_what_has_arrived_and_the_holes() -> None:
    base = Archive(ids(0, 1, 2, 4, 7))
    receipt = base.receipt(0, 99)
    assert receipt == Receipt(0, 99, (ReceiptEntry(1, 5, 3, 0b1001),))
    drone = Archive()
    drone.learn(receipt)
    assert [s for s in range(10) if DatumId(1, 5, s) in drone] == [0, 1, 2, 4, 7]


def test_nothing_new_no_receipt() -> None:
    base = Archive(ids(0))
    assert base.receipt(0, 99) is not None
    assert base.receipt(0, 99) is None
    assert not base.add(ids(0)[0])


def test_origins_take_turns_in_receipts() -> None:
    base = Archive([DatumId(origin, 5, 0) for origin in range(RECEIPT_ENTRIES + 3)])
    first, second = base.receipt(0, 1), base.receipt(0, 1)
    assert first is not None
    assert second is not None
    assert [e.origin for e in first.entries + second.entries] == list(range(RECEIPT_ENTRIES + 3))


def test_what_lies_far_beyond_a_hole_is_not_claimed() -> None:
    base = Archive(ids(*range(1, 100)))
    receipt = base.receipt(0, 1)
    assert receipt is not None
    drone = Archive()
    drone.learn(receipt)
    assert DatumId(1, 5, 0) not in drone
    assert DatumId(1, 5, RECEIPT_BITS) in drone
    assert DatumId(1, 5, RECEIPT_BITS + 1) not in drone


@given(st.sets(st.integers(0, 60)), st.integers(0, 3))
def test_a_receipt_never_claims_what_has_not_arrived(arrived: set[int], origin: int) -> None:
    base = Archive(ids(*sorted(arrived), origin=origin))
    drone = Archive()
    receipt = base.receipt(0, 1)
    if receipt is not None:
        drone.learn(receipt)
    assert {s for s in range(80) if DatumId(origin, 5, s) in drone} <= arrived


def test_two_bases_receipts_add_up() -> None:
    drone = Archive()
    drone.learn(Receipt(0, 1, (ReceiptEntry(1, 5, 0, 1 << 4),)))
    assert DatumId(1, 5, 5) in drone
    drone.learn(Receipt(100, 2, (ReceiptEntry(1, 5, 5, 0),)))
    assert all(DatumId(1, 5, s) in drone for s in range(6))


def test_epochs_are_told_apart() -> None:
    archive = Archive(ids(0))
    assert DatumId(1, 6, 0) not in archive


@pytest.mark.parametrize("bound", [1, 3])
def test_what_is_remembered_of_receipts_is_bounded(bound: int) -> None:
    drone = Archive(max_origins=bound)
    for origin in range(10):
        for closed in range(0, 400, 2):
            drone.learn(Receipt(0, 1, (ReceiptEntry(origin, 5, 0, 0xFFFF), ReceiptEntry(origin, 5, 0, closed))))
    known = [origin for origin in range(10) if DatumId(origin, 5, 1) in drone]
    assert known == list(range(10 - bound, 10))
