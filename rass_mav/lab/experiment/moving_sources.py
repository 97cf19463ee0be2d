"""What becomes of data when the sources of radiation move: fitness is a step old, and a safe place does not stay
safe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rass_mav.lab.experiment.curves import by_policy, mean_curve, over_time, reliability
from rass_mav.lab.experiment.figures import SHARE, Panel, draw, policy_style
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, kept, standard
from rass_mav.lab.experiment.statistics import Share, counted
from rass_mav.lab.experiment.tables import markdown, write_csv, write_runs, write_text
from rass_mav.policy.settings import kinds

POLICIES = ("rass", "hop-count", "rass-literal")
ALL_POLICIES = tuple(kinds())
TABLE_COLUMNS = ("drift_m", "policy", "runs", "steps", *COLUMNS)
_Y_LABEL = "reliability (1 - lost / created)"


def plan(extent: Extent, drifts: Sequence[float], topology: str, policies: Sequence[str]) -> list[Run]:
    """The runs in the world `paper`, each source moving `drift` metres a step. Raises `ConfigError`."""
    planned = []
    for drift in sorted(drifts):
        variant, keys = f"drift-{drift:g}", {"radiation.drift": drift}
        planned += extent.plan("moving-sources", f"paper-{topology}", policies, variant=variant, keys=keys)
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and two figures; returns their paths."""
    drifts = {result.variant: float(result.variant.removeprefix("drift-")) for result in results}
    groups = {variant: by_policy(r for r in results if r.variant == variant) for variant in drifts}
    rows: list[list[object]] = []
    cells: list[list[str]] = []
    lines: dict[str, list[tuple[float, list[Share]]]] = {}
    for variant, policies in groups.items():
        for policy, group in policies.items():
            found = standard(group)
            drift = drifts[variant]
            rows.append([drift, policy, found.runs, found.steps, *found.columns()])
            cells.append([f"{drift:g}", policy_style(policy).label, *found.cells()])
            lines.setdefault(policy, []).append((drift, [kept(result) for result in group]))
    some = results[0]
    runs = len(next(iter(next(iter(groups.values())).values())))
    note = f"mean of {counted(runs, 'band')}"
    text = (
        f"# Moving sources: {some.topology}, world paper\n\n"
        f"{counted(runs)} of {some.steps} steps. Each source does a random walk of so many metres a step.\n\n{NOTE}\n"
        + markdown(["Drift, m a step", "Algorithm", *HEADINGS], cells)
    )
    against_drift = []
    for policy, points in lines.items():
        style = policy_style(policy)
        x, columns = zip(*points, strict=True)
        against_drift.append(mean_curve(style.label, style.color, style.marker, x, list(zip(*columns, strict=True))))
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", text),
        draw(
            out / "reliability-by-drift.png",
            [Panel(f"Moving sources: {some.topology}", "drift of each source (m a step)", _Y_LABEL, against_drift,
                   bounds=SHARE)],
            note=note,
        ),
        draw(
            out / "reliability.png",
            [
                Panel(
                    f"Drift {drifts[variant]:g} m a step", "step", _Y_LABEL,
                    [over_time(group, reliability) for group in policies.values()], (0, 1.03), bounds=SHARE,
                )
                for variant, policies in groups.items()
            ],
            columns=min(2, len(groups)), note=note,
        ),
    ]  # fmt: skip
