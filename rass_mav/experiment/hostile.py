"""Attackers beside honest nodes: what arrives all the same, what is lost, what heals after they leave, who notices.

A grid of 25 nodes; one attacker beside the node in its middle, from step `ATTACK` [0] until [1]. No key is used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rass_mav.experiment.figures import SHARE, Bars, draw_bars, policy_style
from rass_mav.experiment.measures import ATTACK, HEALING
from rass_mav.experiment.runs import Extent, Result, Run
from rass_mav.experiment.standard import COLUMNS, HEADINGS, NOTE, share_of_created, standard, summary_estimate
from rass_mav.experiment.statistics import Estimate, counted, estimate_share
from rass_mav.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
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
    "attacker", "policy", "variant", "runs", "steps", *COLUMNS, *triple("unfounded"), *triple("late"),
    *triple("healed"), *triple("noticed"),
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
        all_runs, own = standard(found), _figures(found)
        arrived[what] = all_runs.delivered
        figures = (value for figure in own for value in figures_of(figure))
        rows.append([*what, all_runs.runs, all_runs.steps, *all_runs.columns(), *figures])
        cells = [cell(figure, digits) for figure, digits in zip(own, (3, 3, 3, 1), strict=True)]
        alarms = ", ".join(_alarms(found)) or "-"
        lines.setdefault(variant, []).append([attacker, policy_style(policy).label, *all_runs.cells(), *cells, alarms])
    first = next(iter(groups.values()))
    text = [
        "# Attackers\n",
        f"{counted(len(first))} of {first[0].steps} steps. 25 nodes, one attacker in the middle from step {ATTACK[0]}\n"
        f"until {ATTACK[1]}, no keys. Unfounded, late and healed are shares of the data created. Unfounded: deleted\n"
        "because of a message that no base can confirm. Late: created before the attacker left, and not arrived\n"
        f"when it did. Healed: late data that arrived within {HEALING} steps after. Noticed by: nodes with an alarm.\n",
        NOTE,
    ]
    for variant, found_lines in lines.items():
        text.append(f"## {_TITLES[variant]}\n")
        columns = ["Attacker", "Policy", *HEADINGS, "Unfounded", "Late", "Healed", "Noticed by", "Alarms"]
        text.append(markdown(columns, found_lines))
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", "\n".join(text)),
        *(_draw(out / f"arrived-{variant}.png", variant, arrived, len(first)) for variant in lines),
    ]


_TITLES = {"mirrors": "With spare copies", "one-copy": "One copy"}


def _figures(found: Sequence[Result]) -> list[Estimate | None]:
    """Unfounded, late, healed; how many nodes noticed."""

    def share(part: Callable[[Result], int]) -> Estimate:
        return estimate_share([share_of_created(result, part(result)) for result in found])

    return [
        share(lambda result: result.summary["lost"].get("unfounded", 0)),
        share(lambda result: result.extra["attack"]["late"]),
        share(lambda result: result.extra["attack"]["healed"]),
        summary_estimate(found, lambda result: result.extra["attack"]["noticed"]),
    ]


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
