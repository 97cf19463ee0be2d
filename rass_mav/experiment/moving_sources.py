"""What becomes of data when the sources of radiation move: fitness is a step old, and a safe place does not stay
safe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rass_mav.experiment.curves import (
    by_policy,
    final_reliability,
    mean_curve,
    mean_delay,
    over_time,
    reliability,
    summary_estimate,
)
from rass_mav.experiment.figures import SHARE, Panel, draw, policy_style
from rass_mav.experiment.runs import Extent, Result, Run
from rass_mav.experiment.statistics import counted
from rass_mav.experiment.tables import cell, figures_of, markdown, write_csv, write_runs, write_text
from rass_mav.policy.settings import kinds

POLICIES = ("rass", "hop-count", "rass-literal")
ALL_POLICIES = tuple(kinds())
TABLE_COLUMNS = (
    "drift_m", "policy", "runs", "steps", "reliability_mean", "reliability_ci95", "delay_mean", "delay_ci95",
)  # fmt: skip
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
    lines: dict[str, list[tuple[float, list[float]]]] = {}
    for variant, policies in groups.items():
        for policy, group in policies.items():
            kept = summary_estimate(group, final_reliability)
            delay = summary_estimate(group, mean_delay)
            drift = drifts[variant]
            rows.append([drift, policy, len(group), group[0].steps, *figures_of(kept), *figures_of(delay)])
            cells.append([f"{drift:g}", policy_style(policy).label, cell(kept, 3), cell(delay)])
            lines.setdefault(policy, []).append((drift, [final_reliability(result) for result in group]))
    some = results[0]
    runs = len(next(iter(next(iter(groups.values())).values())))
    note = f"mean of {counted(runs, 'band')}"
    text = (
        f"# Moving sources: {some.topology}, world paper\n\n"
        f"Mean of {runs} runs of {some.steps} steps ± half of the 95 % confidence interval (Student's t). Each source\n"
        "does a random walk of so many metres a step. Delay: steps, of data that arrived.\n\n"
        + markdown(["Drift, m a step", "Algorithm", "Reliability", "Delay"], cells)
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
