"""Attackers beside honest nodes: what arrives all the same, what is lost, who notices.

A grid of 25 nodes; one attacker in its middle or beside the base, from step `ATTACK` to the end or for a time. It meets
nodes without keys, nodes with keys as a stranger, and nodes with keys as a captured drone: with the link key, and keys
of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from rass_mav.lab.experiment.columns import DELIVERED, STANDARD, Column, Group, mean, number, share, share_of_created
from rass_mav.lab.experiment.declaration import HAND_ON, Case, Experiment, Factor, Level, counted_runs, split
from rass_mav.lab.experiment.figures import SHARE, Bars, draw_bars
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import Share
from rass_mav.lab.hostile.kinds import KINDS

#: For comparison: no attacker is present.
NOBODY = "nobody"
#: The node that the attacker is beside.
PLACES = {"middle": 12, "base": 0}
_WHERE = {"middle": "in the middle", "base": "beside the base"}
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


def experiment(leaves: int | None = None) -> Experiment:
    """Its declaration. `leaves`: the first step in which the attacker is gone; None: it stays."""
    return Experiment(
        title="Attackers",
        factors=[
            Factor("attacker", "Attacker", {name: Level(name) for name in (NOBODY, *KINDS)}, "--attacker"),
            Factor(
                "policy", "Policy", {name: Level(name, {"policy.name": name}) for name in HAND_ON}, "--policy",
                key="policy.name",
            ),
            Factor("variant", "Keys", {name: Level(title) for name, title in _TITLES.items()}),
            Factor("place", "Place", {name: Level(_WHERE[name]) for name in PLACES}, "--place"),
        ],
        columns=[*STANDARD, *_columns(leaves)],
        scenario="hostile",
        world="{attacker}",
        variant="{variant}-{place}",
        measures=lambda case: ("cohorts",),
        keys=partial(_keys, leaves),
        intro=_intro(leaves),
        sections=("variant", "place"),
        section_title=_title,
        files=_files,
    )  # fmt: skip


def _keys(leaves: int | None, case: Case, steps: int) -> dict[str, Any]:
    keys, captured = VARIANTS[case["variant"]]
    attacker = {
        "kind": case["attacker"], "near": PLACES[case["place"]], "begin": ATTACK, "end": leaves, "captured": captured,
    }  # fmt: skip
    return {"keys": keys, "hostile": [] if case["attacker"] == NOBODY else [attacker]}


def _intro(leaves: int | None) -> str:
    return (
        f"{{runs}} of {{steps}} steps. 25 nodes, one attacker from step {ATTACK} to "
        f"{'the end' if leaves is None else f'step {leaves}'}.\n"
        "Unfounded: the share of the data created that were deleted because of a message that no base can confirm.\n"
        "False: data that no node created, and that a base accepted. Late: data that had not arrived in the last step\n"
        "and are not lost. Refused: the drones' own measurements, for lack of space; they are among the lost ones.\n"
        "False losses: recorded by a base, of data that are not lost. Before, during, after: what arrived of the data\n"
        f"created before the attacker came, from then until {HEALED} steps after it had left, and later. Delay after:\n"
        "the mean of the last ones, in steps. Alarms: raised by any node in any run.\n"
    )


def _columns(leaves: int | None) -> list[Column]:
    """Those of this experiment alone."""
    healed = inf if leaves is None else leaves + HEALED
    return [
        share("unfounded", "Unfounded",
              lambda run: share_of_created(run, run.summary["lost"].get("unfounded", 0)), digits=4),
        _count("false_delivered", "False", lambda summary: summary.get("hostile", {}).get("false_delivered", 0)),
        _count("late", "Late", lambda summary: summary["held"]),
        _count("lost", "Lost", lambda summary: sum(summary["lost"].values())),
        _count("refused", "Refused", lambda summary: summary["lost"]["overflow"]),
        _count("false_losses", "False losses", lambda summary: summary.get("hostile", {}).get("false_losses", 0)),
        share("before", "Before", partial(_arrived, 0, ATTACK), digits=4),
        share("during", "During", partial(_arrived, ATTACK, healed), digits=4),
        share("after", "After", partial(_arrived, healed, inf), digits=4),
        mean("delay_after", "Delay after", partial(_delay, healed, inf)),
        number("", "Alarms", _alarms),
    ]  # fmt: skip


def _count(name: str, heading: str, of: Callable[[Mapping[str, Any]], int]) -> Column:
    return mean(name, heading, lambda run: of(run.summary), shown=1)


def _created(begin: float, end: float, run: Result) -> list[int]:
    """What became of the data created in these steps: created, arrived and the sum of delays."""
    cohorts = [cohort for step, cohort in run.extra["cohorts"].items() if begin <= int(step) < end]
    return [sum(column) for column in zip(*cohorts, strict=True)] or [0, 0, 0]


def _arrived(begin: float, end: float, run: Result) -> Share | None:
    created, arrived, _ = _created(begin, end, run)
    return Share(arrived, created) if created else None


def _delay(begin: float, end: float, run: Result) -> float | None:
    _, arrived, delays = _created(begin, end, run)
    return delays / arrived if arrived else None


def _alarms(group: Group) -> str:
    """Which were raised in any run."""
    alarms = [run.summary.get("hostile", {}).get("alarms", {}) for run in group.runs]
    return ", ".join(sorted({name for counts in alarms for name, count in counts.items() if count})) or "-"


def _title(groups: Sequence[Group]) -> str:
    case = groups[0].case
    return f"{_TITLES[case['variant']]}, {_WHERE[case['place']]}"


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """What arrives: a figure for each policy and place."""
    for (policy, place), here in split(groups, "policy", "place").items():
        bars = [
            Bars(_TITLES[variant], _COLORS[variant], [group.certain(DELIVERED) for group in found])
            for (variant,), found in split(here, "variant").items()
        ]
        attackers = [attacker for (attacker,) in split(here, "attacker")]
        yield draw_bars(
            out / f"arrived-{policy}-{place}.png", f"Data that arrive beside an attacker, under {policy}",
            "arrived / created", attackers, bars,
            bounds=SHARE, note=f"mean of {counted_runs(groups, 'error bars')}",
        )  # fmt: skip
