from __future__ import annotations

import pytest

from rass_mav.core.custody.handovers import MAX_ACCEPTED, HandoverNumbers
from rass_mav.core.seals import ContentHashes

from .build import datum, make_node

X = datum().id
Y = datum(sequence=1).id


@pytest.fixture
def numbers() -> HandoverNumbers:
    return HandoverNumbers(4711, ContentHashes())


def test_numbers_wrap_without_zero() -> None:
    numbers = HandoverNumbers(0xFFFFFFFE, ContentHashes())
    assert [numbers.draw() for _ in range(3)] == [0xFFFFFFFF, 1, 2]


def test_a_later_life_starts_elsewhere() -> None:
    first, second = (make_node(1, seed=life).custody_store.numbers.draw() for life in (1, 2))
    assert first != second


def test_the_memory_names_custodian_number_and_datum(numbers: HandoverNumbers) -> None:
    numbers.accept(7, 100, X, 5)
    assert numbers.has_accepted(7, 100, X, 5)
    assert not numbers.has_accepted(8, 100, X, 5)
    assert not numbers.has_accepted(7, 101, X, 5)
    assert not numbers.has_accepted(7, 100, Y, 5)
    assert not numbers.has_accepted(7, 100, X, 6)
    numbers.forget(X)
    assert not numbers.has_accepted(7, 100, X, 5)


def test_the_memory_is_bounded_and_forgets_the_oldest(numbers: HandoverNumbers) -> None:
    for number in range(MAX_ACCEPTED + 1):
        numbers.accept(7, number, X, 5)
    assert not numbers.has_accepted(7, 0, X, 5)
    assert numbers.has_accepted(7, 1, X, 5)
    assert sum(numbers.has_accepted(7, number, X, 5) for number in range(MAX_ACCEPTED + 1)) == MAX_ACCEPTED


def test_what_was_accepted_under_a_number_is_known_by_its_checksum_too(numbers: HandoverNumbers) -> None:
    """An offer of a large datum names no more than that."""
    strong = 77 << 32 | 5
    numbers.accept(7, 100, X, strong)
    assert numbers.accepted(7, 100, X, 5) == strong
    assert not numbers.has_accepted(7, 100, X, 5), "another content"
    assert numbers.accepted(7, 100, X, 6) is None
    assert numbers.accepted(7, 100, Y, 5) is None
    assert numbers.accepted(8, 100, X, 5) is None
