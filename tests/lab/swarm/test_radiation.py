"""The radiation field, Eq. 1 and Eq. 2, dose rates, Geiger counters and what doses destroy, against numbers by hand."""

from __future__ import annotations

import math
from itertools import pairwise
from random import Random
from statistics import mean, variance
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.config.loading import convert
from rass_mav.core.datum import Fate
from rass_mav.errors import ConfigError
from rass_mav.lab.swarm.radiation import (
    Counter,
    DoseField,
    RadiationField,
    Source,
    random_sources,
    random_strong_sources,
)
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.lab.swarm.world import World
from rass_mav.sensor.dose import TUBES, Tube

metres = st.floats(-10, 10)
sources = st.lists(st.builds(Source, metres, metres, st.floats(0, 3)), max_size=5)
seeds = st.integers(0, 2**32)


def test_one_source_fades_with_the_square_of_the_distance() -> None:
    field = RadiationField([Source(1.0, 2.0, 0.8)])
    assert field.level(1.0, 2.0) == pytest.approx(0.8)
    assert field.level(2.0, 2.0) == pytest.approx(0.4)  # 0.8 / (1 + 1)
    assert field.level(1.0, 5.0) == pytest.approx(0.08)  # 0.8 / (1 + 9)
    assert field.level(4.0, 6.0) == pytest.approx(0.8 / 26)  # 3-4-5: d^2 = 25


def test_decay_scales_the_squared_distance() -> None:
    field = RadiationField([Source(0.0, 0.0, 1.0)], decay=0.25)
    assert field.level(2.0, 0.0) == pytest.approx(0.5)  # 1 / (1 + 0.25 * 4)
    assert RadiationField([Source(0.0, 0.0, 1.0)], decay=0.0).level(99.0, 0.0) == pytest.approx(1.0)


def test_eq_1_adds_the_sources_up_and_eq_2_multiplies_what_survives() -> None:
    field = RadiationField([Source(-1.0, 0.0, 0.6), Source(2.0, 0.0, 1.0), Source(0.0, 3.0, 0.5)])
    # At the origin: 0.6/2 = 0.3, 1/5 = 0.2, 0.5/10 = 0.05.
    assert field.level(0.0, 0.0) == pytest.approx(0.55)
    assert field.corruption(0.0, 0.0) == pytest.approx(1 - 0.7 * 0.8 * 0.95)  # 0.468


def test_a_source_stronger_than_one_corrupts_for_certain_but_is_not_clipped_in_the_level() -> None:
    field = RadiationField([Source(0.0, 0.0, 3.0), Source(0.0, 1.0, 1.0)])
    assert field.level(0.0, 0.0) == pytest.approx(3.5)
    assert field.corruption(0.0, 0.0) == 1.0


def test_without_sources_nothing_happens() -> None:
    field = RadiationField([])
    assert field.level(0.0, 0.0) == 0
    assert field.corruption(0.0, 0.0) == 0
    assert not field.moves
    assert not field.step()


@given(sources, metres, metres)
def test_corruption_is_a_probability_and_never_more_than_the_level(where: list[Source], x: float, y: float) -> None:
    field = RadiationField(where)
    assert 0 <= field.corruption(x, y) <= min(1.0, field.level(x, y)) + 1e-12


@given(seeds)
def test_random_sources_are_those_of_the_paper(seed: int) -> None:
    drawn = random_sources(Random(seed))
    assert len(drawn) == 3
    assert all(abs(s.x) <= 3.5 and abs(s.y) <= 3.5 and 0 <= s.intensity <= 1 for s in drawn)
    assert drawn == random_sources(Random(seed))
    assert len(set(drawn)) == 3


def test_random_sources_spread_and_number_are_settings() -> None:
    drawn = random_sources(Random(1), n=500, spread_m=8.0)
    assert len(drawn) == 500
    assert max(s.x for s in drawn) > 7.5
    assert min(s.y for s in drawn) < -7.5
    assert sum(s.intensity for s in drawn) / 500 == pytest.approx(0.5, abs=0.05)


@given(seeds, st.floats(0.01, 2.0))
def test_drifting_sources_move_by_the_drift_and_are_replicated_at_the_walls(seed: int, drift: float) -> None:
    rng = Random(seed)
    field = RadiationField(random_sources(rng), drift=drift, rng=rng, bounds=4.0)
    assert field.moves
    for _ in range(30):
        before = field.sources
        assert field.step()
        for old, new in zip(before, field.sources, strict=True):
            assert max(abs(new.x), abs(new.y)) <= 4.0
            assert new.intensity == old.intensity
            moved = math.dist(old[:2], new[:2])
            assert moved <= drift * (1 + 1e-9)
            if max(abs(old.x), abs(old.y)) + drift <= 4.0:
                assert moved == pytest.approx(drift)


def test_a_source_beyond_the_walls_drifts_in_and_stays() -> None:
    field = RadiationField([Source(5.0, -0.5, 1.0)], drift=0.1, rng=Random(1), bounds=2.0)
    xs = [field.sources[0].x]
    for _ in range(200):
        field.step()
        xs.append(field.sources[0].x)
        assert abs(field.sources[0].y) <= 2.0
    inside = next(i for i, x in enumerate(xs) if x <= 2.0)
    assert all(later < earlier for earlier, later in pairwise(xs[: inside + 1]))
    assert max(xs[inside:]) <= 2.0


def test_each_step_has_a_new_heading() -> None:
    field = RadiationField([Source(0.0, 0.0, 1.0)], drift=0.1, rng=Random(1), bounds=1000.0)
    for _ in range(400):
        field.step()
    # A random walk is about 0.1 sqrt(400) = 2 m away; a straight line would be at 40 m.
    assert math.hypot(field.sources[0].x, field.sources[0].y) < 8.0


def test_the_level_follows_the_sources() -> None:
    field = RadiationField([Source(0.0, 0.0, 1.0)], drift=1.0, rng=Random(1))
    field.step()
    assert field.level(0.0, 0.0) == pytest.approx(0.5)


def test_a_field_without_drift_stays() -> None:
    field = RadiationField([Source(20.0, 0.0, 1.0)])
    assert not field.moves
    assert not field.step()
    assert field.sources == [Source(20.0, 0.0, 1.0)]


@pytest.mark.parametrize(
    ("where", "options", "message"),
    [
        ([], {"decay": -1.0}, r"^radiation.decay: expected a number >= 0, got -1.0"),
        ([], {"decay": math.nan}, r"^radiation.decay: "),
        ([], {"drift": -0.1}, r"^radiation.drift: expected 0..20 m a step"),
        ([], {"drift": 20.5, "rng": Random(1)}, r"^radiation.drift: "),
        ([], {"drift": math.nan}, r"^radiation.drift: "),
        ([Source(0.0, 0.0, -0.5)], {}, r"^radiation.sources\[0\]: expected x, y and an intensity >= 0"),
        ([Source(0.0, 0.0, 1.0), Source(math.inf, 0.0, 1.0)], {}, r"^radiation.sources\[1\]: "),
    ],
)
def test_numbers_that_make_no_field_are_reported(where: list[Source], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RadiationField(where, **options)


def test_drift_without_a_generator_is_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="random generator"):
        RadiationField([Source(0.0, 0.0, 1.0)], drift=0.1)


#: 60 counts a minute in 1 uSv/h, so a count a second.
LIVE = Tube(60.0, 0.0)


def field(*sources: Source, **keys: Any) -> DoseField:
    numbers: dict[str, Any] = {"background": 0.1, "height_m": 10.0, "page_dose": 100.0, "step_s": 1.0, **keys}
    return DoseField(sources, **numbers)


def test_the_dose_rate_falls_with_the_square_of_the_distance() -> None:
    dose = field(Source(0.0, 0.0, 1e6))
    assert dose.level(0.0, 0.0) == pytest.approx(1e6 / 100 + 0.1)
    assert dose.level(30.0, 40.0) == pytest.approx(1e6 / 2600 + 0.1)
    far, twice = dose.level(1000.0, 0.0) - 0.1, dose.level(2000.0, 0.0) - 0.1
    assert far / twice == pytest.approx(4, rel=1e-3)
    assert field().level(5.0, 5.0) == 0.1


def test_sources_add_up() -> None:
    one, two = Source(0.0, 0.0, 1e6), Source(50.0, 0.0, 2e5)
    both = field(one, two, background=0.0).level(10.0, 0.0)
    assert both == pytest.approx(1e6 / 200 + 2e5 / 1700)


def test_a_page_is_lost_with_a_probability_that_the_dose_decides() -> None:
    # 3,600 uSv/h: 1 uSv a second.
    dose = field(Source(0.0, 0.0, 3600 * 100), background=0.0, step_s=5.0)
    assert dose.corruption(0.0, 0.0) == pytest.approx(1 - math.exp(-5 / 100))
    assert field(Source(0.0, 0.0, 1e15)).corruption(0.0, 0.0) == 1.0
    assert 0 < field().corruption(0.0, 0.0) < 1e-6


def test_random_sources_are_spread_over_the_powers_of_ten() -> None:
    drawn = random_strong_sources(Random(1), 3000, 200.0, (1e4, 1e7))
    assert all(abs(s.x) <= 200 and abs(s.y) <= 200 and 1e4 <= s.intensity <= 1e7 for s in drawn)
    for power in (4, 5, 6):
        assert sum(10**power <= s.intensity < 10 ** (power + 1) for s in drawn) == pytest.approx(1000, abs=100)


def counts(tube: Tube, level: float, interval_s: float = 1.0, draws: int = 4000) -> list[int]:
    counter, rng = Counter(tube, interval_s), Random(7)
    return [counter.counts(level, rng) for _ in range(draws)]


@pytest.mark.no_cover
@pytest.mark.parametrize(("level", "interval_s"), [(0.1, 1.0), (4.0, 1.0), (4.0, 10.0), (90.0, 1.0), (5000.0, 1.0)])
def test_without_dead_time_counts_are_poisson(level: float, interval_s: float) -> None:
    drawn = counts(LIVE, level, interval_s)
    expected = level * interval_s
    assert mean(drawn) == pytest.approx(expected, abs=5 * math.sqrt(expected / 4000))
    assert variance(drawn) == pytest.approx(expected, rel=0.15)
    assert drawn.count(0) / 4000 == pytest.approx(math.exp(-expected), abs=0.025)


@pytest.mark.no_cover
@pytest.mark.parametrize("rate", [20.0, 95.0, 150.0, 3000.0])
def test_dead_time_takes_counts_and_noise(rate: float) -> None:
    dead_s = 0.002
    drawn = counts(Tube(60.0, dead_s * 1e6), rate)
    live = 1 / (1 + rate * dead_s)
    assert mean(drawn) == pytest.approx(rate * live, rel=0.02)
    assert variance(drawn) == pytest.approx(rate * live**3, rel=0.15)


def test_a_tube_saturates_at_one_count_for_each_dead_time() -> None:
    counter, rng = Counter(TUBES["sbm-20"], 1.0), Random(1)
    most = 1e6 / 190
    assert counter.counts(1e9, rng) == pytest.approx(most, rel=0.001)
    # The correction for dead time ends at a factor of 100: whatever is above reads the same.
    assert counter.reading(1e9, rng) == pytest.approx(100 * most * 60 / 106, rel=0.001)
    assert counter.reading(1e12, rng) == counter.reading(1e11, rng)


@pytest.mark.parametrize("level", [10.0, 1000.0, 20_000.0])
def test_readings_are_right_on_average(level: float) -> None:
    counter, rng = Counter(TUBES["sbm-20"], 1.0), Random(3)
    assert mean(counter.reading(level, rng) for _ in range(2000)) == pytest.approx(level, rel=0.02)


def test_where_nothing_radiates_nothing_is_counted() -> None:
    assert Counter(LIVE, 1.0).reading(0.0, Random(1)) == 0.0


def scenario(**keys: Any) -> Scenario:
    plain = {
        "nodes": 9, "topology": "survey", "mobility": {"area_m": [300, 300]}, "radio": {"range_m": 300},
        "node": {"step_s": 1.0}, "risk": {"scale": "logarithmic", "background": 0.1, "low": 10, "high": 1e5},
    }  # fmt: skip
    return convert(plain | keys, Scenario, "test")


def test_a_drone_reads_the_dose_rate_where_it_is() -> None:
    surroundings = Surroundings(scenario(radiation={"law": "dose", "sources": [[0, 0, 1e8]], "height_m": 20}))
    rng = Random(1)
    for node, (x, y) in enumerate(surroundings.positions):
        assert surroundings.levels[node] == pytest.approx(1e8 / (x * x + y * y + 400) + 0.1)
        readings = [surroundings.reading(node, rng) for _ in range(200)]
        assert mean(readings) == pytest.approx(surroundings.levels[node], rel=0.05)
        assert len(set(readings)) > 1


def test_large_data_are_struck_more_often() -> None:
    world = World(
        scenario(radiation={"law": "dose", "sources": [], "corruption": False}, data={"interval_steps": 0}, nodes=2)
    )
    node = world.agents[1].node
    small = {node.put(bytes(4096), 0.0) for _ in range(25)}
    large = {node.put(bytes(16 * 4096), 0.0) for _ in range(25)}
    hits = {True: 0, False: 0}
    rng = Random(1)
    for _ in range(40):
        before = {id: world.stores[1].get(id) for id in small | large}
        world.strike(1, 0.02, rng, page_bytes=4096)
        for id, datum in before.items():
            hits[id in large] += world.stores[1].get(id) != datum
    assert hits[False] / 1000 == pytest.approx(0.02, abs=0.015)
    assert hits[True] / 1000 == pytest.approx(1 - 0.98**16, abs=0.05)


def test_a_drone_over_a_hot_spot_dies_and_one_far_away_does_not() -> None:
    world = World(
        scenario(
            steps=60, nodes=3, topology="positions",
            mobility={"positions": [[0, 0], [0, 100], [0, -1000]]},
            radiation={"law": "dose", "sources": [[0, 100, 1e9]], "page_dose": 1e12},
            failures={"die_dose": 1e3},
        )
    )  # fmt: skip
    world.run(60)
    assert world.off == {1: None}
    summary = world.statistics.summary()
    assert summary["failures"]["died"] == 1
    assert summary["lost"][Fate.CORRUPTED.value] == 0
