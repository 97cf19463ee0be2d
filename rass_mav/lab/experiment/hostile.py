"""Attackers beside honest nodes: what arrives all the same, what is lost, who notices.

A grid of 25 nodes; one attacker in its middle or beside the base, from step `ATTACK` to the end or for a time. It meets
nodes without keys, nodes with keys as a stranger, and nodes with keys as a captured drone: with the link key, and keys
of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

from rass_mav.lab.experiment.figures import SHARE, Bars, draw_bars
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, share_of_created, standard, summary_estimate
from rass_mav.lab.experiment.statistics import Estimate, Share, counted, estimate, estimate_share
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.lab.hostile.kinds import KINDS
from rass_mav.policy.settings import PolicySettings, kinds

SCENARIO = "hostile"
#: For comparison: no attacker is present.
NOBODY = "nobody"
ATTACKERS = (NOBODY, *KINDS)
POLICIES = tuple(name for name in kinds() if not PolicySettings(name=name).make().replicates)
#: The node that the attacker is beside.
PLACES = {"middle": 12, "base": 0}
#: The attacker comes in this step.
ATTACK = 50
#: What is created so many steps after the attacker has left must not be affected: 60 s, which is more than 20 turns.
HEALED = 60
#: Whether nodes have keys, and whether the attacker is a captured drone.
VARIANTS = {"open": (False, False), "signed": (True, False), "captured": (True, True)}
_TITLES = {
    "open": "No keys",
    "signed": "Links signed, a stranger attacks",
    "captured": "Links signed, a captured drone attacks",
}
_COLORS = {"open": "#999999", "signed": "#0072b2", "captured": "#d55e00"}
#: The figures of this experiment alone: column, heading, digits.
_OWN = (
    ("unfounded", "Unfounded", 3), ("false_delivered", "False", 1), ("late", "Late", 1), ("lost", "Lost", 1),
    ("refused", "Refused", 1), ("false_losses", "False losses", 1), ("before", "Before", 3), ("during", "During", 3),
    ("after", "After", 3), ("delay_after", "Delay after", 2),
)  # fmt: skip
TABLE_COLUMNS = (
    "attacker", "policy", "variant", "place", "runs", "steps", *COLUMNS, *(c for own in _OWN for c in triple(own[0])),
)  # fmt: skip


def plan(
    extent: Extent, attackers: Sequence[str], policies: Sequence[str], places: Sequence[str], leaves: int | None
) -> list[Run]:
    """The runs of each attacker in each place under each policy, with and without keys. `leaves`: the first step in
    which it is gone; None: it stays. Raises `ConfigError`."""
    planned = []
    for attacker in attackers:
        for place in places:
            for variant, (keys, captured) in VARIANTS.items():
                lies = {"kind": attacker, "near": PLACES[place], "begin": ATTACK, "end": leaves, "captured": captured}
                differences = {"keys": keys, "hostile": [] if attacker == NOBODY else [lies]}
                planned += extent.plan(
                    attacker, SCENARIO, policies, variant=f"{variant}-{place}", keys=differences, measures=("cohorts",)
                )
    return planned


def report(results: Sequence[Result], out: Path, leaves: int | None) -> list[Path]:
    """Write runs.csv, table.csv, table.md and a figure for each policy and place; returns their paths."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.world, result.policy, result.variant), []).append(result)
    rows: list[list[object]] = []
    lines: dict[str, list[list[str]]] = {}
    arrived: dict[tuple[str, str, str], Estimate] = {}
    for what, found in groups.items():
        attacker, policy, variant = what
        all_runs, own = standard(found), _figures(found, leaves)
        arrived[what] = all_runs.delivered
        figures = (value for figure in own for value in figures_of(figure))
        rows.append(
            [attacker, policy, *variant.split("-"), all_runs.runs, all_runs.steps, *all_runs.columns(), *figures]
        )
        cells = [cell(figure, digits) for figure, (_, _, digits) in zip(own, _OWN, strict=True)]
        alarms = ", ".join(_alarms(found)) or "-"
        lines.setdefault(variant, []).append([attacker, policy, *all_runs.cells(), *cells, alarms])
    first = next(iter(groups.values()))
    text = [
        "# Attackers\n",
        f"{counted(len(first))} of {first[0].steps} steps. 25 nodes, one attacker from step {ATTACK} to "
        f"{'the end' if leaves is None else f'step {leaves}'}.\n"
        "Unfounded: the share of the data created that were deleted because of a message that no base can confirm.\n"
        "False: data that no node created, and that a base accepted. Late: data that had not arrived in the last step\n"
        "and are not lost. Refused: the drones' own measurements, for lack of space; they are among the lost ones.\n"
        "False losses: recorded by a base, of data that are not lost. Before, during, after: what arrived of the data\n"
        f"created before the attacker came, from then until {HEALED} steps after it had left, and later. Delay after:\n"
        "the mean of the last ones, in steps. Alarms: raised by any node in any run.\n",
        NOTE,
    ]
    for variant, found_lines in lines.items():
        text.append(f"## {_title(variant)}\n")
        headings = [heading for _, heading, _ in _OWN]
        text.append(markdown(["Attacker", "Policy", *HEADINGS, *headings, "Alarms"], found_lines))
    drawn = dict.fromkeys((policy, variant.split("-")[1]) for _, policy, variant in groups)
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", "\n".join(text)),
        *(_draw(out / f"arrived-{policy}-{place}.png", policy, place, arrived, len(first)) for policy, place in drawn),
    ]


def _title(variant: str) -> str:
    kind, place = variant.split("-")
    return f"{_TITLES[kind]}, {'beside the base' if place == 'base' else 'in the middle'}"


def _figures(found: Sequence[Result], leaves: int | None) -> list[Estimate | None]:
    """`_OWN`."""

    def of_summary(value: Callable[[dict[str, Any]], int]) -> Estimate | None:
        return summary_estimate(found, lambda result: value(result.summary))

    def created(begin: float, end: float) -> list[list[int]]:
        """What became of the data created in these steps: created, arrived and delays, in each run."""
        cohorts = [
            [cohort for step, cohort in result.extra["cohorts"].items() if begin <= int(step) < end] for result in found
        ]
        return [[sum(column) for column in zip(*some, strict=True)] or [0, 0, 0] for some in cohorts]

    healed = inf if leaves is None else leaves + HEALED
    periods = [created(0, ATTACK), created(ATTACK, healed), created(healed, inf)]
    return [
        estimate_share([share_of_created(result, result.summary["lost"].get("unfounded", 0)) for result in found]),
        of_summary(lambda summary: summary.get("hostile", {}).get("false_delivered", 0)),
        of_summary(lambda summary: summary["held"]),
        of_summary(lambda summary: sum(summary["lost"].values())),
        of_summary(lambda summary: summary["lost"]["overflow"]),
        of_summary(lambda summary: summary.get("hostile", {}).get("false_losses", 0)),
        *(estimate_share([Share(arrived, all) for all, arrived, _ in period if all]) if any(map(any, period)) else None
          for period in periods),
        estimate([delays / arrived for _, arrived, delays in periods[2] if arrived]),
    ]  # fmt: skip


def _alarms(found: Sequence[Result]) -> list[str]:
    """Which alarms were raised in any run."""
    alarms = [result.summary.get("hostile", {}).get("alarms", {}) for result in found]
    return sorted({name for counts in alarms for name, count in counts.items() if count})


def _draw(path: Path, policy: str, place: str, arrived: dict[tuple[str, str, str], Estimate], runs: int) -> Path:
    of_policy = {
        (attacker, variant.split("-")[0]): value
        for (attacker, of, variant), value in arrived.items()
        if of == policy and variant.endswith(place)
    }
    attackers = list(dict.fromkeys(attacker for attacker, _ in of_policy))
    bars = [
        Bars(_TITLES[variant], _COLORS[variant], [of_policy[attacker, variant] for attacker in attackers])
        for variant in dict.fromkeys(variant for _, variant in of_policy)
    ]
    return draw_bars(
        path, f"Data that arrive beside an attacker, under {policy}", "arrived / created", attackers, bars,
        bounds=SHARE, note=f"mean of {counted(runs, 'error bars')}",
    )  # fmt: skip
