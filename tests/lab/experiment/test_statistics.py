"""Means and confidence intervals, against figures from tables, by hand and by exact computation."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.lab.experiment.statistics import (
    RESAMPLES,
    Estimate,
    Share,
    beta_below,
    beta_quantile,
    counted,
    estimate,
    estimate_difference,
    estimate_share,
    t_between,
    t_quantile,
    tail,
)
from tests.extent import extents
from tests.some import some

# -- distributions -----------------------------------------------------------------------------------------------------


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


def at_least(successes: int, n: int, p: float) -> float:
    """P(X >= successes) of the binomial distribution."""
    return math.fsum(math.comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(successes, n + 1))


@given(st.integers(1, 40), st.data(), st.floats(0.001, 0.999))
def test_the_beta_distribution_sums_the_binomial_one(n: int, data: st.DataObject, p: float) -> None:
    successes = data.draw(st.integers(1, n))
    assert beta_below(p, successes, n - successes + 1) == pytest.approx(at_least(successes, n, p), rel=1e-9, abs=1e-12)


@given(st.floats(0.001, 0.999), st.floats(0.5, 200), st.floats(0.5, 200))
def test_the_quantile_of_the_beta_distribution_inverts_it(p: float, a: float, b: float) -> None:
    assert beta_below(beta_quantile(p, a, b), a, b) == pytest.approx(p, abs=1e-9)


def test_what_is_out_of_range_is_our_bug() -> None:
    with pytest.raises(ValueError, match="degrees"):
        t_quantile(0.975, 0)


# -- Student's t -------------------------------------------------------------------------------------------------------


def test_an_interval_by_hand() -> None:
    """1, 2, 3, 4: mean 2.5, s^2 = 5/3, standard error sqrt(5/12), t for 3 degrees 3.1824."""
    found = some(estimate([1, 2, 3, 4]))
    assert found.mean == 2.5
    half = 3.1824 * math.sqrt(5 / 12)
    assert found.interval == pytest.approx((2.5 - half, 2.5 + half), abs=1e-3)
    assert found.runs == 4
    assert found.text() == "2.50 ± 2.05"
    assert found.times(10).text(1) == "25.0 ± 20.5"


def test_one_value_has_no_interval_and_none_have_no_mean() -> None:
    assert estimate([0.25]) == estimate_difference([0.25]) == Estimate(0.25, None, (0.25,))
    assert estimate_share([Share(1, 4)]) == Estimate(0.25, None, (0.25,))
    assert Estimate(0.25, None, (0.25,)).text(1) == "0.2"
    assert estimate([]) is estimate_difference([]) is None


# -- shares ------------------------------------------------------------------------------------------------------------


def even(part: int, whole: int, runs: int) -> list[Share]:
    """As many parts in each run, but for the last ones."""
    return [Share(part // runs + (run < part % runs), whole // runs) for run in range(runs)]


@pytest.mark.parametrize(
    ("part", "low", "high"),
    [(0, 0.0, 0.0362), (1, 0.0003, 0.0545), (5, 0.0164, 0.1128), (50, 0.3983, 0.6017), (100, 0.9638, 1.0)],
)
def test_with_many_runs_of_one_datum_each_it_is_the_exact_interval_of_clopper_and_pearson(
    part: int, low: float, high: float
) -> None:
    """Their printed intervals for 100 trials. Runs that lose one datum or none scatter as independent data do."""
    found = estimate_share(even(part, 100, 100))
    assert found.mean == part / 100
    assert found.interval == pytest.approx((low, high), abs=6e-5 if part in (0, 100) else 0.002)


def test_where_nothing_is_lost_the_bound_is_a_little_more_than_that_of_the_rule() -> None:
    """1 - 0.025^(1 / n), which is 3.69 / n; a tenth more for 30 runs: (1.96 / 2.045)^2 = 0.918."""
    found = estimate_share([Share(4950, 4950)] * 30).rest()
    assert found.mean == 0
    low, high = some(found.interval)
    assert low == 0
    assert high == pytest.approx(3.6889 / (0.9184 * 30 * 4950), rel=1e-3)
    assert found.times(1e6).text(0) == "0 (0 to 27)"
    assert estimate_share([Share(0, 4950)] * 30).interval == pytest.approx((0.0, high))


def test_losses_that_come_together_in_one_run_say_less_than_scattered_ones() -> None:
    scattered = estimate_share([Share(999, 1000)] * 30)
    together = estimate_share([Share(1000, 1000)] * 29 + [Share(970, 1000)])
    assert scattered.mean == pytest.approx(together.mean) == pytest.approx(0.999)
    assert scattered.interval is not None
    assert together.interval is not None
    assert together.interval[0] < scattered.interval[0] < 0.999 < scattered.interval[1] < together.interval[1] <= 1
    # p (1 - p) / variance of the mean = 0.000999 / (0.0009 (1/30 - 1/900) / 29) = 999 of 30,000 data, reduced by 0.918.
    effective = 999 * (t_quantile(0.975, 29_999) / t_quantile(0.975, 29)) ** 2
    assert 1 - together.interval[0] == pytest.approx(
        beta_quantile(0.975, 0.001 * effective + 1, 0.999 * effective), rel=1e-6
    )


def test_in_the_middle_it_is_nearly_that_of_students_t() -> None:
    shares = [Share(round(4950 * (0.55 + 0.01 * run)), 4950) for run in range(30)]
    found, students = estimate_share(shares), estimate([share.value for share in shares])
    assert students is not None
    assert found.mean == students.mean
    assert found.interval == pytest.approx(students.interval, abs=0.002)
    assert found.text(3) == "0.695 (0.661 to 0.728)"


@given(st.lists(st.integers(0, 50), min_size=2, max_size=12))
def test_the_interval_of_a_share_has_its_mean_and_stays_a_share(parts: list[int]) -> None:
    found = estimate_share([Share(part, 50) for part in parts])
    rest = estimate_share([Share(50 - part, 50) for part in parts]).rest()
    assert found.interval is not None
    low, high = found.interval
    assert 0 <= low <= found.mean <= high <= 1
    assert low < high
    assert rest.interval == pytest.approx(found.interval, abs=1e-9)


#: How the probability of losing a datum is drawn for each run, and its mean.
RISKS: dict[str, tuple[Callable[[random.Random], float], float]] = {
    "independent": (lambda rng: 1e-5, 1e-5),
    "exponential": (lambda rng: rng.expovariate(1000), 1e-3),
    "lognormal": (lambda rng: rng.lognormvariate(-8, 1.5), math.exp(-8 + 1.5**2 / 2)),
}


def coverage(risk: str, runs: int, repetitions: int) -> tuple[float, float]:
    """How often the interval of shares and that of Student's t have the truth, in simulated sets of runs."""
    draw, truth = RISKS[risk]
    rng = random.Random(f"{risk}:{runs}")
    found = [0, 0]
    for _ in range(repetitions):
        shares = [Share(poisson(rng, 4950 * draw(rng)), 4950) for _ in range(runs)]
        for index, estimated in enumerate((estimate_share(shares), estimate([share.value for share in shares]))):
            assert estimated is not None
            low, high = some(estimated.interval)
            found[index] += low <= truth <= high
    return found[0] / repetitions, found[1] / repetitions


def poisson(rng: random.Random, mean: float) -> int:
    """By the waiting times between events."""
    count, waited = 0, rng.expovariate(1)
    while waited < mean:
        count += 1
        waited += rng.expovariate(1)
    return count


@pytest.mark.no_cover
@pytest.mark.parametrize("repetitions", extents(100, 2000))
def test_near_1_the_interval_has_the_truth_more_often_than_students_t(repetitions: int) -> None:
    """docs/evaluation/experiments.md has the figures of the soak."""
    for runs in (10, 30):
        found = {risk: coverage(risk, runs, repetitions) for risk in RISKS}
        assert all(shares > students for shares, students in found.values()), found
        assert found["independent"][0] > 0.95
        assert found["exponential"][0] > 0.88
        # A few bad runs make up most of the mean, and are rarely among these: no interval of so few can know.
        assert found["lognormal"][0] < 0.95


def test_of_no_data_all_are_kept() -> None:
    assert Share(0, 0).value == 1.0
    assert estimate_share([Share(0, 0), Share(0, 0)]) == Estimate(1.0, None, (1.0, 1.0))


# -- differences -------------------------------------------------------------------------------------------------------


def exact_interval(values: list[float]) -> tuple[float, float]:
    """Of all n^n resamples instead of some: where no more than the tail is outside."""
    n = len(values)
    means = sorted(math.fsum(drawn) / n for drawn in itertools.product(values, repeat=n))
    outside = int(len(means) * tail(n))
    return means[outside], means[-1 - outside]


@pytest.mark.parametrize(
    "values", [[0.0, 0.0, 0.0, 0.0, 0.1, 0.3], [0.01, -0.02, 0.04, 0.05, 0.02, 0.03], [1.0, 2.0, 4.0, 8.0, 16.0]]
)
def test_a_bootstrap_finds_nearly_what_all_resamples_give(values: list[float]) -> None:
    found = some(estimate_difference(values))
    assert found.interval == pytest.approx(exact_interval(values), abs=0.05 * (max(values) - min(values)))
    assert found == estimate_difference(values)


def test_the_tails_are_those_that_few_runs_need() -> None:
    """Phi(-sqrt(n / (n - 1)) t): of 30 runs Phi(-2.0802), of 10 Phi(-2.3846); of very many 0.025."""
    assert tail(30) == pytest.approx(0.01876, abs=1e-5)
    assert tail(10) == pytest.approx(0.00855, abs=1e-5)
    assert tail(100_000) == pytest.approx(0.025, abs=1e-5)
    assert RESAMPLES * tail(10) > 50


def test_a_few_better_runs_among_equal_ones_are_no_worse() -> None:
    """Near 1 Student's t gives differences that no run has."""
    differences = [0.0] * 25 + [0.001, 0.002, 0.002, 0.003, 0.05]
    found, students = estimate_difference(differences), estimate(differences)
    assert found is not None
    assert found.interval is not None
    assert students is not None
    assert some(students.interval)[0] < 0 < found.interval[0] < found.mean < found.interval[1]


def test_where_nothing_differs_nothing_is_uncertain() -> None:
    assert estimate_difference([0.0, 0.0, 0.0]) == Estimate(0.0, (0.0, 0.0), (0.0, 0.0, 0.0))


# -- what is shown -----------------------------------------------------------------------------------------------------


def test_five_runs_make_an_interval_worth_drawing_and_fewer_are_shown_one_by_one() -> None:
    few, enough, one = (estimate(values) for values in ([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0, 4.0], [7.0]))
    assert few is not None
    assert enough is not None
    assert one is not None
    assert (few.drawn, few.singles, few.reach) == (None, (0.0, 1.0, 2.0, 3.0), (0.0, 3.0))
    assert (enough.drawn, enough.singles) == (enough.interval, ())
    assert enough.reach == enough.interval
    assert (one.drawn, one.singles, one.reach) == (None, (), (7.0, 7.0))
    assert counted(1, "band") == "1 run"
    assert counted(4, "band") == "4 runs, thin lines: the single runs"
    assert counted(4, "error bars") == "4 runs, dots: the single runs"
    assert counted(5, "band") == "5 runs, band: 95 % confidence interval"
