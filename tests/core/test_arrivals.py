from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.news.arrivals import (
    LOST_BITS,
    NOTHING,
    WINDOW_BITS,
    Known,
    canonical,
    completed,
    has_arrived,
    is_told_lost,
    merged,
    one,
)

WINDOW = WINDOW_BITS + 1
FAR = 120

numbers = st.integers(0, 70)
#: What has arrived: single numbers and whole stretches.
arrivals = st.lists(st.tuples(numbers, st.integers(1, 30)), max_size=8).map(
    lambda runs: frozenset(n for start, length in runs for n in range(start, start + length))
)
truths = st.tuples(arrivals, st.frozensets(numbers, max_size=12))


def described(arrived: frozenset[int], lost: frozenset[int] = frozenset()) -> Known:
    """The definition: what a base that knows all says of these data."""
    top = max(arrived, default=-1) + 1
    window = max(0, top - WINDOW)
    floor = window
    while floor and floor - 1 in arrived:
        floor -= 1
    closed = next(n for n in itertools.count(window) if n not in arrived)
    bitmap = sum(1 << n - closed - 1 for n in arrived if n > closed)
    marks = sum(1 << n - closed for n in lost - arrived if 0 <= n - closed < LOST_BITS)
    return closed, bitmap, marks, floor


def claims(known: Known) -> set[int]:
    return {n for n in range(FAR) if has_arrived(known, n)}


def marks(known: Known) -> set[int]:
    return {n for n in range(FAR) if is_told_lost(known, n)}


def top(known: Known) -> int:
    return max(claims(known), default=-1) + 1


@given(truths)
def test_what_is_said_is_true_and_nothing_in_the_window_is_left_out(
    truth: tuple[frozenset[int], frozenset[int]],
) -> None:
    arrived, lost = truth
    known = described(arrived, lost)
    assert claims(known) <= arrived
    assert marks(known) <= lost - arrived
    recent = range(max(0, top(known) - WINDOW), FAR)
    assert claims(known) & set(recent) == arrived & set(recent)


@given(arrivals)
def test_without_holes_all_is_known_however_much(arrived: frozenset[int]) -> None:
    whole = frozenset(range(max(arrived, default=-1) + 1))
    assert claims(described(whole)) == whole


@given(truths, truths)
def test_merging_is_symmetric_true_and_never_for_the_worse(
    one_truth: tuple[frozenset[int], frozenset[int]], other_truth: tuple[frozenset[int], frozenset[int]]
) -> None:
    a, b = described(*one_truth), described(*other_truth)
    both = merged(a, b)
    assert both == merged(b, a)
    assert claims(both) <= claims(a) | claims(b)
    assert marks(both) <= (marks(a) | marks(b)) - claims(a) - claims(b)
    assert top(both) == max(top(a), top(b))
    recent = set(range(max(0, top(both) - WINDOW), FAR))
    assert claims(both) & recent == (claims(a) | claims(b)) & recent
    for known in (a, b):
        assert merged(both, known) == both
        if top(known) == top(both):
            assert claims(known) <= claims(both)
    # What it says has one description only.
    assert both == described(frozenset(claims(both)), frozenset(marks(both)))


@given(truths)
def test_knowledge_merged_with_itself_or_with_none_stays(truth: tuple[frozenset[int], frozenset[int]]) -> None:
    known = described(*truth)
    assert merged(known, known) == merged(known, NOTHING) == merged(NOTHING, known) == known


@given(truths)
def test_a_neighbours_own_words_mean_what_they_say(truth: tuple[frozenset[int], frozenset[int]]) -> None:
    known = described(*truth)
    assert canonical(*known) == known


@given(st.integers(0, 60), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.data())
def test_any_words_of_a_neighbour_are_brought_into_the_one_form(
    closed: int, bitmap: int, lost: int, d: st.DataObject
) -> None:
    said = (closed, bitmap, lost, d.draw(st.integers(0, closed)))
    known = canonical(*said)
    assert claims(known) <= claims(said)
    assert top(known) == top(said)
    assert canonical(*known) == known
    recent = set(range(max(0, top(said) - WINDOW), FAR))
    assert claims(known) & recent == claims(said) & recent


@given(st.permutations(range(40)), truths)
def test_a_base_that_adds_one_by_one_says_the_same_as_one_that_knew_all_at_once(
    order: list[int], truth: tuple[frozenset[int], frozenset[int]]
) -> None:
    arrived, lost = truth
    known = NOTHING
    have: set[int] = set()
    for n in [n for n in order if n in arrived] + sorted(arrived - set(order)):
        have.add(n)
        known = completed(merged(known, one(n)), have.__contains__, lost.__contains__)
    assert completed(known, have.__contains__, lost.__contains__) == described(arrived, lost)


@given(numbers)
def test_one_datum(sequence: int) -> None:
    assert claims(one(sequence)) == {sequence}
    assert one(sequence) == described(frozenset({sequence}))


def test_numbers_far_apart_cost_nothing() -> None:
    late = one(0xFFFFFFFF)
    early = described(frozenset(range(1000)))
    both = merged(early, late)
    assert both == late
    assert has_arrived(both, 0xFFFFFFFF)
    assert merged(early, (0xFFFFFFFF, 0, 0, 1010)) == (0xFFFFFFFF, 0, 0, 1010)
    # The hole ends where the other's knowledge goes on.
    reaching = (1000, 0b111111111, 0, 0)
    assert merged(reaching, (0xFFFFFFFF, 0, 0, 1010)) == (0xFFFFFFFF, 0, 0, 1001)


@given(st.lists(truths, min_size=2, max_size=4), st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=40))
def test_neighbours_that_merge_what_they_hear_agree_in_the_end(
    truth: list[tuple[frozenset[int], frozenset[int]]], meetings: list[tuple[int, int]]
) -> None:
    views = [described(*t) for t in truth]
    n = len(views)
    for i, j in meetings:
        views[i % n] = merged(views[i % n], views[j % n])
    for _ in range(200):
        before = list(views)
        for i, j in itertools.permutations(range(n), 2):
            views[i] = merged(views[i], views[j])
        if views == before:
            break
    else:
        raise AssertionError("they never come to an end")
    assert len(set(views)) == 1
