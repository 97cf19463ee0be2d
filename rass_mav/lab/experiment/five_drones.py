"""The paper's physical experiment, simulated: four drones, two routes to the base, one of them past a source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from rass_mav.lab.experiment.columns import PAIRED, STANDARD, Group, kept, share
from rass_mav.lab.experiment.curves import mean_curve, over_time, reliability
from rass_mav.lab.experiment.declaration import POLICIES, Experiment, by_policy, counted_runs
from rass_mav.lab.experiment.figures import SHARE, Curve, Panel, draw, policy_style
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import Estimate, Share, estimate_difference, estimate_share
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv

#: The drones' letters in the paper's figure, by node id.
LETTERS = {1: "A", 2: "B", 3: "C", 4: "D"}
SERIES_COLUMNS = ("policy", "origin", "step", *triple("reliability"))


def experiment() -> Experiment:
    """Its declaration."""
    return Experiment(
        title="Five drones",
        factors=[by_policy(POLICIES, ("rass", "hop-count", "rass-literal"))],
        columns=[
            *STANDARD,
            *(share(f"from_{letter}", f"Reliability from {letter}", partial(_at_the_end, node), digits=4)
              for node, letter in LETTERS.items()),
        ],
        scenario="five-drones",
        world="five-drones",
        measures=lambda case: ("origins",),
        intro="{runs} of {steps} steps. The source is beside A; C's data go past it, or round it by D and B.\n",
        after=_gaps,
        files=_files,
    )  # fmt: skip


def of_origin(result: Result, node: int) -> list[Share]:
    """Reliability over time of the data that one drone created."""
    origins = result.extra["origins"]
    pairs = zip(origins["created"][str(node)], origins["lost"][str(node)], strict=True)
    return [Share(created - lost, created) for created, lost in pairs]


def _at_the_end(node: int, result: Result) -> Share:
    return of_origin(result, node)[-1]


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """reliability.csv (over time) and two figures."""
    yield write_csv(out / "reliability.csv", SERIES_COLUMNS, _series(groups))
    y_label = "reliability (1 - lost / created)"
    note = f"mean of {counted_runs(groups, 'band')}"
    whole = [over_time(group.runs, reliability) for group in groups]
    yield draw(
        out / "reliability.png",
        [Panel("Reliability over time: five drones", "step", y_label, whole, (0, 1.03), bounds=SHARE)],
        note=note,
    )
    panels = [
        Panel(
            f"Data from {letter}", "step", y_label, [_curve(group, node) for group in groups], (0, 1.03), bounds=SHARE
        )
        for node, letter in LETTERS.items()
    ]
    yield draw(out / "reliability-by-drone.png", panels, columns=2, note=note)


def _series(groups: Sequence[Group]) -> Iterator[list[object]]:
    """Of all data, and of each drone's."""
    for group in groups:
        origins = {"all": [reliability(run.series) for run in group.runs]}
        origins |= {letter: [of_origin(run, node) for run in group.runs] for node, letter in LETTERS.items()}
        for name, rows in origins.items():
            for step, shares in zip(group.runs[0].series.step, zip(*rows, strict=True), strict=True):
                yield [group.case["policy"], name, step, *figures_of(estimate_share(shares))]


def _curve(group: Group, node: int) -> Curve:
    rows = [of_origin(run, node) for run in group.runs]
    return mean_curve(policy_style(group.case["policy"]), group.runs[0].series.step, rows)


def _gaps(groups: Sequence[Group]) -> list[str]:
    """How far RASS is above the others in the same runs, whole and for C's data."""
    policies = {group.case["policy"]: group.runs for group in groups}
    rass = policies.pop("rass", [])
    if not rass or not policies:
        return []
    lines = [
        [
            policy_style(name).label,
            cell(_gap(rass, other, kept), 3),
            cell(_gap(rass, other, partial(_at_the_end, 3)), 3),
        ]
        for name, other in policies.items()
    ]
    return [f"RASS is above by\n\n{markdown(['', 'all data', 'from C'], lines)}\n{PAIRED}"]


def _gap(rass: Sequence[Result], other: Sequence[Result], value: Callable[[Result], Share]) -> Estimate | None:
    others = {result.seed: value(result).value for result in other}
    return estimate_difference([value(result).value - others[result.seed] for result in rass if result.seed in others])
