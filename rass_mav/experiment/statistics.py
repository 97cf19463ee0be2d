"""Means over runs and their confidence."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

#: So many runs make an interval worth drawing. With fewer, figures show each run by itself.
ENOUGH_RUNS = 5
#: How a figure shows an interval.
Interval: TypeAlias = Literal["band", "error bars"]


class Estimate(NamedTuple):
    """A mean over runs."""

    mean: float
    half_width: float | None
    """Half of the confidence interval; None with fewer than two values."""
    values: tuple[float, ...]
    """Of each run."""

    @property
    def runs(self) -> int:
        """How many."""
        return len(self.values)

    @property
    def drawn(self) -> float | None:
        """Half of the interval, where a figure shows it."""
        return self.half_width if self.runs >= ENOUGH_RUNS else None

    @property
    def singles(self) -> tuple[float, ...]:
        """What a figure shows in its place: the runs, if there is more than one."""
        return self.values if 1 < self.runs < ENOUGH_RUNS else ()

    @property
    def reach(self) -> tuple[float, float]:
        """From where to where a figure shows it."""
        shown = (self.mean - (self.drawn or 0.0), self.mean + (self.drawn or 0.0), *self.singles)
        return min(shown), max(shown)

    def times(self, factor: float) -> Estimate:
        """The same in another unit."""
        half = None if self.half_width is None else factor * self.half_width
        return Estimate(factor * self.mean, half, tuple(factor * value for value in self.values))

    def text(self, digits: int = 2) -> str:
        """For tables: mean +- half width."""
        if self.half_width is None:
            return f"{self.mean:.{digits}f}"
        return f"{self.mean:.{digits}f} ± {self.half_width:.{digits}f}"


def estimate(values: Sequence[float], confidence: float = 0.95) -> Estimate | None:
    """Mean and its two-sided confidence interval by Student's t. None without values.

    The half width is t s / sqrt(n): s is the sample's standard deviation, t the quantile for n - 1 degrees of freedom.
    It shows how sure the mean is, not how far single runs scatter.
    """
    n = len(values)
    if not n:
        return None
    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, tuple(values))
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1))
    return Estimate(mean, t_quantile(0.5 + confidence / 2, n - 1) * deviation / math.sqrt(n), tuple(values))


def counted(runs: int, interval: Interval | None = None) -> str:
    """The number of runs, in words. `interval`: how a figure shows the confidence interval of several runs."""
    if runs == 1:
        return "1 run"
    if interval is None:
        return f"{runs} runs"
    if runs >= ENOUGH_RUNS:
        return f"{runs} runs, {interval}: 95 % confidence interval"
    return f"{runs} runs, {'thin lines' if interval == 'band' else 'dots'}: the single runs"


def t_between(t: float, degrees: int) -> float:
    """P(|T| <= t) of Student's t with `degrees` >= 1 degrees of freedom, t >= 0.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 26.7.3 and 26.7.4: finite sums, exact.
    """
    theta = math.atan(t / math.sqrt(degrees))
    cosine = math.cos(theta)
    odd = degrees % 2
    term = cosine if odd else 1.0
    total = 0.0
    for k in range(3 if odd else 2, degrees + 1, 2):
        total += term
        term *= cosine * cosine * (k - 1) / k
    if odd:
        return 2 / math.pi * (theta + math.sin(theta) * total)
    return math.sin(theta) * total


@functools.cache
def t_quantile(p: float, degrees: int) -> float:
    """The t with P(T <= t) = p, for 0.5 <= p < 1, by bisection of `t_between`."""
    if not (0.5 <= p < 1 and degrees >= 1):
        raise ValueError(f"expected 0.5 <= p < 1 and degrees >= 1, got {p} and {degrees}")
    target = 2 * p - 1
    low, high = 0.0, 1.0
    while t_between(high, degrees) < target:
        high *= 2
    while True:
        middle = (low + high) / 2
        if not low < middle < high:
            return middle
        if t_between(middle, degrees) < target:
            low = middle
        else:
            high = middle
