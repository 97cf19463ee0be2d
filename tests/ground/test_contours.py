"""Iso-dose contours: whatever is measured, lines are where a level is crossed, and nowhere else."""

from __future__ import annotations

import json
import math
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rass_mav.ground import contours
from rass_mav.ground.contours import MOST_LEVELS, Contour, contours_of, features, levels_of, plain, trace
from rass_mav.ground.field import Field, Grid, Square
from tests.ground.page.flights import HOME, SOURCES, dose, place

GRID = Grid(HOME, 10.0)
LEVELS = (1.0, 25.0, 100.0)
#: What no sensor sends, and what decoders let through.
FORGED = (math.inf, -math.inf, math.nan, 3.4028234663852886e38, -3.4028234663852886e38, 1.7e308, -1.7e308, 5e-324, 0.0)
READINGS = st.one_of(st.floats(0.0, 200.0), st.sampled_from((1.0, 25.0, 100.0, *FORGED)))
SQUARES = st.dictionaries(st.tuples(st.integers(0, 6), st.integers(0, 6)), READINGS, max_size=49)


def at(spot: tuple[float, float]) -> tuple[float, float]:
    """A place as row and column, whole in the middle of a square."""
    height, width = GRID.step
    return (spot[0] - HOME[0]) / height - 0.5, (spot[1] - HOME[1]) / width - 0.5


def side_of(spot: tuple[float, float]) -> list[tuple[Square, Square]]:
    """The sides between two middles that a point of a line may be on."""
    row, column = at(spot)
    found = []
    if abs(row - round(row)) < 1e-6:
        found.append(((round(row), math.floor(column + 1e-6)), (round(row), math.floor(column + 1e-6) + 1)))
        found.append(((round(row), math.ceil(column - 1e-6) - 1), (round(row), math.ceil(column - 1e-6))))
    if abs(column - round(column)) < 1e-6:
        found.append(((math.floor(row + 1e-6), round(column)), (math.floor(row + 1e-6) + 1, round(column))))
        found.append(((math.ceil(row - 1e-6) - 1, round(column)), (math.ceil(row - 1e-6), round(column))))
    return found


def crossed(painted: dict[Square, float], spot: tuple[float, float], level: float) -> list[tuple[Square, Square]]:
    """Those of them with a reading below the level at one end, and none below at the other."""
    return [
        (one, other)
        for one, other in side_of(spot)
        if one in painted and other in painted and (painted[one] >= level) != (painted[other] >= level)
    ]


@given(SQUARES)
@example({(0, 0): 1.0, (0, 1): 200.0, (1, 0): 200.0, (1, 1): 0.5})
@example({(row, column): 100.0 * ((row + column) % 2) for row in range(7) for column in range(7)})
def test_lines_are_where_the_level_is_crossed_closed_or_ending_at_an_edge(painted: dict[Square, float]) -> None:
    sound = {square: reading for square, reading in painted.items() if math.isfinite(reading)}
    for level, line in trace(GRID, painted, LEVELS):
        assert len(line) > 1
        for spot in line:
            assert crossed(sound, spot, level), "the level is between the readings on both sides"
        if line[0] != line[-1]:
            for spot in (line[0], line[-1]):
                # At least one of the two cells beside this side is not painted whole.
                beside = [
                    [(r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)]
                    for one, other in crossed(sound, spot, level)
                    for r, c in ((one[0], one[1]), (one[0] - (one[0] == other[0]), one[1] - (one[1] == other[1])))
                ]
                assert any(not set(cell) <= sound.keys() for cell in beside), "nothing ends in the middle"


@given(SQUARES)
@example({(0, 0): 25.0, (0, 1): 1.0, (1, 0): 1.0, (1, 1): 3.4e38})
def test_the_higher_readings_are_to_the_left(painted: dict[Square, float]) -> None:
    for level, line in trace(GRID, painted, LEVELS):
        for before, after in pairwise(line):
            (r0, c0), (r1, c1) = at(before), at(after)
            # The corners of the cell that the line goes through.
            r, c = math.floor((r0 + r1) / 2), math.floor((c0 + c1) / 2)
            # On a middle with just this reading several sides are crossed: that tells nothing of each.
            between = [spot for spot in (before, after) if math.dist(at(spot), [round(x) for x in at(spot)]) > 1e-6]
            for row, column in ((r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)):
                if (row, column) not in painted or math.dist((r0, c0), (r1, c1)) < 1e-6:
                    continue
                left = (c1 - c0) * (row - r0) - (r1 - r0) * (column - c0)
                own = [pair for spot in between for pair in crossed(painted, spot, level) if (row, column) in pair]
                if own and abs(left) > 1e-6:
                    assert (left > 0) == (painted[row, column] >= level)


@given(st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60), READINGS.filter(math.isfinite)), max_size=40))
def test_of_what_a_field_paints_each_level_is_crossed_as_often_as_its_readings_say(
    measured: list[tuple[float, float, float]],
) -> None:
    """Where a square and its neighbour are on two sides of a level, in a cell that is painted whole, a line passes."""
    field = Field(HOME)
    for north, east, reading in measured:
        if abs(reading) < 1e300:
            field.add(place(north, east), reading)
    painted = {(p.row, p.column): p.reading for p in field.painted()}
    found = contours_of(field, LEVELS)
    for level in LEVELS:
        sides = set()
        for row, column in painted:
            cell = {(row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1)}
            if cell <= painted.keys():
                for one, other in (((0, 0), (0, 1)), ((0, 0), (1, 0)), ((1, 0), (1, 1)), ((0, 1), (1, 1))):
                    ends = (row + one[0], column + one[1]), (row + other[0], column + other[1])
                    if (painted[ends[0]] >= level) != (painted[ends[1]] >= level):
                        sides.add(ends)
        points = {spot for one in found if one.level == level for spot in one.line}
        # Where a middle has just this reading, sides share a point.
        assert len(points) <= len(sides)
        assert bool(points) <= bool(sides)
        exact = any(
            reading == level or abs(math.log(max(reading, 1e-300) / level)) < 1e-9 for reading in painted.values()
        )
        if not exact and all(abs(reading) < 1e6 for reading in painted.values()):
            assert len(points) == len(sides)


def test_around_a_source_there_is_a_ring_for_each_level_and_it_is_where_the_law_says() -> None:
    field = Field(HOME)
    for north in range(60, 460, 10):
        for east in range(-20, 380, 10):
            field.add(place(north + 5.0, east + 5.0), dose(north + 5.0, east + 5.0))
    found = contours_of(field, (5.0, 25.0, 100.0))
    assert Counter(one.level for one in found) == {5.0: 1, 25.0: 1, 100.0: 1}
    assert all(one.closed for one in found)
    for level, line in found:
        for spot in line:
            y, x = (spot[0] - HOME[0]) * 111_320.0, (spot[1] - HOME[1]) * 111_320.0 * math.cos(math.radians(HOME[0]))
            assert math.dist((y, x), SOURCES[0][:2]) < 110.0
            assert dose(y, x) == pytest.approx(level, rel=0.15)
    # Anticlockwise: the area is positive.
    for _, line in found:
        assert sum(a[1] * b[0] - b[1] * a[0] for a, b in pairwise(line)) > 0


@pytest.mark.no_cover
@given(st.integers(0, 2**32))
def test_a_field_of_noise_takes_bounded_work_and_memory(seed: int) -> None:
    noise = {(row, column): float((row * 7 + column * 13 + seed) % 3 * 60) for row in range(40) for column in range(40)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contours, "MOST_POINTS", 200)
        found = trace(GRID, noise, LEVELS)
    assert sum(len(one.line) for one in found) <= 200


def test_the_longest_lines_stay() -> None:
    painted = {(row, column): 0.0 for row in range(30) for column in range(30)}
    painted |= {(row, column): 10.0 for row in range(3, 20) for column in range(3, 20)}
    painted[25, 25] = 10.0
    assert [len(one.line) for one in trace(GRID, painted, (1.0,))] == [69, 5]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contours, "MOST_POINTS", 70)
        assert [len(one.line) for one in trace(GRID, painted, (1.0,))] == [69]


def test_nothing_is_drawn_without_levels_or_squares() -> None:
    assert trace(GRID, {(0, 0): 5.0, (0, 1): 0.5}, LEVELS) == [], "two squares are no field"
    assert trace(GRID, {}, LEVELS) == []
    assert trace(GRID, {(row, column): 5.0 for row in range(3) for column in range(3)}, ()) == []


@given(st.lists(st.one_of(st.floats(), st.floats(0.01, 1000)), max_size=30), st.one_of(st.none(), st.floats()))
def test_levels_are_few_sound_and_ascending(wanted: list[float], above: float | None) -> None:
    found = levels_of("cps", wanted, above)
    assert len(found) <= MOST_LEVELS
    assert list(found) == sorted(set(found))
    assert all(math.isfinite(level) and level > 0 for level in found)


def test_without_a_setting_only_dose_rates_have_levels_and_the_threshold_is_one() -> None:
    assert levels_of("usvh") == (1.0, 25.0, 100.0)
    assert levels_of("cpm") == ()
    assert levels_of("cpm", above=300.0) == (300.0,)
    assert levels_of("usvh", (5.0,), 10.0) == (5.0, 10.0)
    assert levels_of("usvh", ()) == ()


@given(SQUARES)
def test_they_are_json_and_geojson(painted: dict[Square, float]) -> None:
    found = trace(GRID, painted, LEVELS)
    for one in json.loads(json.dumps(plain(found), allow_nan=False)):
        assert one.keys() == {"level", "closed", "line"}
    for one, feature in zip(found, json.loads(json.dumps(features(found, "usvh"), allow_nan=False)), strict=True):
        assert feature["geometry"]["type"] == "LineString"
        longitude, latitude = feature["geometry"]["coordinates"][0]
        assert (latitude, longitude) == pytest.approx(one.line[0], abs=1e-6)
        assert feature["properties"] == {
            "what": "contour", "level": one.level, "unit": "usvh", "closed": one.closed,
        }  # fmt: skip
    assert not Contour(1.0, [HOME, HOME]).closed
