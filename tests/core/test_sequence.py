from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.routes.announcements import following, newer

numbers = st.integers(0, 0xFFFF)


@given(numbers, st.integers(1, 0x7FFF))
def test_up_to_half_the_circle_ahead_is_newer_across_the_wrap(a: int, ahead: int) -> None:
    b = (a + ahead) & 0xFFFF
    assert newer(b, a)
    assert not newer(a, b)


@given(numbers)
def test_equal_and_opposite_numbers_are_not_newer_either_way(a: int) -> None:
    opposite = (a + 0x8000) & 0xFFFF
    assert not newer(a, a)
    assert not newer(a, opposite)
    assert not newer(opposite, a)


@given(numbers)
def test_the_following_number_is_newer(a: int) -> None:
    assert newer(following(a), a)
    assert 0 <= following(a) <= 0xFFFF
