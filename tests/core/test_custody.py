from __future__ import annotations

import random

import pytest

from rass_mav.core.custody.handovers import MAX_ACCEPTED, Custody

from .build import datum

X = datum().id
Y = datum(sequence=1).id


@pytest.fixture
def custody() -> Custody:
    return Custody(random.Random(1))


def test_an_answer_counts_only_with_number_and_neighbour(custody: Custody) -> None:
    number = custody.give(X, 2, 0.0).number
    assert custody.answered(number, 2) == X
    assert custody.answered(number, 3) is None
    assert custody.answered(number + 1, 2) is None


def test_a_cancelled_hand_over_has_no_answer(custody: Custody) -> None:
    number = custody.give(X, 2, 0.0).number
    custody.cancel(X)
    custody.cancel(X)
    assert custody.answered(number, 2) is None
    assert not custody.pending


def test_a_new_hand_over_of_the_same_datum_replaces_the_old_one(custody: Custody) -> None:
    old = custody.give(X, 2, 0.0).number
    new = custody.give(X, 3, 1.0).number
    assert old != new
    assert custody.answered(old, 2) is None
    assert custody.answered(new, 3) == X


def test_numbers_wrap_without_zero(custody: Custody) -> None:
    custody._next = 0xFFFFFFFE
    assert [custody.draw() for _ in range(3)] == [0xFFFFFFFF, 1, 2]


def test_a_later_life_starts_elsewhere() -> None:
    assert Custody(random.Random(1)).draw() != Custody(random.Random(2)).draw()


def test_the_memory_names_giver_number_and_datum(custody: Custody) -> None:
    custody.accept(7, 100, X)
    assert custody.has_accepted(7, 100, X)
    assert not custody.has_accepted(8, 100, X)
    assert not custody.has_accepted(7, 101, X)
    assert not custody.has_accepted(7, 100, Y)
    custody.forget(X)
    assert not custody.has_accepted(7, 100, X)


def test_the_memory_is_bounded_and_forgets_the_oldest(custody: Custody) -> None:
    for number in range(MAX_ACCEPTED + 1):
        custody.accept(7, number, X)
    assert not custody.has_accepted(7, 0, X)
    assert custody.has_accepted(7, 1, X)
    assert len(custody._accepted) == MAX_ACCEPTED
