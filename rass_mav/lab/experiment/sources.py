"""How well sources are located from what has arrived, how often their regions cover them, and what is said where the
model does not hold."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from rass_mav.lab.experiment.columns import DELIVERED, Group, number
from rass_mav.lab.experiment.declaration import Case, Experiment, Factor, Level
from rass_mav.lab.experiment.located import matched
from rass_mav.lab.experiment.tables import markdown

#: Dose rates 1 m from a source, uSv/h.
STRENGTHS = {"weak": (1e2, 1e4), "strong": (1e5, 1e7)}
#: How far a source moves in a second in the world `moves`, metres.
DRIFT_M = 3.0
#: Points of a line, their distance in metres, and how many lines there are.
POINTS, PITCH_M, LINES = 15, 12.0, 61
#: The looks, and what they are called.
LOOKS = {"early": "60 s", "end": "whole flight"}


def lines(strength: tuple[float, float]) -> list[list[list[float]]]:
    """Line sources of 170 m, as sets of points."""
    rng = random.Random("lines")
    found = []
    for _ in range(LINES):
        angle, x, y = rng.uniform(0.0, math.pi), rng.uniform(-100.0, 100.0), rng.uniform(-100.0, 100.0)
        each = math.exp(rng.uniform(*map(math.log, strength))) / POINTS
        along = [(k - (POINTS - 1) / 2) * PITCH_M for k in range(POINTS)]
        found.append([[round(x + math.cos(angle) * a, 1), round(y + math.sin(angle) * a, 1), each] for a in along])
    return found


def _keys(case: Case, steps: int) -> Mapping[str, Any]:
    strength = STRENGTHS[case["strength"]]
    return {
        "radiation.strength": list(strength),
        "data.until_step": max(steps - 20, 1),
        **({"radiation.sets": lines(strength)} if case["world"] == "line" else {}),
    }


def experiment() -> Experiment:
    """Its declaration."""
    counts = {str(n): Level(str(n), {"radiation.random_sources": n}) for n in (1, 2, 3)}
    moves = Level("one that moves", {"radiation.random_sources": 1, "radiation.drift": DRIFT_M})
    return Experiment(
        title="Sources from what has arrived",
        factors=[
            Factor("world", "Sources", {**counts, "moves": moves, "line": Level("a line")}, "--world"),
            Factor("strength", "Strength", {name: Level(name) for name in STRENGTHS}, "--strength"),
            Factor(
                "dead", "Drones dead", {"0": Level("0"), "20": Level("20 %", {"failures.die_fraction": 0.2})}, "--dead"
            ),
        ],
        columns=[DELIVERED, number("readings", "Readings arrived", _readings, shown=0)],
        scenario="field-sources",
        world="sources",
        variant="{world}-{strength}-{dead}",
        keys=_keys,
        measures=lambda case: ("sources",),
        # Other worlds are there to see what is said, with all drones.
        includes=lambda case: case["world"].isdigit() or case["dead"] == "0",
        if_empty="worlds that do not fit the model have no dead drones",
        intro="{runs} of {steps} steps. Worlds that move or are a line do not fit the model.\n",
        after=_tables,
    )  # fmt: skip


def _readings(group: Group) -> float:
    return float(median(run.extra["sources"]["end"]["readings"] for run in group.runs))


def _tables(groups: Sequence[Group]) -> list[str]:
    """What was found in worlds that fit, by strength, sources and look, and in the others."""
    fits = [group for group in groups if group.case["world"].isdigit()]
    others = [group for group in groups if not group.case["world"].isdigit()]
    return [
        *(["## Worlds that fit the model\n", _NOTE, _fitting(fits)] if fits else []),
        *(["## Worlds that do not\n", _OTHER_NOTE, _misfitting(others)] if others else []),
    ]


_NOTE = (
    "Enough: sources with enough readings (documentation: how-to/sources). Not resolved: of these. Covered: regions\n"
    "with their source in them, of all that are resolved; one that belongs to no source counts as not covered. Naive:\n"
    "from the place of the highest reading to the nearest source.\n"
)
_OTHER_NOTE = (
    "False: a region that is resolved, and in which neither the source is at that time nor any point of the line.\n"
)


def _fitting(groups: Sequence[Group]) -> str:
    head = [
        "Look", "Strength", "Sources", "Dead, %", "Runs", "Enough", "Not resolved", "Error, m", "Covered", "Area, m²",
        "Naive, m", "Nothing fits",
    ]  # fmt: skip
    rows = []
    for look, title in LOOKS.items():
        for group in groups:
            case = group.case
            rows.append([title, case["strength"], case["world"], case["dead"], *_figures([group], look)])
        for strength in STRENGTHS:
            if some := [group for group in groups if group.case["strength"] == strength]:
                rows.append([title, strength, "all", "all", *_figures(some, look)])
    return markdown(head, rows)


def _figures(groups: Sequence[Group], look: str) -> list[str]:
    looks = [run.extra["sources"][look] for group in groups for run in group.runs]
    sources = sum(len(one["true"]) for one in looks)
    enough = sum(sum(one["enough"]) for one in looks)
    pairs = [(one, matched(one)) for one in looks]
    resolved = sum(one["enough"][k] for one, found in pairs for k, _, _ in found)
    regions = [found for one in looks for found in one["found"] if found["resolved"]]
    covered = sum(k in found["covers"] for _, some in pairs for k, found, _ in some)
    errors = [distance for _, some in pairs for _, _, distance in some]
    naive = [
        min(math.dist(one["naive"], true[:2]) for true in one["true"]) for one in looks if one["naive"] is not None
    ]
    return [
        str(len(looks)), f"{enough} of {sources}", _share(enough - resolved, enough), _middle(errors, 1),
        _share(covered, len(regions)), _middle([found["area_m2"] for found in regions], 0), _middle(naive, 1),
        str(sum(one["verdict"] == "no fit" for one in looks)),
    ]  # fmt: skip


def _misfitting(groups: Sequence[Group]) -> str:
    head = ["Look", "Strength", "World", "Runs", "No fit", "No source", "Resolved regions", "False", "Area, m²"]
    rows = []
    for look, title in LOOKS.items():
        for strength in STRENGTHS:
            for world in dict.fromkeys(group.case["world"] for group in groups):
                some = [g for g in groups if g.case["strength"] == strength and g.case["world"] == world]
                looks = [run.extra["sources"][look] for group in some for run in group.runs]
                if not looks:
                    continue
                regions = [found for one in looks for found in one["found"] if found["resolved"]]
                verdicts = [one["verdict"] for one in looks]
                rows.append(
                    [
                        title, strength, world, str(len(looks)), str(verdicts.count("no fit")),
                        str(verdicts.count("no source")), str(len(regions)),
                        str(sum(not found["covers"] for found in regions)),
                        _middle([found["area_m2"] for found in regions], 0),
                    ]
                )  # fmt: skip
    return markdown(head, rows)


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "none"


def _middle(values: Sequence[float], digits: int) -> str:
    return f"{median(values):.{digits}f}" if values else "-"
