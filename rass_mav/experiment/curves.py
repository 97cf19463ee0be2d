"""Curves from the results of runs: means over runs, and how certain they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from rass_mav.experiment.figures import Curve, policy_style
from rass_mav.experiment.measures import Series
from rass_mav.experiment.runs import Result
from rass_mav.experiment.statistics import ENOUGH_RUNS, Estimate, estimate

NAN = math.nan


def reliability(series: Series) -> list[float]:
    """(created - lost) / created at each sample; 1 while nothing has been created."""
    return [1 - lost / created if created else 1.0 for created, lost in zip(series.created, series.lost, strict=True)]


def total_stored(series: Series) -> list[int]:
    """Items in all drones' stores and at the bases, at each sample."""
    return [stored + base for stored, base in zip(series.stored, series.base, strict=True)]


def mean_curve(
    label: str, color: str, marker: str, x: Sequence[float], rows: Sequence[Sequence[float]], *, line: str = "-"
) -> Curve:
    """The mean over runs (`rows`: one list for each, as long as `x`; NaN: none there), and how sure it is."""
    found = [estimate([value for value in column if not math.isnan(value)]) for column in zip(*rows, strict=True)]
    y = [NAN if e is None else e.mean for e in found]
    if len(rows) < ENOUGH_RUNS:
        return Curve(label, x, y, color, marker, singles=rows if len(rows) > 1 else (), line=line)
    half = [NAN if e is None or e.drawn is None else e.drawn for e in found]
    return Curve(label, x, y, color, marker, half, line=line)


def over_time(
    results: Sequence[Result], values: Callable[[Series], Sequence[float]], label: str | None = None
) -> Curve:
    """A quantity over steps, of runs of one policy and of equal length."""
    style = policy_style(results[0].policy)
    rows = [values(result.series) for result in results]
    return mean_curve(label or style.label, style.color, style.marker, results[0].series.step, rows)


def by_policy(results: Iterable[Result]) -> dict[str, list[Result]]:
    """Results by policy, in order of first occurrence."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.policy, []).append(result)
    return groups


def summary_estimate(results: Sequence[Result], value: Callable[[Result], float | None]) -> Estimate | None:
    """Mean over the runs that have the value."""
    return estimate([v for result in results if (v := value(result)) is not None])


def final_reliability(result: Result) -> float:
    """As in the summary."""
    return float(result.summary["reliability"])


def mean_delay(result: Result) -> float | None:
    """Steps from creation to arrival; None if nothing has arrived."""
    mean = result.summary["delay_steps"]["mean"]
    return None if mean is None else float(mean)


def memory_used(result: Result) -> float:
    """Items in a drone, mean over drones and steps, in percent of what the scenario counts as full."""
    return float(result.summary["memory_used_percent"])
