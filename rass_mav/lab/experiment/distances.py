"""Delay by the distance at which data were created: in a mean over all, policies that lose distant data look faster."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from rass_mav.lab.experiment.columns import Group
from rass_mav.lab.experiment.curves import mean_curve
from rass_mav.lab.experiment.figures import Panel, Style
from rass_mav.lab.experiment.measures import OUT_OF_REACH
from rass_mav.lab.experiment.runs import Result
from rass_mav.lab.experiment.statistics import estimate
from rass_mav.lab.experiment.tables import figures_of, triple, write_csv

#: Columns of delay-by-distance.csv after those of the case.
_COLUMNS = (
    "distance_hops", "created", "arrived", "lost", "delay_mean", "runs_with_arrivals", *triple("delay_of_runs"),
)  # fmt: skip


def write(path: Path, groups: Sequence[Group]) -> Path:
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


def panel(title: str, groups: Iterable[tuple[Style, Sequence[Result]]]) -> Panel:
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
