"""Attackers beside honest nodes: what arrives all the same, what is lost, who notices.

A grid of 25 nodes; one attacker beside the node in its middle, from step `ATTACK` to the end. It meets nodes without
keys, nodes with keys as a stranger, and nodes with keys as a captured drone: with the link key, and keys of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rass_mav.experiment.figures import SHARE, Bars, draw_bars
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
POLICIES = tuple(name for name in kinds() if not PolicySettings(name=name).make().replicates)
#: The node that the attacker is beside.
NEAR = 12
#: The attacker comes in this step.
ATTACK = 50
#: Whether nodes have keys, and whether the attacker is a captured drone.
VARIANTS = {"open": (False, False), "signed": (True, False), "captured": (True, True)}
_TITLES = {
    "open": "No keys",
    "signed": "Links signed, a stranger attacks",
    "captured": "Links signed, a captured drone attacks",
}
_COLORS = {"open": "#999999", "signed": "#0072b2", "captured": "#d55e00"}
TABLE_COLUMNS = (
    "attacker", "policy", "variant", "runs", "steps", *COLUMNS, *triple("unfounded"), *triple("false_delivered"),
)  # fmt: skip


def plan(extent: Extent, attackers: Sequence[str], policies: Sequence[str], variants: Sequence[str]) -> list[Run]:
    """The runs of each attacker under each policy, with and without keys. Raises `ConfigError`."""
    planned = []
    for attacker in attackers:
        for variant in variants:
            keys, captured = VARIANTS[variant]
            lies = [{"kind": attacker, "near": NEAR, "begin": ATTACK, "captured": captured}]
            differences = {"keys": keys, "hostile": [] if attacker == NOBODY else lies}
            planned += extent.plan(attacker, SCENARIO, policies, variant=variant, keys=differences)
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and a figure a policy; returns their paths."""
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
        cells = [cell(figure, digits) for figure, digits in zip(own, (3, 1), strict=True)]
        alarms = ", ".join(_alarms(found)) or "-"
        lines.setdefault(variant, []).append([attacker, policy, *all_runs.cells(), *cells, alarms])
    first = next(iter(groups.values()))
    text = [
        "# Attackers\n",
        f"{counted(len(first))} of {first[0].steps} steps. 25 nodes, one attacker in the middle from step {ATTACK}.\n"
        "Unfounded: the share of the data created that were deleted because of a message that no base can confirm.\n"
        "False: data that no node created, and that a base accepted. Alarms: raised by any node in any run.\n",
        NOTE,
    ]
    for variant, found_lines in lines.items():
        text.append(f"## {_TITLES[variant]}\n")
        text.append(markdown(["Attacker", "Policy", *HEADINGS, "Unfounded", "False", "Alarms"], found_lines))
    policies = list(dict.fromkeys(policy for _, policy, _ in groups))
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", "\n".join(text)),
        *(_draw(out / f"arrived-{policy}.png", policy, arrived, len(first)) for policy in policies),
    ]


def _figures(found: Sequence[Result]) -> list[Estimate | None]:
    """The share that is unfounded; how many false data a base accepted."""

    def unfounded(result: Result) -> int:
        return int(result.summary["lost"].get("unfounded", 0))

    return [
        estimate_share([share_of_created(result, unfounded(result)) for result in found]),
        summary_estimate(found, lambda result: result.summary.get("hostile", {}).get("false_delivered", 0)),
    ]


def _alarms(found: Sequence[Result]) -> list[str]:
    """Which alarms were raised in any run."""
    alarms = [result.summary.get("hostile", {}).get("alarms", {}) for result in found]
    return sorted({name for counts in alarms for name, count in counts.items() if count})


def _draw(path: Path, policy: str, arrived: dict[tuple[str, str, str], Estimate], runs: int) -> Path:
    of_policy = {(attacker, variant): value for (attacker, of, variant), value in arrived.items() if of == policy}
    attackers = list(dict.fromkeys(attacker for attacker, _ in of_policy))
    bars = [
        Bars(_TITLES[variant], _COLORS[variant], [of_policy[attacker, variant] for attacker in attackers])
        for variant in dict.fromkeys(variant for _, variant in of_policy)
    ]
    return draw_bars(
        path, f"Data that arrive beside an attacker, under {policy}", "arrived / created", attackers, bars,
        bounds=SHARE, note=f"mean of {counted(runs, 'error bars')}",
    )  # fmt: skip
