"""Means over runs and their confidence: one kind of interval for each kind of quantity.

- Shares of data (reliability, delivered, losses): `estimate_share`, which is right at 0 and 1 too.
- Differences between runs of the same seeds: `estimate_difference`, a paired bootstrap.
- All others: `estimate`, Student's t.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Literal, NamedTuple, TypeAlias

#: So many runs make an interval worth drawing. With fewer, figures show each run by itself.
ENOUGH_RUNS = 5
#: Of all intervals, two-sided.
CONFIDENCE = 0.95
#: Resamples of a bootstrap.
RESAMPLES = 10_000
#: How a figure shows an interval.
Interval: TypeAlias = Literal["band", "error bars"]


class Share(NamedTuple):
    """A part of the data of one run."""

    part: int
    whole: int

    @property
    def value(self) -> float:
        """0..1; of no data all."""
        return self.part / self.whole if self.whole else 1.0


class Estimate(NamedTuple):
    """A mean over runs."""

    mean: float
    interval: tuple[float, float] | None
    """The confidence interval, from where to where; None with fewer than two values."""
    values: tuple[float, ...]
    """Of each run."""

    @property
    def runs(self) -> int:
        """How many."""
        return len(self.values)

    @property
    def drawn(self) -> tuple[float, float] | None:
        """The interval, where a figure shows it."""
        return self.interval if self.runs >= ENOUGH_RUNS else None

    @property
    def singles(self) -> tuple[float, ...]:
        """What a figure shows in its place: the runs, if there is more than one."""
        return self.values if 1 < self.runs < ENOUGH_RUNS else ()

    @property
    def reach(self) -> tuple[float, float]:
        """From where to where a figure shows it."""
        shown = (self.mean, *(self.drawn or ()), *self.singles)
        return min(shown), max(shown)

    def times(self, factor: float) -> Estimate:
        """The same in another unit; `factor`: above 0."""
        interval = self.interval and (factor * self.interval[0], factor * self.interval[1])
        return Estimate(factor * self.mean, interval, tuple(factor * value for value in self.values))

    def rest(self) -> Estimate:
        """What is left of 1."""
        interval = self.interval and (1 - self.interval[1], 1 - self.interval[0])
        return Estimate(1 - self.mean, interval, tuple(1 - value for value in self.values))

    def text(self, digits: int = 2) -> str:
        """For tables: mean +- half of the interval, or the mean and an interval that is not symmetric."""
        mean = f"{self.mean:.{digits}f}"
        if self.interval is None:
            return mean
        low, high = self.interval
        if math.isclose(high - self.mean, self.mean - low, rel_tol=1e-6, abs_tol=1e-12):
            return f"{mean} ± {(high - low) / 2:.{digits}f}"
        return f"{mean} ({low:.{digits}f} to {high:.{digits}f})"


def estimate(values: Sequence[float]) -> Estimate | None:
    """Mean and its confidence interval by Student's t. None without values.

    Half of the interval is t s / sqrt(n): s is the sample's standard deviation, t the quantile for n - 1 degrees of
    freedom. It shows how sure the mean is, not how far single runs scatter.
    """
    n = len(values)
    if not n:
        return None
    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, tuple(values))
    half = t_quantile(0.5 + CONFIDENCE / 2, n - 1) * math.sqrt(_variance(values, mean) / n)
    return Estimate(mean, (mean - half, mean + half), tuple(values))


def estimate_share(shares: Sequence[Share]) -> Estimate:
    """Mean of the shares of at least one run, and its confidence interval after Korn and Graubard.

    Data of one run share their fate: they are near the same sources. So the interval is that of Clopper and Pearson,
    but for as many independent data as would scatter as the runs do: p (1 - p) / variance of the mean, at most all. As
    that variance comes from few runs, their number is multiplied by (t for all data / t for the runs)^2, with Student's
    quantiles. Where no run loses anything the data count as independent, and the bound is 3.7 / data or a little more.
    E. L. Korn, B. I. Graubard, Confidence intervals for proportions with small expected number of positive counts
    estimated from survey data, Survey Methodology 24 (1998).
    """
    values = tuple(share.value for share in shares)
    runs, data = len(values), sum(share.whole for share in shares)
    mean = math.fsum(values) / runs
    if runs == 1 or data < 2:
        return Estimate(mean, None, values)
    upper = 0.5 + CONFIDENCE / 2
    variance = _variance(values, mean) / runs
    independent = min(data, mean * (1 - mean) / variance) if variance else data
    effective = independent * (t_quantile(upper, data - 1) / t_quantile(upper, runs - 1)) ** 2
    part, others = effective * mean, effective * (1 - mean)
    low = beta_quantile(1 - upper, part, others + 1) if part else 0.0
    high = beta_quantile(upper, part + 1, others) if others else 1.0
    return Estimate(mean, (low, high), values)


def estimate_difference(differences: Sequence[float]) -> Estimate | None:
    """Mean difference of runs paired by their seeds, and its confidence interval by a bootstrap. None without values.

    Unlike Student's t it assumes no normal distribution: near 1 most differences are 0 and a few are not. The seeds are
    drawn again `RESAMPLES` times, the same ones in each call. The interval is that of percentiles, moved outwards so
    that few runs do not make it too narrow: T. C. Hesterberg, What teachers should know about the bootstrap, The
    American Statistician 69 (2015), "expanded percentile interval".
    """
    n = len(differences)
    if not n:
        return None
    mean = math.fsum(differences) / n
    if n == 1:
        return Estimate(mean, None, tuple(differences))
    rng = random.Random("bootstrap")
    means = sorted(math.fsum(rng.choices(differences, k=n)) / n for _ in range(RESAMPLES))
    outside = int(RESAMPLES * tail(n))
    return Estimate(mean, (means[outside], means[-1 - outside]), tuple(differences))


def tail(n: int) -> float:
    """The part of the resamples of n >= 2 values that is on each side of the interval."""
    return NormalDist().cdf(-math.sqrt(n / (n - 1)) * t_quantile(0.5 + CONFIDENCE / 2, n - 1))


def counted(runs: int, interval: Interval | None = None) -> str:
    """The number of runs, in words. `interval`: how a figure shows the confidence interval of several runs."""
    if runs == 1:
        return "1 run"
    if interval is None:
        return f"{runs} runs"
    if runs >= ENOUGH_RUNS:
        return f"{runs} runs, {interval}: 95 % confidence interval"
    return f"{runs} runs, {'thin lines' if interval == 'band' else 'dots'}: the single runs"


def beta_below(x: float, a: float, b: float) -> float:
    """P(X <= x) of the beta distribution with a, b > 0, for 0 <= x <= 1: the regularized incomplete beta function.

    The continued fraction of DLMF 8.17.22, evaluated by Lentz's method.
    """
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):
        # Here the fraction converges slowly.
        return 1 - beta_below(1 - x, b, a)
    scale = math.exp(
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    )  # fmt: skip
    c, d, fraction, m = 1.0, 0.0, 1.0, 0
    while True:
        k = m // 2
        if m % 2:
            term = -(a + k) * (a + b + k) * x / ((a + 2 * k) * (a + 2 * k + 1))
        else:
            term = k * (b - k) * x / ((a + 2 * k - 1) * (a + 2 * k)) if m else 1.0
        d = 1 / (1 + term * d)
        c = 1 + term / c
        fraction *= c * d
        m += 1
        if m > 1 and abs(c * d - 1) < 1e-15:
            return scale * (fraction - 1) / a


def beta_quantile(p: float, a: float, b: float) -> float:
    """The x with P(X <= x) = p of the beta distribution."""
    return _where(lambda x: beta_below(x, a, b), p, 1.0)


def t_between(t: float, degrees: int) -> float:
    """P(|T| <= t) of Student's t with `degrees` >= 1 degrees of freedom, t >= 0."""
    return beta_below(t * t / (degrees + t * t), 0.5, degrees / 2)


@functools.cache
def t_quantile(p: float, degrees: int) -> float:
    """The t with P(T <= t) = p, for 0.5 <= p < 1."""
    if not (0.5 <= p < 1 and degrees >= 1):
        raise ValueError(f"expected 0.5 <= p < 1 and degrees >= 1, got {p} and {degrees}")
    target = 2 * p - 1
    high = 1.0
    while t_between(high, degrees) < target:
        high *= 2
    return _where(lambda t: t_between(t, degrees), target, high)


def _where(rising: Callable[[float], float], target: float, high: float) -> float:
    """Where between 0 and `high` a rising function has this value, by bisection."""
    low = 0.0
    while high - low > 1e-13 * high:
        middle = (low + high) / 2
        if rising(middle) < target:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def _variance(values: Sequence[float], mean: float) -> float:
    """Of a sample of at least two."""
    return math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1)
