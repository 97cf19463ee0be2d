"""Floods: what is let through is bounded, and what cannot be right is told from what can."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.floods import Allowance, Flood

times = st.lists(st.floats(0.0, 100.0), max_size=60).map(sorted)


@given(times, st.integers(1, 10), st.floats(0.1, 20.0))
def test_never_more_than_allowed_get_through_and_all_do_that_are_few(
    at: list[float], count: int, seconds: float
) -> None:
    allowance = Allowance(count, seconds)
    taken = [now for now in at if allowance.take(now)]
    assert all(late - early >= seconds for early, late in zip(taken, taken[count:], strict=False))
    if all(late - early >= seconds for early, late in zip(at, at[count:], strict=False)):
        assert taken == at


@given(times, st.integers(1, 10), st.floats(0.1, 20.0))
def test_a_flood_is_on_while_too_many_come_and_begins_once(at: list[float], count: int, seconds: float) -> None:
    flood = Flood(count, seconds)
    before = False
    for index, now in enumerate(at):
        begins = flood.hear(now)
        assert flood.active == (index >= count and now - at[index - count] < seconds)
        assert begins == (flood.active and not before)
        before = flood.active
