"""Sources from readings: found where they are, with a region that covers them, or it is said that nothing fits."""

from __future__ import annotations

import math
import random
from itertools import pairwise, product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.ground.sources.readings import Sample
from tests.extent import examples, seeds

pytest.importorskip("numpy", reason="numpy is not installed (extra ground)")

import numpy as np

from rass_mav.ground.sources.counts import one_count
from rass_mav.ground.sources.estimate import MOST_AREA_M2, Estimate, estimate
from rass_mav.ground.sources.outline import outlines
from rass_mav.ground.sources.texts import lines

from .flown import BACKGROUND, HERE, SENSITIVITY, Source, earth, flown, inside, metres

ONE: Source = (-40.0, 30.0, 3000.0)
OTHER: Source = (60.0, -55.0, 8000.0)


def covered(found: Estimate, source: Source, middle: tuple[float, float] = HERE) -> bool:
    place = earth(*source[:2], middle)
    return any(inside(ring, place) for one in found.sources if one.resolved for ring in one.region)


def off(found: Estimate, source: Source) -> float:
    """How far the nearest resolved source is from the true one, metres."""
    places = [metres(one.place) for one in found.sources if one.resolved]
    return min((math.dist(place, source[:2]) for place in places), default=math.inf)


@pytest.mark.parametrize("seed", seeds(2, 40))
def test_one_source_is_found(seed: int) -> None:
    found = estimate("usvh", flown([ONE], seed=seed))
    assert (found.verdict, len(found.sources)) == ("sources", 1)
    (source,) = found.sources
    assert source.resolved
    assert not source.may_move
    assert off(found, ONE) < 12.0
    assert covered(found, ONE)
    assert source.area_m2 is not None
    assert source.area_m2 < MOST_AREA_M2 / 5
    assert source.strength_range is not None
    assert source.strength_range[0] < ONE[2] < source.strength_range[1]
    assert found.background == pytest.approx(BACKGROUND, rel=0.5)
    assert found.height_m == pytest.approx(10.0, rel=0.5)
    assert len(source.drones) >= 2


def test_a_strength_that_may_be_anything_has_no_range() -> None:
    """Readings of a ring that the source is on, as exact as no counter is."""
    samples = []
    for drone, second in product(range(2, 6), range(40)):
        angle = second / 36 * 2 * math.pi
        x, y = 30 * math.cos(angle), 30 * math.sin(angle)
        rate = 10_000.0 / ((x - 30.0) ** 2 + y**2 + 7.0**2)
        samples.append(Sample(drone, float(second), *earth(x, y), 507.0, round(rate, 5), 1.0))
    (source,) = estimate("usvh", samples).sources
    assert source.strength_range is None
    assert any("at 1 m or any other" in line for line in lines(estimate("usvh", samples).plain()))


def test_two_sources_are_two_and_the_stronger_one_is_first() -> None:
    found = estimate("usvh", flown([ONE, OTHER]))
    assert len(found.sources) == 2
    assert covered(found, ONE)
    assert covered(found, OTHER)
    assert found.sources[0].strength > found.sources[1].strength


def test_strong_sources_that_look_like_one_are_told_apart() -> None:
    both: list[Source] = [(-30.0, 0.0, 1e6), (20.0, 20.0, 2e6)]
    found = estimate("usvh", flown(both))
    assert len(found.sources) == 2
    assert all(covered(found, source) for source in both)


@pytest.mark.parametrize("seed", seeds(1, 40))
def test_background_alone_is_no_source(seed: int) -> None:
    found = estimate("usvh", flown([], seed=seed))
    assert (found.verdict, found.sources) == ("no source", [])
    assert found.background == pytest.approx(BACKGROUND, rel=0.3)


@pytest.mark.no_cover
@settings(max_examples=examples(3))
@given(turned=st.floats(0.0, 6.28), x=st.floats(-2000.0, 2000.0), y=st.floats(-2000.0, 2000.0))
def test_turned_and_moved_readings_give_the_turned_and_moved_sources(turned: float, x: float, y: float) -> None:
    plain = estimate("usvh", flown([ONE]))
    other = estimate("usvh", flown([ONE], turned=turned, moved=(x, y)))
    assert (plain.verdict, len(plain.sources)) == (other.verdict, len(other.sources)) == ("sources", 1)
    east, north = metres(plain.sources[0].place)
    there = (
        east * math.cos(turned) - north * math.sin(turned) + x, east * math.sin(turned) + north * math.cos(turned) + y
    )  # fmt: skip
    assert math.dist(metres(other.sources[0].place), there) < 2.5
    assert other.sources[0].area_m2 == pytest.approx(plain.sources[0].area_m2, rel=0.3)


def test_it_works_across_the_180th_meridian() -> None:
    middle = (-17.0, 180.0)
    found = estimate("usvh", flown([ONE], middle=middle))
    assert covered(found, ONE, middle)


@pytest.mark.parametrize("seed", seeds(1, 40))
def test_a_source_that_moves_does_not_get_a_small_false_region(seed: int) -> None:
    def at(second: float) -> list[Source]:
        return [(-80.0 + 1.2 * second, 20.0, 3000.0)]

    found = estimate("usvh", flown([], at=at, seed=seed))
    assert found.verdict == "no fit"
    assert found.sources == []
    assert found.why


@pytest.mark.parametrize("seed", [2, 4, 6, 8, 13, 47])
def test_a_weak_source_that_is_carried_about_is_in_its_region(seed: int) -> None:
    # Too few counts to show that it moves: then the region says where it may be by now.
    rng = random.Random(seed)
    x, y = rng.uniform(-70.0, 70.0), rng.uniform(-50.0, 50.0)
    way: list[Source] = []
    for _ in range(120):
        course = rng.uniform(0.0, 2 * math.pi)
        x, y = x + 3.0 * math.cos(course), y + 3.0 * math.sin(course)
        way.append((x, y, 400.0))
    found = estimate("usvh", flown([], at=lambda second: [way[int(second)]], seed=seed))
    assert covered(found, way[-1]) or not any(source.resolved for source in found.sources)
    assert all(source.may_move for source in found.sources)
    said = [line for line in lines(found.plain()) if "with 95 % within" in line]
    assert all("m², if it rests or moves, as a circle" in line for line in said)


def test_a_line_does_not_get_a_small_false_region() -> None:
    line: list[Source] = [(-70.0 + 10.0 * k, -30.0 + 4.0 * k, 800.0) for k in range(15)]
    found = estimate("usvh", flown(line))
    assert found.verdict == "no fit" or any(covered(found, point) for point in line)
    for source in found.sources:
        assert not source.resolved or any(inside(ring, earth(*p[:2])) for ring in source.region for p in line)


# -- forged and broken -------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("value", [50.0, 1e5, 3e38])
def test_a_forged_reading_makes_no_source(value: float) -> None:
    samples = flown([ONE])
    n = next(n for n, sample in enumerate(samples) if math.dist(metres(sample[2:4]), (60.0, 60.0)) < 15.0)
    samples[n] = samples[n]._replace(value=value)
    found = estimate("usvh", samples)
    assert all(math.dist(metres(one.place), metres(samples[n][2:4])) > 30.0 for one in found.sources if one.resolved)
    assert found.verdict == "no fit" or covered(found, ONE)


@pytest.mark.no_cover
def test_a_sensor_that_always_says_the_same_is_named() -> None:
    broken = [sample._replace(value=500.0) if sample.drone == 3 else sample for sample in flown([ONE])]
    found = estimate("usvh", broken)
    assert (found.verdict, found.doubtful) == ("no fit", [3])
    assert "without drone 3 they fit" in found.why


def test_what_one_drone_alone_shows_is_not_resolved() -> None:
    """It invents a weak source in the middle of its own part of the area, as far from the others as possible."""

    def invented(sample: Sample) -> Sample:
        x, y = metres(sample[2:4])
        more = round(800.0 / ((x - 100.0) ** 2 + (y - 80.0) ** 2 + 100.0) * SENSITIVITY) / SENSITIVITY
        return sample._replace(value=sample.value + more) if sample.drone == 5 else sample

    found = estimate("usvh", [invented(sample) for sample in flown([])])
    assert len(found.sources) == 1
    (source,) = found.sources
    assert not source.resolved
    assert (source.region, source.area_m2) == ([], None)
    assert source.why == "only drone 5 shows it: fly another one there"


def test_a_forged_place_far_away_changes_nothing() -> None:
    samples = flown([ONE])
    forged = samples[0]._replace(latitude=-47.0, longitude=100.0, value=1e6)
    assert covered(estimate("usvh", [*samples, forged]), ONE)


# -- little ------------------------------------------------------------------------------------------------------------


def test_nothing_and_one_reading_are_too_few() -> None:
    for few in ([], flown([ONE])[:1], flown([ONE])[:29]):
        found = estimate("usvh", few)
        assert (found.verdict, found.sources, found.readings) == ("too few readings", [], len(few))
        assert f"{len(few)} readings" in found.why


def test_readings_from_one_place_tell_nothing() -> None:
    samples = [sample._replace(latitude=HERE[0], longitude=HERE[1]) for sample in flown([ONE])]
    found = estimate("usvh", samples)
    assert found.verdict == "too few readings"
    assert "from one place" in found.why


def test_a_counter_that_counts_nothing_is_no_source() -> None:
    assert estimate("usvh", [sample._replace(value=0.0) for sample in flown([ONE])]).verdict == "no source"


# -- parts -------------------------------------------------------------------------------------------------------------


def numbers(mean: float, count: int, seed: int = 1) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.random.default_rng(seed).poisson(mean, count)


def test_one_count_is_the_step_of_the_readings() -> None:
    time = np.arange(400.0)
    value = numbers(3.0, 400) * 0.25
    assert one_count(value, np.repeat([2, 3], 200), time) == pytest.approx(0.25)


def test_one_count_of_readings_without_steps_follows_from_their_scatter() -> None:
    noise = np.random.default_rng(2).uniform(0.0, 0.01, 400)
    value = numbers(20.0, 400) * 0.25 + noise
    assert one_count(value, np.repeat([2, 3], 200), np.arange(400.0)) == pytest.approx(0.25, rel=0.3)


def test_smoothed_readings_tell_less_than_their_steps_promise() -> None:
    counts = numbers(3.0, 460)
    value = np.convolve(counts, np.ones(60), "valid") / 60.0
    assert one_count(value, np.repeat([2], len(value)), np.arange(len(value), dtype=float)) > 10.0 / 60.0


def test_an_outline_has_the_area_of_its_squares_and_no_holes() -> None:
    inside = np.array([[1, 1, 1, 0, 0], [1, 0, 1, 0, 1], [1, 1, 1, 0, 1]], dtype=bool)
    rings = outlines(inside)
    assert all(ring[0] == ring[-1] for ring in rings)
    areas = [sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in pairwise(ring)) / 2 for ring in rings]
    assert sorted(areas) == [2.0, 9.0]
    assert [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)] in rings
    assert outlines(np.zeros((3, 3), dtype=bool)) == []
