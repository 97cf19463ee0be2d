"""Dose rates, Geiger counters, and what doses destroy, against numbers worked out by hand."""

from __future__ import annotations

import math
from random import Random
from statistics import mean, variance
from typing import Any

import pytest

from rass_mav.config.loading import convert
from rass_mav.core.datum import Fate
from rass_mav.lab.swarm.radiation import Counter, DoseField, Source, random_strong_sources
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.lab.swarm.world import World
from rass_mav.sensor.dose import TUBES, Tube

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


@pytest.mark.parametrize(("level", "interval_s"), [(0.1, 1.0), (4.0, 1.0), (4.0, 10.0), (90.0, 1.0), (5000.0, 1.0)])
def test_without_dead_time_counts_are_poisson(level: float, interval_s: float) -> None:
    drawn = counts(LIVE, level, interval_s)
    expected = level * interval_s
    assert mean(drawn) == pytest.approx(expected, abs=5 * math.sqrt(expected / 4000))
    assert variance(drawn) == pytest.approx(expected, rel=0.15)
    assert drawn.count(0) / 4000 == pytest.approx(math.exp(-expected), abs=0.025)


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
