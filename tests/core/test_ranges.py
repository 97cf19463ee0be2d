from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import Receipt, ReceiptEntry
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.statements import (
    RECEIPT_BITS,
    blocks,
    covers,
    entry_of,
    last_of,
    make_receipt,
    ranges_of,
)
from rass_mav.core.news.table import Statement
from rass_mav.wire import MAX_TUNNEL, encode
from tests.some import some

#: Where numbers end, and where a block does.
LAST = (1 << 32) - 1
starts = st.sampled_from([0, 5, 100, LAST - 400])
numbers = st.tuples(starts, st.integers(0, 400)).map(sum)
pieces = st.lists(st.tuples(numbers, st.integers(1, 60)), max_size=12)


def made(pieces: list[tuple[int, int]]) -> tuple[Ranges, set[int]]:
    ranges, plain = Ranges(), set[int]()
    for first, length in pieces:
        end = min(first + length, LAST + 1)
        ranges.add(first, end)
        plain.update(range(first, end))
    return ranges, plain


def meant(entry: ReceiptEntry) -> set[int]:
    return {number for first, end in ranges_of(entry) for number in range(first, end)}


@given(pieces, numbers)
def test_ranges_are_a_set(pieces: list[tuple[int, int]], number: int) -> None:
    ranges, plain = made(pieces)
    assert (number in ranges) == (number in plain)
    assert {n for first, end in ranges for n in range(first, end)} == plain
    assert len(ranges) == len([n for n in plain if n - 1 not in plain])
    assert ranges.end == max(plain, default=-1) + 1
    assert all(end < first for (_, end), (first, _) in zip(list(ranges), list(ranges)[1:], strict=False))
    again, _ = made(list(reversed(pieces)))
    assert again == ranges


@given(pieces)
def test_the_entries_of_all_blocks_say_everything_and_nothing_else(pieces: list[tuple[int, int]]) -> None:
    ranges, plain = made(pieces)
    said: set[int] = set()
    for block in blocks(ranges):
        entry = some(entry_of(1, 2, ranges, block, lost=False))
        said |= meant(entry)
        assert last_of(entry) == max(meant(entry)) <= LAST
        [payload] = encode(make_receipt(0, 1, 2, [entry] * 3), 0.0)
        assert len(payload) <= MAX_TUNNEL
    assert said == plain


@given(pieces, st.integers(0, 1))
def test_the_entry_of_a_block_says_all_of_the_block(pieces: list[tuple[int, int]], which: int) -> None:
    ranges, plain = made(pieces)
    block = (100 // RECEIPT_BITS, LAST // RECEIPT_BITS)[which]
    entry = entry_of(1, 2, ranges, block, lost=False)
    here = plain & set(range(block * RECEIPT_BITS, (block + 1) * RECEIPT_BITS))
    assert here == set() if entry is None else here <= meant(entry) <= plain


def test_without_a_hole_one_entry_says_all_and_contains_the_older_ones() -> None:
    ranges, older = Ranges(), ReceiptEntry(1, 2, 0, 1, 0, False)
    for number in range(1000):
        ranges.add(number, number + 1)
        entry = entry_of(1, 2, ranges, number // RECEIPT_BITS, lost=False)
        assert entry == ReceiptEntry(1, 2, 0, number + 1, 0, False)
        assert covers(entry, older)
        older = entry


@given(pieces, pieces, st.integers(0, 5), st.integers(0, 5))
def test_an_entry_covers_another_if_it_means_as_much(
    one: list[tuple[int, int]], other: list[tuple[int, int]], i: int, j: int
) -> None:
    a, b = made(one)[0], made(one + other)[0]
    entries_a = [entry_of(1, 2, a, block, lost=False) for block in blocks(a)]
    entries_b = [entry_of(1, 2, b, block, lost=False) for block in blocks(b)]
    if i < len(entries_a) and j < len(entries_b):
        x, y = entries_a[i], entries_b[j]
        assert x is not None
        assert y is not None
        assert covers(x, y) == (meant(y) <= meant(x))
        assert covers(y, x) == (meant(x) <= meant(y))


def test_a_flipped_bit_anywhere_in_a_statement_is_found() -> None:
    receipt = make_receipt(1, 2, 3, [ReceiptEntry(4, 5, 6, 7, 8, False), ReceiptEntry(4, 5, 6, 7, 0, True)])
    kept = Statement(receipt)
    assert kept.sound
    for place, value in enumerate(receipt[:4]):
        assert isinstance(value, int)
        for bit in range(64):
            fields: list[Any] = [*receipt]
            fields[place] = value ^ 1 << bit
            kept.receipt = Receipt(*fields)
            assert not kept.sound
    entry = receipt.entries[0]
    for place, number in enumerate(entry):
        for bit in range(1 if place == 5 else 200):
            struck = ReceiptEntry._make([*entry[:place], number ^ 1 << bit, *entry[place + 1 :]])
            kept.receipt = receipt._replace(entries=(struck, receipt.entries[1]))
            assert not kept.sound
