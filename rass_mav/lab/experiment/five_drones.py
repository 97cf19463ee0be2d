"""The paper's physical experiment, simulated: four drones, two routes to the base, one of them past a source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rass_mav.lab.experiment.curves import by_policy, mean_curve, over_time, reliability
from rass_mav.lab.experiment.figures import SHARE, Curve, Panel, draw, policy_style
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, PAIRED, kept, standard
from rass_mav.lab.experiment.statistics import Estimate, Share, counted, estimate_difference, estimate_share
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.policy.settings import kinds

SCENARIO = "five-drones"
POLICIES = ("rass", "hop-count", "rass-literal")
ALL_POLICIES = tuple(kinds())
#: The drones' letters in the paper's figure, by node id.
LETTERS = {1: "A", 2: "B", 3: "C", 4: "D"}
TABLE_COLUMNS = ("policy", "runs", "steps", *COLUMNS, *(c for a in LETTERS.values() for c in triple(f"from_{a}")))
SERIES_COLUMNS = ("policy", "origin", "step", *triple("reliability"))


def plan(extent: Extent, policies: Sequence[str]) -> list[Run]:
    """The runs of each policy. Raises `ConfigError`."""
    return extent.plan(SCENARIO, SCENARIO, policies, measures=("origins",))


def of_origin(result: Result, node: int) -> list[Share]:
    """Reliability over time of the data that one drone created."""
    origins = result.extra["origins"]
    pairs = zip(origins["created"][str(node)], origins["lost"][str(node)], strict=True)
    return [Share(created - lost, created) for created, lost in pairs]


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, reliability.csv (over time), table.csv, table.md and two figures; returns their paths."""
    policies = by_policy(results)
    table: list[list[object]] = []
    series: list[list[object]] = []
    lines = []
    for policy, group in policies.items():
        found = standard(group)
        origins = []
        for name, rows in _origins(group):
            for step, shares in zip(group[0].series.step, zip(*rows, strict=True), strict=True):
                series.append([policy, name, step, *figures_of(estimate_share(shares))])
            if name in LETTERS.values():
                origins.append(estimate_share([row[-1] for row in rows]))
        table.append([policy, found.runs, found.steps, *found.columns(), *(v for e in origins for v in figures_of(e))])
        lines.append([policy_style(policy).label, *found.cells(), *(cell(e, 3) for e in origins)])
    runs, steps = len(next(iter(policies.values()))), results[0].steps
    names = [f"Reliability from {letter}" for letter in LETTERS.values()]
    text = (
        "# Five drones\n\n"
        f"{counted(runs)} of {steps} steps. The source is beside A; C's data go past it, or round it by D and B.\n\n"
        f"{NOTE}\n" + markdown(["Algorithm", *HEADINGS, *names], lines) + _gaps(policies)
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


def _origins(group: Sequence[Result]) -> list[tuple[str, list[list[Share]]]]:
    """For all data and each drone's: name, reliability over time of each run."""
    whole = [reliability(result.series) for result in group]
    return [("all", whole), *((name, [of_origin(result, node) for result in group]) for node, name in LETTERS.items())]


def _curve(group: Sequence[Result], node: int) -> Curve:
    style = policy_style(group[0].policy)
    rows = [of_origin(result, node) for result in group]
    return mean_curve(style.label, style.color, style.marker, group[0].series.step, rows)


def _gaps(policies: dict[str, list[Result]]) -> str:
    """How far RASS is above the others in the same runs, whole and for C's data."""
    if "rass" not in policies:
        return ""
    lines = []
    for other in policies:
        if other != "rass":
            whole = _gap(policies["rass"], policies[other], kept)
            far = _gap(policies["rass"], policies[other], lambda result: of_origin(result, 3)[-1])
            lines.append([policy_style(other).label, cell(whole, 3), cell(far, 3)])
    if not lines:
        return ""
    return f"\nRASS is above by\n\n{markdown(['', 'all data', 'from C'], lines)}\n{PAIRED}"


def _gap(rass: Sequence[Result], other: Sequence[Result], value: Callable[[Result], Share]) -> Estimate | None:
    others = {result.seed: value(result).value for result in other}
    return estimate_difference([value(result).value - others[result.seed] for result in rass if result.seed in others])
