"""Curves from the results of runs, with how certain they are; and delay by the distance at which data were created.

In a mean over all distances, policies that lose distant data look faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rass_mav.lab.experiment.columns import Group
from rass_mav.lab.experiment.figures import Curve, Panel, Style, policy_style
from rass_mav.lab.experiment.measures import OUT_OF_REACH, Series
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import ENOUGH_RUNS, Estimate, Share, estimate, estimate_share
from rass_mav.lab.experiment.tables import figures_of, triple, write_csv

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


#: Columns of delay-by-distance.csv after those of the case.
_COLUMNS = (
    "distance_hops", "created", "arrived", "lost", "delay_mean", "runs_with_arrivals", *triple("delay_of_runs"),
)  # fmt: skip


def write_distances(path: Path, groups: Sequence[Group]) -> Path:
    """A CSV file with a row for each distance in each group."""
    rows = ([*group.case.values(), *row] for group in groups for row in _rows(group.runs))
    return write_csv(path, (*groups[0].case, *_COLUMNS), rows)


def _rows(results: Sequence[Result]) -> list[list[object]]:
    """`_COLUMNS`, a row for each distance. delay_mean: over all data; delay_of_runs: over the means of runs."""
    found: list[list[object]] = []
    for hops in sorted({hops for result in results for hops in result.distances}):
        here = [result.distances[hops] for result in results if hops in result.distances]
        arrived = sum(d.arrived for d in here)
        total = sum(d.delay_sum for d in here)
        runs = _delays_at(results, hops)
        found.append(
            [
                "out of reach" if hops == OUT_OF_REACH else hops,
                sum(d.created for d in here), arrived, sum(d.lost for d in here),
                round(total / arrived, 4) if arrived else None, len(runs), *figures_of(estimate(runs)),
            ]
        )  # fmt: skip
    return found


def distance_panel(title: str, groups: Iterable[tuple[Style, Sequence[Result]]]) -> Panel:
    """Mean delay against distance, a line a group of runs."""
    curves = []
    for style, results in groups:
        hops = sorted({h for result in results for h in result.distances if h != OUT_OF_REACH})
        runs = [[_delay_at(result, h) for h in hops] for result in results]
        curve = mean_curve(style, hops, runs)
        if any(map(math.isfinite, curve.y)):
            curves.append(curve)
    # Bands of distances at which hardly any data were created may be huge: the lines set the scale.
    lines = [line for curve in curves for line in (curve.y, *curve.singles)]
    highest = max((y for line in lines for y in line if math.isfinite(y)), default=0.0)
    return Panel(
        title, "distance from the base at creation (hops)", "mean delay of the data that arrived (steps)", curves,
        (0, 1.15 * highest if highest else 1),
    )  # fmt: skip


def _delays_at(results: Sequence[Result], hops: int) -> list[float]:
    """Mean delay of each run, of its data created at this distance from the base, where any arrived."""
    return [delay for result in results if not math.isnan(delay := _delay_at(result, hops))]


def _delay_at(result: Result, hops: int) -> float:
    """The same of one run; NaN where none arrived."""
    found = result.distances.get(hops)
    return found.delay_sum / found.arrived if found is not None and found.arrived else math.nan
