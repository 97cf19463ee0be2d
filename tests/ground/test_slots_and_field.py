"""A bounded history, and readings on a grid."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.ground import field as field_module
from rass_mav.ground.field import DEGREE_M, REACH, SIDE_M, Field, Grid
from rass_mav.ground.history import Slots

HERE = (47.37, 8.54)
TIMES = st.lists(st.floats(-1e9, 1e12), max_size=60, unique=True)
#: Metres north and east, and a reading.
MEASURED = st.lists(
    st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(0.01, 1e4)), min_size=1, max_size=30
)


def away(north_m: float, east_m: float) -> tuple[float, float]:
    return HERE[0] + north_m / DEGREE_M, HERE[1] + east_m / DEGREE_M / math.cos(math.radians(HERE[0]))


class TestSlots:
    @given(TIMES, st.randoms(use_true_random=False))
    def test_what_is_kept_does_not_depend_on_the_order(self, times: list[float], random: st.DataObject) -> None:
        one, other = Slots[float](8), Slots[float](8)
        for time in times:
            one.put(time, time)
        random.shuffle(times)  # type: ignore[attr-defined]
        for time in times:
            other.put(time, time)
        assert one.ordered == other.ordered
        assert len(one) <= 8
        if times:
            assert one.ordered[-1] == (max(times), max(times)), "the latest is always kept"

    @given(TIMES, st.floats(-1e9, 1e12))
    def test_at_a_time_it_has_the_latest_value_that_is_not_later(self, times: list[float], time: float) -> None:
        slots = Slots[float](1000, 1e-3)
        for each in times:
            slots.put(each, each)
        kept = [at for at, _ in slots if at <= time]
        assert slots.at(time) == ((max(kept), max(kept)) if kept else None)

    def test_an_older_value_of_a_span_is_not_kept(self) -> None:
        slots = Slots[str](4)
        assert slots.put(10.5, "late")
        assert not slots.put(10.25, "early")
        assert list(slots) == [(10.5, "late")]


class TestField:
    @given(MEASURED)
    def test_nothing_is_painted_where_nothing_was_measured(self, measured: list[tuple[float, float, float]]) -> None:
        field = Field(HERE)
        for north, east, reading in measured:
            field.add(away(north, east), reading)
        painted = field.painted()
        assert {(p.row, p.column) for p in painted if p.readings} == set(field.sums)
        assert sum(p.readings for p in painted) == len(measured)
        for p in painted:
            near = [
                total / count
                for (row, column), (total, count) in field.sums.items()
                if math.dist((row, column), (p.row, p.column)) <= REACH
            ]
            assert near
            assert min(near) * 0.999999 <= p.reading <= max(near) * 1.000001

    @given(MEASURED)
    def test_the_changes_are_together_what_is_painted(self, measured: list[tuple[float, float, float]]) -> None:
        field, seen = Field(HERE), {}
        for north, east, reading in measured:
            field.add(away(north, east), reading)
            seen.update({(p.row, p.column): p for p in field.changes()})
        assert seen == {(p.row, p.column): p for p in field.painted()}
        assert field.changes() == []

    def test_squares_grow_where_there_are_too_many(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(field_module, "MOST_SQUARES", 20)
        field = Field(HERE)
        for n in range(200):
            field.add(away(n * SIDE_M, -n * SIDE_M), float(n))
        assert len(field.sums) <= 20
        assert sum(count for _, count in field.sums.values()) == 200
        assert sum(total for total, _ in field.sums.values()) == sum(range(200))
        assert field.reach_m == REACH * field.grid.side_m > REACH * SIDE_M

    @given(st.floats(-89, 89), st.floats(-180, 180), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
    def test_a_place_is_in_its_square(self, latitude: float, longitude: float, north: float, east: float) -> None:
        """Across the 180th meridian too."""
        grid = Grid((latitude, longitude), SIDE_M)
        place = latitude + north, (longitude + east + 180) % 360 - 180
        south, west = grid.corner(*grid.square(place))
        height, width = grid.step
        assert south - 1e-9 <= place[0] <= south + height + 1e-9
        beyond = (place[1] - west + 180) % 360 - 180
        assert -1e-9 <= beyond <= width + 1e-9


def test_a_first_place_at_a_pole_makes_the_squares_of_others_four_times_as_wide_at_most() -> None:
    for latitude in (90.0, -90.0, 89.0, 60.0, 0.0):
        height, width = Field((latitude, 8.0)).grid.step
        assert 1.0 <= width / height <= 4.0
