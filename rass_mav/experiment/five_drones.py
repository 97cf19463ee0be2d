"""The paper's physical experiment, simulated: four drones, two routes to the base, one of them past a source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rass_mav.experiment.curves import by_policy, final_reliability, mean_curve, over_time, reliability
from rass_mav.experiment.figures import SHARE, Curve, Panel, draw, policy_style
from rass_mav.experiment.runs import Extent, Result, Run
from rass_mav.experiment.statistics import counted, estimate
from rass_mav.experiment.tables import cell, figures_of, markdown, write_csv, write_runs, write_text
from rass_mav.policy.settings import kinds

SCENARIO = "five-drones"
POLICIES = ("rass", "hop-count", "rass-literal")
ALL_POLICIES = tuple(kinds())
#: The drones' letters in the paper's figure, by node id.
LETTERS = {1: "A", 2: "B", 3: "C", 4: "D"}
TABLE_COLUMNS = ("policy", "origin", "runs", "steps", "reliability_mean", "reliability_ci95")
SERIES_COLUMNS = ("policy", "origin", "step", "reliability_mean", "reliability_ci95")


def plan(extent: Extent, policies: Sequence[str]) -> list[Run]:
    """The runs of each policy. Raises `ConfigError`."""
    return extent.plan(SCENARIO, SCENARIO, policies, measures=("origins",))


def of_origin(result: Result, node: int) -> list[float]:
    """Reliability over time of the data that one drone created; 1 while it has created none."""
    origins = result.extra["origins"]
    pairs = zip(origins["created"][str(node)], origins["lost"][str(node)], strict=True)
    return [1 - lost / created if created else 1.0 for created, lost in pairs]


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, reliability.csv (over time), table.csv, table.md and two figures; returns their paths."""
    policies = by_policy(results)
    table: list[list[object]] = []
    series: list[list[object]] = []
    lines = []
    for policy, group in policies.items():
        cells = []
        for name, rows, final in _origins(group):
            found = estimate(final)
            cells.append(cell(found, 3))
            table.append([policy, name, len(group), group[0].steps, *figures_of(found)])
            for step, values in zip(group[0].series.step, zip(*rows, strict=True), strict=True):
                series.append([policy, name, step, *figures_of(estimate(values))])
        lines.append([policy_style(policy).label, *cells])
    names = [f"from {letter}" for letter in LETTERS.values()]
    runs, steps = len(next(iter(policies.values()))), results[0].steps
    text = (
        "# Five drones: reliability\n\n"
        f"Mean of {runs} runs of {steps} steps ± half of the 95 % confidence interval (Student's t).\n"
        "The source is beside A; C's data go past it, or round it by D and B.\n\n"
        + markdown(["Algorithm", "all data", *names], lines)
        + _gaps(policies)
    )
    note = f"mean of {counted(runs, 'band')}"
    whole = [over_time(group, reliability) for group in policies.values()]
    y_label = "reliability (1 - lost / created)"
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, table),
        write_text(out / "table.md", text),
        write_csv(out / "reliability.csv", SERIES_COLUMNS, series),
        draw(
            out / "reliability.png",
            [Panel("Reliability over time: five drones", "step", y_label, whole, (0, 1.03), bounds=SHARE)],
            note=note,
        ),
        draw(
            out / "reliability-by-drone.png",
            [
                Panel(
                    f"Data from {letter}", "step", y_label,
                    [_curve(group, node) for group in policies.values()], (0, 1.03), bounds=SHARE,
                )
                for node, letter in LETTERS.items()
            ],
            columns=2, note=note,
        ),
    ]  # fmt: skip


def _origins(group: Sequence[Result]) -> list[tuple[str, list[list[float]], list[float]]]:
    """For all data and each drone's: name, reliability over time of each run, reliability at the end of each run."""
    whole = [reliability(result.series) for result in group]
    found = [("all", whole, [final_reliability(result) for result in group])]
    for node, letter in LETTERS.items():
        rows = [of_origin(result, node) for result in group]
        found.append((letter, rows, [row[-1] for row in rows]))
    return found


def _curve(group: Sequence[Result], node: int) -> Curve:
    style = policy_style(group[0].policy)
    rows = [of_origin(result, node) for result in group]
    return mean_curve(style.label, style.color, style.marker, group[0].series.step, rows)


def _gaps(policies: dict[str, list[Result]]) -> str:
    """How far RASS is above the others, whole and for C's data."""
    if "rass" not in policies:
        return ""
    lines = []
    for other in policies:
        if other != "rass":
            whole = _gap(policies["rass"], policies[other], final_reliability)
            far = _gap(policies["rass"], policies[other], lambda result: of_origin(result, 3)[-1])
            lines.append([policy_style(other).label, whole, far])
    if not lines:
        return ""
    return "\nRASS is above by\n\n" + markdown(["", "all data", "from C"], lines)


def _gap(rass: Sequence[Result], other: Sequence[Result], value: Callable[[Result], float]) -> str:
    a = estimate([value(result) for result in rass])
    b = estimate([value(result) for result in other])
    return "n/a" if a is None or b is None else f"{a.mean - b.mean:.3f}"
