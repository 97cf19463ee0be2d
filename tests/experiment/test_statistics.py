"""Means and confidence intervals, against figures from tables and by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.experiment.statistics import Estimate, counted, estimate, t_between, t_quantile


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [(1, 12.7062), (2, 4.3027), (3, 3.1824), (5, 2.5706), (9, 2.2622), (29, 2.0452), (120, 1.9799)],
)
def test_quantiles_are_those_of_the_printed_tables(degrees: int, expected: float) -> None:
    """Student's t, two-sided 95 %, as any textbook prints it."""
    assert t_quantile(0.975, degrees) == pytest.approx(expected, abs=5e-5)


@given(st.floats(0, 50), st.integers(1, 200))
def test_the_distribution_grows_with_t_and_stays_a_probability(t: float, degrees: int) -> None:
    rounding = 1e-12
    assert 0 <= t_between(t, degrees) <= t_between(t + 0.5, degrees) + rounding <= 1 + 2 * rounding


@given(st.floats(0.5, 0.999), st.integers(1, 60))
def test_the_quantile_inverts_the_distribution(p: float, degrees: int) -> None:
    assert t_between(t_quantile(p, degrees), degrees) == pytest.approx(2 * p - 1, abs=1e-9)


def test_an_interval_by_hand() -> None:
    """1, 2, 3, 4: mean 2.5, s^2 = 5/3, standard error sqrt(5/12), t for 3 degrees 3.1824."""
    found = estimate([1, 2, 3, 4])
    assert found is not None
    assert found.mean == 2.5
    assert found.half_width == pytest.approx(3.1824 * math.sqrt(5 / 12), abs=1e-3)
    assert found.runs == 4
    assert found.text() == "2.50 ± 2.05"


def test_one_value_has_no_interval_and_none_have_no_mean() -> None:
    assert estimate([0.25]) == Estimate(0.25, None, (0.25,))
    assert Estimate(0.25, None, (0.25,)).text(1) == "0.2"
    assert estimate([]) is None


def test_five_runs_make_an_interval_worth_drawing_and_fewer_are_shown_one_by_one() -> None:
    few, enough, one = (estimate(values) for values in ([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0, 4.0], [7.0]))
    assert few is not None
    assert enough is not None
    assert one is not None
    assert (few.drawn, few.singles, few.reach) == (None, (0.0, 1.0, 2.0, 3.0), (0.0, 3.0))
    assert (enough.drawn, enough.singles) == (enough.half_width, ())
    assert enough.half_width is not None
    assert enough.reach == (2 - enough.half_width, 2 + enough.half_width)
    assert (one.drawn, one.singles, one.reach) == (None, (), (7.0, 7.0))
    assert counted(1, "band") == "1 run"
    assert counted(4, "band") == "4 runs, thin lines: the single runs"
    assert counted(4, "error bars") == "4 runs, dots: the single runs"
    assert counted(5, "band") == "5 runs, band: 95 % confidence interval"


def test_what_is_out_of_range_is_our_bug() -> None:
    with pytest.raises(ValueError, match="degrees"):
        t_quantile(0.975, 0)
