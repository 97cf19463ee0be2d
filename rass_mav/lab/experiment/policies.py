"""Comparison of all policies, with and without spare copies and immediate forwarding: what safety costs.

All run in the world `paper` with the same seeds: the same places, motion, sources, noise and failures. So they are
compared run by run. The ceiling is what an oracle would keep with one copy (`oracle`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError
from rass_mav.lab.experiment import distances
from rass_mav.lab.experiment.comparison import Comparison, compare
from rass_mav.lab.experiment.figures import LEVEL, SHARE, Panel, Point, Scatter, Style, draw, draw_scatter, policy_style
from rass_mav.lab.experiment.paper import TOPOLOGY_TITLES
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, PAIRED
from rass_mav.lab.experiment.statistics import Interval, counted
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.lab.swarm.ledger import LOST
from rass_mav.policy.settings import PolicySettings, kinds

POLICIES = tuple(kinds())
_HAND_ON = tuple(name for name in POLICIES if not PolicySettings(name=name).make().replicates)


@dataclass(frozen=True)
class Place:
    """Where the swarm is."""

    title: str
    scenario: str
    keys: dict[str, Any] = field(default_factory=dict)
    """Differences from the scenario."""


#: By the name that `--topology` takes.
PLACES = {
    **{name: Place(title, f"paper-{name}") for name, title in TOPOLOGY_TITLES.items()},
    "islands": Place(
        "islands",
        "paper-grid",
        {"topology": "islands", "mobility.split_step": 100, "mobility.gap_m": 2.0, "data.interval_steps": 40},
    ),
}


@dataclass(frozen=True)
class Look:
    """The name and the drawing style of a variant."""

    title: str
    marker: str


@dataclass(frozen=True)
class Variant:
    """How data are kept and handed over, whatever the policy."""

    look: Look
    keys: dict[str, Any] = field(default_factory=dict)
    """Differences from the scenarios, which have one copy, one hop a step and no receipts."""
    policies: tuple[str, ...] = _HAND_ON
    """Which policies have it."""


#: By the name that `--variant` takes.
VARIANTS = {
    "plain": Variant(Look("one copy, one hop a step", "o"), policies=POLICIES),
    "immediate": Variant(Look("one copy, immediate", "s"), {"node.forward": "immediate"}),
    "mirror": Variant(
        Look("mirror until passed on, one hop a step", "^"),
        {"custody.mirror": True, "custody.mirror_until": "passed-on"},
    ),
    "mirror-immediate": Variant(
        Look("mirror until receipt, immediate", "D"),
        {
            "custody.mirror": True, "custody.mirror_until": "receipt", "custody.receipts": True,
            "node.forward": "immediate",
        },
    ),
    "copies-auto": Variant(
        Look("mirror until receipt, immediate, copies auto", "P"),
        {
            "custody.mirror": True, "custody.mirror_until": "receipt", "custody.receipts": True,
            "custody.copies": "auto", "node.forward": "immediate",
        },
    ),
    "defaults": Variant(
        Look("the defaults: overheard copies, queues count", "*"),
        {
            "custody.mirror": True, "custody.mirror_until": "receipt", "custody.receipts": True,
            "custody.copies": "auto", "custody.overhear": True, "routing.queue_toll": True, "node.forward": "immediate",
        },
    ),
}  # fmt: skip
#: Stigmergy has no variants: new data are broadcast once, and kept by all nodes with space.
EVERYWHERE = Look("copies everywhere", "X")

#: Policy and variant that the others are compared with.
REFERENCE = ("rass", "plain")
#: `Run.world` of runs without and with failures.
WORLD, FAILING = "paper", "paper-failures"

_REASONS = tuple(fate.value for fate in LOST)
TABLE_COLUMNS = (
    "world", "topology", "policy", "variant", "runs", "steps", *COLUMNS, *triple("over_reference"),
    *triple("delivered_over_reference"), "losses_in_references", *triple("ceiling"), "share_of_ceiling",
    *triple("bound"),
    "transmissions_in_references", *triple("memory"), *triple("copies"), "loops",
    *(part for reason in _REASONS for part in triple(f"lost_{reason}")),
)  # fmt: skip
DISTANCE_COLUMNS = ("world", "topology", "policy", "variant", *distances.COLUMNS)

#: The runs of each world and topology, by policy and variant.
Groups = dict[tuple[str, str], dict[tuple[str, str], list[Result]]]
#: The figures reported for them.
Compared = dict[tuple[str, str], dict[tuple[str, str], Comparison]]


def plan(
    extent: Extent,
    topologies: Sequence[str],
    policies: Sequence[str],
    variants: Sequence[str],
    *,
    die_fraction: float | None = None,
) -> list[Run]:
    """The runs of each combination; with `die_fraction` (0..1) all of them once more, with failures.

    Raises `ConfigError`.
    """
    worlds: dict[str, dict[str, Any]] = {WORLD: {}}
    if die_fraction is not None:
        worlds[FAILING] = {"failures.die_fraction": die_fraction}
    planned = []
    for topology in topologies:
        place = PLACES[topology]
        for world, failures in worlds.items():
            for policy in policies:
                for name in variants:
                    variant = VARIANTS[name]
                    if policy not in variant.policies:
                        continue
                    keys = {**place.keys, **variant.keys, **failures}
                    planned += extent.plan(
                        world, place.scenario, [policy], variant=name, keys=keys, measures=("ceiling", "contacts")
                    )
                    scenario = planned[-1].scenario
                    if (scenario.topology, scenario.policy.name) != (topology, policy):
                        raise ConfigError("--set: topology and policy.name are chosen by --topology and --policy here")
                    if scenario.radiation.rule != "probability":
                        raise ConfigError("radiation.rule: expected probability, the oracle knows no other")
    if not planned:
        raise ConfigError("nothing to run: the policy stigmergy has the variant plain only")
    return planned


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md, delay-by-distance.csv and each topology's figures; returns their paths."""
    groups: Groups = {}
    for result in results:
        groups.setdefault((result.world, result.topology), {}).setdefault(
            (result.policy, result.variant), []
        ).append(result)  # fmt: skip
    compared = {
        where: {what: compare(found, here.get(REFERENCE, ())) for what, found in here.items()}
        for where, here in groups.items()
    }
    files = [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, _rows(compared)),
        write_text(out / "table.md", _text(groups, compared)),
        write_csv(
            out / "delay-by-distance.csv", DISTANCE_COLUMNS,
            ([*where, *what, *row] for where, here in groups.items() for what, found in here.items()
             for row in distances.rows(found)),
        ),
    ]  # fmt: skip
    for topology in dict.fromkeys(topology for _, topology in groups):
        files.append(_draw_costs(out / f"reliability-by-transmissions-{topology}.png", topology, groups, compared))
        for (world, where), here in groups.items():
            panels = _delays(_title(world, topology, here), here) if where == topology else []
            if panels:
                name = f"delay-by-distance-{topology}{'-failures' if world == FAILING else ''}.png"
                note = f"each point: mean over the means of {_count(results, 'band')}"
                files.append(draw(out / name, panels, columns=min(2, len(panels)), note=note))
    return files


# -- tables ------------------------------------------------------------------------------------------------------------


def _rows(compared: Compared) -> list[list[object]]:
    """`TABLE_COLUMNS`."""
    return [
        [
            *where, *what, c.standard.runs, c.standard.steps, *c.standard.columns(), *figures_of(c.gain, 6),
            *figures_of(c.delivered_gain, 6), _rounded(c.loss_ratio), *figures_of(c.ceiling),
            _rounded(c.ceiling_share), *figures_of(c.bound, 6), _rounded(c.transmission_ratio), *figures_of(c.memory),
            *figures_of(c.copies),
            c.loops,
            *(value for reason in _REASONS for value in figures_of(c.lost[reason], 6)),
        ]
        for where, here in compared.items()
        for what, c in here.items()
    ]  # fmt: skip


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _text(groups: Groups, compared: Compared) -> str:
    """A table for each topology and world."""
    some = next(iter(groups.values()))
    first = next(iter(some.values()))
    reference = f"{policy_style(REFERENCE[0]).label}, {_look(*REFERENCE).title}"
    columns = [
        "Policy", "Variant", *HEADINGS, "Over the reference", "Losses, x reference", "Share of the ceiling",
        "Sent, x reference", "Memory, %", "Loops",
    ]  # fmt: skip
    parts = [
        "# Policies, world paper\n",
        f"{counted(len(first))} of {first[0].steps} steps. The reference is {reference}, in the same runs.\n"
        "Ceiling: what an oracle keeps that knows everything beforehand, with one copy and one hop a step. It is no\n"
        "bound for the other variants. An oracle with all contacts is one: it copies each datum to all nodes that it\n"
        "can reach over any number of hops, in each step.\n",
        NOTE + PAIRED,
    ]
    for (world, topology), here in compared.items():
        what = next(iter(here))
        parts.append(f"## {_title(world, topology, groups[world, topology])}\n")
        highest = here[what].ceiling
        if highest is not None:
            parts.append(f"Ceiling: {highest.text(3)}\n")
        most = here[what].bound
        if most is not None:
            parts.append(f"With all contacts: {most.text(5)}\n")
        parts.append(markdown(columns, [_cells(*what, c) for what, c in here.items()]))
    return "\n".join(parts)


def _cells(policy: str, variant: str, c: Comparison) -> list[str]:
    return [
        policy_style(policy).label, _look(policy, variant).title, *c.standard.cells(),
        "reference" if (policy, variant) == REFERENCE else cell(c.gain, 3, sign="+"),
        cell(c.loss_ratio), cell(c.ceiling_share), cell(c.transmission_ratio), cell(c.memory), str(c.loops),
    ]  # fmt: skip


def _title(world: str, topology: str, here: dict[tuple[str, str], list[Result]]) -> str:
    title = PLACES[topology].title
    if world != FAILING:
        return title
    summary = next(iter(here.values()))[0].summary
    died = summary.get("failures", {}).get("died", 0)
    return f"{title}, {died} of {summary['nodes'] - summary['bases']} drones die"


def _count(results: Sequence[Result], interval: Interval) -> str:
    return counted(len({result.seed for result in results}), interval)


# -- figures -----------------------------------------------------------------------------------------------------------


def _draw_costs(path: Path, topology: str, groups: Groups, compared: Compared) -> Path:
    """Reliability against data sent: a panel a world."""
    here = {world: runs for (world, where), runs in compared.items() if where == topology}
    points = {world: {what: _point(what, c) for what, c in runs.items()} for world, runs in here.items()}
    # Stigmergy keeps a fiftieth of the data: it would squeeze all others into a corner.
    framing = [p for found in points.values() for (policy, _), p in found.items() if policy != "stigmergy"]
    framing = framing or [p for found in points.values() for p in found.values()]
    widest = max(point.x.reach[1] for point in framing)
    lowest = min(point.y.reach[0] for point in framing)
    panels = []
    for world, runs in here.items():
        ceiling = next(iter(runs.values())).ceiling
        panels.append(
            Scatter(
                f"What safety costs: {_title(world, topology, groups[world, topology])}",
                "data and copies sent per datum created", "reliability (1 - lost / created)",
                list(points[world].values()), (0.0, 1.08 * widest or 1.0),
                (max(0.0, math.floor(10 * lowest) / 10), 1.01), SHARE,
                None if ceiling is None else ceiling.mean,
            )
        )  # fmt: skip
    used = dict.fromkeys(what for runs in here.values() for what in runs)
    looks = dict.fromkeys(_look(policy, variant) for policy, variant in used)
    keys = [replace(policy_style(policy), marker="-") for policy in dict.fromkeys(policy for policy, _ in used)]
    keys += [Style(look.title, LEVEL.color, look.marker) for look in looks]
    keys.append(replace(LEVEL, label="ceiling: an oracle with one copy,\none hop a step"))
    some = next(iter(groups.values()))
    note = (
        f"mean of {_count(next(iter(some.values())), 'error bars')}; in brackets: points outside the axes\n"
        "the ceiling bounds one copy with one hop a step; spare copies and immediate forwarding can be above it"
    )
    return draw_scatter(path, panels, keys, note=note)


def _point(what: tuple[str, str], c: Comparison) -> Point:
    return Point(
        replace(policy_style(what[0]), marker=_look(*what).marker),
        c.standard.transmissions, c.standard.reliability,
    )  # fmt: skip


def _look(policy: str, variant: str) -> Look:
    return EVERYWHERE if policy == "stigmergy" else VARIANTS[variant].look


def _delays(title: str, here: dict[tuple[str, str], list[Result]]) -> list[Panel]:
    """Delay by distance: a panel a variant, a line a policy."""
    panels = []
    for name, variant in VARIANTS.items():
        lines = [
            (policy_style(policy), found)
            for (policy, used), found in here.items()
            if used == name and policy != "stigmergy"
        ]
        if lines:
            panels.append(distances.panel(f"{title}: {variant.look.title}", lines))
    return panels
