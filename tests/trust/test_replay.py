"""The replay window, beside a set that remembers everything."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.trust import replay
from rass_mav.trust.replay import LATE, ReplayWindow

SIZE = 8


@given(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 3), st.booleans()), max_size=200))
def test_each_mark_is_new_once_and_none_below_the_block_before(heard: list[tuple[int, int, bool]]) -> None:
    """The sender comes as far as some of the numbers; the others somebody else may have made up."""
    window, top, known = ReplayWindow(SIZE, 0), 0, set[tuple[int, int]]()
    for number, content, proven in heard:
        if proven:
            window.advance(number)
            top = max(top, number)
        oldest = (top // SIZE - LATE) * SIZE
        if number >= oldest + 2 * SIZE:
            continue
        assert window.is_new(number, hash((number, content))) is (number >= oldest and (number, content) not in known)
        known.add((number, content))


def test_it_is_set_back_only_on_purpose() -> None:
    window = ReplayWindow(SIZE, 100)
    assert window.is_new(100, 100)
    window.advance(3)
    assert not window.is_new(3, 3)
    window.set_back(3)
    assert window.is_new(3, 3)
    assert not window.is_new(100, 100), "it remembers what it has heard last"


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "MAX_MARKS", 10)
    window = ReplayWindow(SIZE, 0)
    for mark in range(100):
        assert window.is_new(0, mark)
        assert not window.is_new(0, mark)
        assert len(window) <= 20
