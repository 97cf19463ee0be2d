"""From counts to dose rates."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.sensor.dose import MAX_DEAD, STATED, TUBES, DoseMeter, Tube, converted
from rass_mav.sensor.kinds import KINDS

RATES = st.floats(0.0, 1e9)
DEAD_TIMES = st.floats(0.0, 1e4)


def test_the_tube_that_each_sensor_has_is_known() -> None:
    assert {kind.tube for kind in KINDS.values() if "tube" in kind.keys} <= TUBES.keys()


def test_a_count_becomes_a_dose_rate() -> None:
    meter = DoseMeter(TUBES["sbm-20"]._replace(dead_time_us=0.0))
    assert meter.reading(106.0) == 1.0
    assert meter.reading(0.0) == 0.0
    assert DoseMeter(Tube(106.0, 0.0), "cpm").reading(106.0) == 106.0
    assert DoseMeter(Tube(106.0, 0.0), "cps").reading(120.0) == 2.0


def test_dead_time_by_the_textbook() -> None:
    # 1000 counts a second with 100 us each: dead for a tenth of the time.
    meter = DoseMeter(Tube(60.0, 100.0), "cps")
    assert meter.reading(60_000.0) == pytest.approx(1000.0 / 0.9)
    assert meter.saturated == 0


@given(st.floats(0.0, 1e6), st.floats(0.0, 1000.0))
def test_the_correction_undoes_what_dead_time_does(true_cps: float, dead_time_us: float) -> None:
    tau = dead_time_us / 1e6
    measured = true_cps / (1.0 + true_cps * tau)
    if measured * tau < MAX_DEAD:
        assert DoseMeter(Tube(1.0, dead_time_us), "cps").reading(measured * 60.0) == pytest.approx(true_cps, rel=1e-6)


@given(RATES, RATES, DEAD_TIMES)
def test_more_counts_are_never_less_radiation(a: float, b: float, dead_time_us: float) -> None:
    meter = DoseMeter(Tube(100.0, dead_time_us))
    low, high = sorted((a, b))
    assert 0.0 <= meter.reading(low) <= meter.reading(high) * (1 + 1e-12)
    assert math.isfinite(meter.reading(high))


def test_a_saturated_tube_reads_high_and_is_counted() -> None:
    meter = DoseMeter(Tube(1.0, 100.0), "cps")
    edge = MAX_DEAD / 100e-6
    for cps in (1.0 / 100e-6, 2.0 / 100e-6):  # m tau = 1: the formula has a pole there; beyond it it is negative
        assert meter.reading(cps * 60.0) >= meter.reading(edge * 60.0 * 0.999)
    assert meter.saturated == 2


def test_the_devices_own_sensitivity_counts_unless_it_is_configured() -> None:
    assert DoseMeter(Tube(100.0, 0.0)).reading(100.0, 200.0) == 0.5
    assert DoseMeter(Tube(100.0, 0.0), believe_device=False).reading(100.0, 200.0) == 1.0
    assert DoseMeter(Tube(100.0, 0.0), "cpm").reading(100.0, 200.0) == 100.0


@pytest.mark.parametrize("tube", [Tube(0.0, 0.0), Tube(-1.0, 0.0), Tube(1.0, -1.0)])
def test_impossible_tubes_are_refused(tube: Tube) -> None:
    with pytest.raises(ValueError, match="a tube needs"):
        DoseMeter(tube)


@pytest.mark.parametrize(
    ("value", "stated", "unit", "expected"),
    [
        (120.0, "nSv/h", "usvh", 0.12), (0.12, "uSv/h", "usvh", 0.12), (0.12, "\u00b5Sv/h", "usvh", 0.12),
        (0.12, "\u03bcSv/h", "usvh", 0.12), (0.5, "mSv/h", "usvh", 500.0), (2.0, "Sv/h", "usvh", 2e6),
        (2.0, "cps", "cpm", 120.0), (120.0, "cpm", "cps", 2.0), (30.0, "counts", "counts", 30.0),
        # 100 counts a minute are 1 uSv/h.
        (50.0, "cpm", "usvh", 0.5), (5.0, "cps", "usvh", 3.0), (3.0, "uSv/h", "cps", 5.0), (1.0, "mSv/h", "cpm", 1e5),
    ],
)  # fmt: skip
def test_readings_in_other_units(value: float, stated: str, unit: str, expected: float) -> None:
    assert converted(value, stated, unit, 100.0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("stated", "unit"), [("cps", "usvh"), ("uSv/h", "cpm"), ("mSv/h", "cps")])
def test_counts_and_dose_rates_need_a_sensitivity(stated: str, unit: str) -> None:
    with pytest.raises(MalformedError, match=rf"{stated} needs sensor\.cpm_per_usvh to be converted to {unit}"):
        converted(1.0, stated, unit, None)


@pytest.mark.parametrize(("stated", "unit"), [("counts", "cpm"), ("cps", "counts"), ("counts", "usvh")])
def test_counts_of_no_stated_time_are_no_rate(stated: str, unit: str) -> None:
    with pytest.raises(MalformedError, match=f"{stated} cannot be converted to {unit}"):
        converted(1.0, stated, unit, 100.0)


@given(st.floats(0.0, 1e12), st.sampled_from(list(STATED)), st.sampled_from(["usvh", "cpm", "cps"]))
def test_a_conversion_and_back_is_the_same(value: float, stated: str, unit: str) -> None:
    if stated != "counts":
        there = converted(value, stated, unit, 153.8)
        assert converted(there, unit, stated, 153.8) == pytest.approx(value, rel=1e-12)
