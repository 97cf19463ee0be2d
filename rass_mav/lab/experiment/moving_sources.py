"""What becomes of data when the sources of radiation move: fitness is a step old, and a safe place does not stay
safe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rass_mav.lab.experiment.columns import STANDARD, Group, kept
from rass_mav.lab.experiment.curves import mean_curve, over_time, reliability
from rass_mav.lab.experiment.declaration import (
    POLICIES,
    TOPOLOGIES,
    Experiment,
    Factor,
    Level,
    by_policy,
    choose,
    counted_runs,
    split,
)
from rass_mav.lab.experiment.figures import SHARE, Panel, draw, policy_style

_Y_LABEL = "reliability (1 - lost / created)"


def experiment(drift: Sequence[float] = (), topology: str = "grid") -> Experiment:
    """Its declaration. `drift`: how far each source moves in a step, metres. Raises `ConfigError`."""
    choose("--topology", [topology], TOPOLOGIES)
    drifts = {f"{metres:g}": Level(f"{metres:g}", {"radiation.drift": metres}) for metres in sorted(drift)}
    return Experiment(
        title=f"Moving sources: {topology}, world paper",
        factors=[
            Factor("drift_m", "Drift, m a step", drifts),
            by_policy(POLICIES, ("rass", "hop-count", "rass-literal")),
        ],
        columns=STANDARD,
        scenario=f"paper-{topology}",
        world="moving-sources",
        variant="drift-{drift_m}",
        intro="{runs} of {steps} steps. Each source does a random walk of so many metres a step.\n",
        files=_files,
    )


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """Reliability by drift, and over time."""
    note = f"mean of {counted_runs(groups, 'band')}"
    topology = groups[0].runs[0].topology
    curves = []
    for (policy,), found in split(groups, "policy").items():
        x = [float(group.case["drift_m"]) for group in found]
        rows = zip(*([kept(run) for run in group.runs] for group in found), strict=True)
        curves.append(mean_curve(policy_style(policy), x, list(rows)))
    panel = Panel(f"Moving sources: {topology}", "drift of each source (m a step)", _Y_LABEL, curves, bounds=SHARE)
    yield draw(out / "reliability-by-drift.png", [panel], note=note)
    panels = [
        Panel(
            f"Drift {drift} m a step", "step", _Y_LABEL, [over_time(group.runs, reliability) for group in found],
            (0, 1.03), bounds=SHARE,
        )
        for (drift,), found in split(groups, "drift_m").items()
    ]  # fmt: skip
    yield draw(out / "reliability.png", panels, columns=min(2, len(panels)), note=note)
