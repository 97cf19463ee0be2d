"""Attackers beside honest nodes: what arrives all the same, what is lost, what heals after they leave, who notices.

A grid of 25 nodes; one attacker beside the node in its middle, from step `ATTACK` [0] until [1]. No key is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rass_mav.experiment.figures import SHARE, Bars, draw_bars, policy_style
from rass_mav.experiment.measures import ATTACK, HEALING
from rass_mav.experiment.runs import Extent, Result, Run
from rass_mav.experiment.statistics import Estimate, counted, estimate
from rass_mav.experiment.tables import cell, figures_of, markdown, write_csv, write_runs, write_text
from rass_mav.policy.settings import PolicySettings, kinds
from rass_mav.swarm.hostile.kinds import KINDS

SCENARIO = "hostile"
#: For comparison: no attacker is present.
NOBODY = "nobody"
ATTACKERS = (NOBODY, *KINDS)
#: Whether nodes keep spare copies.
VARIANTS = {"mirrors": True, "one-copy": False}
POLICIES = tuple(name for name in kinds() if not PolicySettings(name=name).make().replicates)
#: The node that the attacker is beside.
NEAR = 12
TABLE_COLUMNS = (
    "attacker", "policy", "variant", "runs", "steps", "arrived_mean", "arrived_ci95", "lost_mean", "lost_ci95",
    "unfounded_mean", "unfounded_ci95", "late_mean", "late_ci95", "healed_mean", "healed_ci95", "noticed_mean",
    "noticed_ci95", "transmissions_mean", "transmissions_ci95",
)  # fmt: skip


def plan(extent: Extent, attackers: Sequence[str], policies: Sequence[str], variants: Sequence[str]) -> list[Run]:
    """The runs of each attacker under each policy, with and without spare copies. Raises `ConfigError`."""
    planned = []
    for attacker in attackers:
        lies = [{"kind": attacker, "near": NEAR, "begin": ATTACK[0], "end": ATTACK[1]}]
        for variant in variants:
            keys = {"custody.mirror": VARIANTS[variant], "hostile": [] if attacker == NOBODY else lies}
            planned += extent.plan(
                attacker, SCENARIO, policies, variant=variant, keys=keys, measures=("attack",)
            )  # fmt: skip
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and a figure a variant; returns their paths."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.world, result.policy, result.variant), []).append(result)
    rows: list[list[object]] = []
    lines: dict[str, list[list[str]]] = {}
    arrived: dict[tuple[str, str, str], Estimate] = {}
    for what, found in groups.items():
        attacker, policy, variant = what
        figures = _figures(found)
        arrived[what] = figures[0]
        rows.append([*what, len(found), found[0].steps, *(value for f in figures for value in figures_of(f))])
        cells = [cell(figure, digits) for figure, digits in zip(figures, (3, 3, 3, 3, 3, 1, 1), strict=True)]
        alarms = ", ".join(_alarms(found)) or "-"
        lines.setdefault(variant, []).append([attacker, policy_style(policy).label, *cells, alarms])
    first = next(iter(groups.values()))
    text = [
        "# Attackers\n",
        f"Mean of {len(first)} runs of {first[0].steps} steps ± half of the 95 % confidence interval (Student's t).\n"
        f"25 nodes, one attacker in the middle from step {ATTACK[0]} until {ATTACK[1]}, no keys.\n"
        "All but the last three columns are shares of the data created. Unfounded: deleted because of a message that\n"
        "no base can confirm. Late: created before the attacker left, and not arrived when it did. Healed: late data\n"
        f"that arrived within {HEALING} steps after. Noticed: nodes that raised an alarm.\n",
    ]
    for variant, found_lines in lines.items():
        text.append(f"## {_TITLES[variant]}\n")
        columns = [
            "Attacker", "Policy", "Arrived", "Lost", "Unfounded", "Late", "Healed", "Noticed by", "Sent per datum",
            "Alarms",
        ]  # fmt: skip
        text.append(markdown(columns, found_lines))
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", "\n".join(text)),
        *(_draw(out / f"arrived-{variant}.png", variant, arrived, len(first)) for variant in lines),
    ]


_TITLES = {"mirrors": "With spare copies", "one-copy": "One copy"}


def _figures(found: Sequence[Result]) -> list[Estimate]:
    """Arrived, lost, unfounded, late, healed; how many nodes noticed; sent per datum."""
    columns = []
    for result in found:
        summary, attack = result.summary, result.extra["attack"]
        created = summary["created"] or 1
        lost = summary["lost"]
        columns.append(
            (
                summary["delivered"] / created, sum(lost.values()) / created, lost.get("unfounded", 0) / created,
                attack["late"] / created, attack["healed"] / created, attack["noticed"],
                summary["transmissions_per_datum"],
            )
        )  # fmt: skip
    estimates = [estimate(column) for column in zip(*columns, strict=True)]
    return [e for e in estimates if e is not None]


def _alarms(found: Sequence[Result]) -> list[str]:
    """Which alarms were raised in any run."""
    return sorted({name for result in found for name in result.extra["attack"]["alarms"]})


def _draw(path: Path, variant: str, arrived: dict[tuple[str, str, str], Estimate], runs: int) -> Path:
    attackers = list(dict.fromkeys(attacker for attacker, _, _ in arrived))
    policies = list(dict.fromkeys(policy for _, policy, _ in arrived))
    bars = []
    for policy in policies:
        style = policy_style(policy)
        found = [arrived[attacker, policy, variant] for attacker in attackers]
        bars.append(Bars(style.label, style.color, found))
    return draw_bars(
        path, f"Data that arrive beside an attacker: {_TITLES[variant].lower()}", "arrived / created", attackers, bars,
        bounds=SHARE, note=f"mean of {counted(runs, 'error bars')}",
    )  # fmt: skip
