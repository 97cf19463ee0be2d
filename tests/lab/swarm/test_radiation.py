"""The radiation field: Eq. 1 and Eq. 2 against numbers worked out by hand."""

from __future__ import annotations

import math
from itertools import pairwise
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ConfigError
from rass_mav.lab.swarm.radiation import RadiationField, Source, random_sources

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
