"""Curves from the results of runs: means over runs, and how certain they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from rass_mav.lab.experiment.figures import Curve, Style, policy_style
from rass_mav.lab.experiment.measures import Series
from rass_mav.lab.experiment.runs import Result
from rass_mav.lab.experiment.statistics import ENOUGH_RUNS, Estimate, Share, estimate, estimate_share

NAN = math.nan
#: A band that is not there.
NOWHERE = (NAN, NAN)


def reliability(series: Series) -> list[Share]:
    """Created and not lost, at each sample."""
    return [Share(created - lost, created) for created, lost in zip(series.created, series.lost, strict=True)]


def total_stored(series: Series) -> list[int]:
    """Items in all drones' stores and at the bases, at each sample."""
    return [stored + base for stored, base in zip(series.stored, series.base, strict=True)]


def mean_curve(style: Style, x: Sequence[float], rows: Sequence[Sequence[float | Share]]) -> Curve:
    """The mean over runs (`rows`: one list for each, as long as `x`; NaN: none there), and how sure it is."""
    found = [estimate_column(column) for column in zip(*rows, strict=True)]
    y = [NAN if e is None else e.mean for e in found]
    if len(rows) < ENOUGH_RUNS:
        singles = [list(map(_number, row)) for row in rows] if len(rows) > 1 else ()
        return Curve(style.label, x, y, style.color, style.marker, singles=singles)
    band = [NOWHERE if e is None or e.drawn is None else e.drawn for e in found]
    return Curve(style.label, x, y, style.color, style.marker, band)


def estimate_column(column: Sequence[float | Share]) -> Estimate | None:
    """The mean over runs of one quantity: numbers, of which NaN are left out, or shares."""
    shares = [value for value in column if isinstance(value, Share)]
    if shares:
        return estimate_share(shares)
    return estimate([value for value in map(_number, column) if not math.isnan(value)])


def _number(value: float | Share) -> float:
    return value.value if isinstance(value, Share) else value


def over_time(results: Sequence[Result], values: Callable[[Series], Sequence[float | Share]]) -> Curve:
    """A quantity over steps, of runs of one policy and of equal length."""
    rows = [values(result.series) for result in results]
    return mean_curve(policy_style(results[0].policy), results[0].series.step, rows)
