from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.risk import RiskEstimator


def test_before_any_reading_the_risk_is_the_worst_case() -> None:
    assert RiskEstimator().risk(0.0) == 1.0
    assert RiskEstimator(worst=0.7).risk(0.0) == 0.7


def test_a_stale_reading_counts_as_the_worst_case_and_not_as_zero() -> None:
    risk = RiskEstimator(stale_s=10.0)
    risk.observe(0.2, now=100.0)
    assert risk.risk(110.0) == 0.2
    assert risk.known(110.0)
    assert risk.risk(110.01) == 1.0
    assert not risk.known(110.01)


def test_average_first_clip_last() -> None:
    risk = RiskEstimator(gain=0.5)
    risk.observe(-1.0, 0.0)
    assert risk.risk(0.0) == 0.0
    risk.observe(2.0, 1.0)
    # (-1 + 2) / 2; clipped readings would have given (0 + 1) / 2 only by chance of these two, so add a third.
    assert risk.risk(1.0) == 0.5
    risk.observe(2.5, 2.0)
    assert risk.risk(2.0) == 1.0
    risk.observe(-1.0, 3.0)
    assert risk.risk(3.0) == pytest.approx(0.25)


def test_after_a_gap_the_average_starts_afresh() -> None:
    risk = RiskEstimator(gain=0.1, stale_s=5.0)
    risk.observe(0.9, 0.0)
    risk.observe(0.1, 6.0)
    assert risk.risk(6.0) == 0.1


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_with_gain_one_only_the_last_reading_counts(readings: list[float]) -> None:
    risk = RiskEstimator(gain=1.0)
    for reading in readings:
        risk.observe(reading, 0.0)
    assert risk.risk(0.0) == min(max(readings[-1], 0.0), 1.0)


@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_no_reading(broken: float) -> None:
    risk = RiskEstimator(stale_s=10.0)
    risk.observe(broken, 0.0)
    assert risk.risk(0.0) == 1.0
    risk.observe(0.3, 1.0)
    risk.observe(broken, 9.0)
    assert risk.risk(9.0) == 0.3
    assert risk.risk(11.5) == 1.0


@given(st.lists(st.floats(), max_size=10), st.floats(0.01, 1.0))
def test_risk_stays_in_its_range_whatever_the_sensor_says(readings: list[float], gain: float) -> None:
    risk = RiskEstimator(gain=gain)
    for reading in readings:
        risk.observe(reading, 0.0)
        assert 0.0 <= risk.risk(0.0) <= 1.0


@pytest.mark.parametrize("wrong", [{"gain": 0.0}, {"gain": 1.1}, {"worst": -0.1}, {"worst": 1.1}, {"stale_s": 0.0}])
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="gain must be"):
        RiskEstimator(**wrong)
