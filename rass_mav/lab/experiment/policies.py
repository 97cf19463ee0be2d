"""Comparison of all policies, with and without replicas and immediate forwarding: what safety costs.

All run in the world `paper` with the same seeds: the same places, motion, sources, noise and failures. So they are
compared run by run. The ceiling is what an oracle would keep with one copy (`oracle`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rass_mav.errors import ConfigError
from rass_mav.lab.experiment.columns import (
    LOOPS,
    LOST_BY_REASON,
    MEMORY,
    RELIABILITY,
    STANDARD,
    TRANSMISSIONS,
    Group,
    delivered,
    difference,
    kept,
    losses,
    mean,
    number,
    ratio,
    ratio_of_means,
    transmissions,
)
from rass_mav.lab.experiment.curves import distance_panel, write_distances
from rass_mav.lab.experiment.declaration import (
    HAND_ON,
    POLICIES,
    TOPOLOGIES,
    Case,
    Experiment,
    Factor,
    Level,
    by_policy,
    by_topology,
    counted_runs,
    split,
)
from rass_mav.lab.experiment.figures import (
    LEVEL,
    SHARE,
    Panel,
    Point,
    Scatter,
    Style,
    around,
    draw,
    draw_scatter,
    policy_style,
)
from rass_mav.lab.experiment.runner import Result, Run

PLACES = {
    **{name: Level(title) for name, title in TOPOLOGIES.items()},
    "islands": Level(
        "islands",
        # When and how far they move is the scenario's: --set may change it.
        {"topology": "islands", "data.interval_steps": 40},
        "paper-grid",
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
    policies: tuple[str, ...] = HAND_ON
    """Which policies have it."""


#: What the paper's worlds lack in all variants.
_SIMPLER = ["measured-retries", "contacts"]
#: By the name that `--variant` takes.
VARIANTS = {
    "plain": Variant(Look("one copy, one hop a step", "o"), policies=POLICIES),
    "immediate": Variant(Look("one copy, immediate", "s"), {"node.forward": "immediate"}),
    "mirror": Variant(
        Look("replica until passed on, one hop a step", "^"),
        {"custody.replicas": True},
    ),
    "mirror-immediate": Variant(
        Look("replica until receipt, immediate", "D"),
        {
            "custody.replicas": True, "without": [*_SIMPLER, "overhearing", "queue-toll"], "node.forward": "immediate",
        },
    ),
    "defaults": Variant(
        Look("the defaults: overheard copies, queues count", "*"),
        {
            "custody.replicas": True, "without": _SIMPLER, "node.forward": "immediate",
        },
    ),
}  # fmt: skip
#: Stigmergy has no variants: new data are broadcast once, and kept by all nodes with space.
EVERYWHERE = Look("copies everywhere", "X")

#: Policy and variant that the others are compared with.
REFERENCE = {"policy": "rass", "variant": "plain"}
#: `Run.world` of runs without and with failures.
WORLD, FAILING = "paper", "paper-failures"


def _kept_by(oracle: str) -> Callable[[Result], float | None]:
    """The share of all data that an oracle keeps, 0..1; None if no data are due, or nobody asked it."""

    def found(result: Result) -> float | None:
        counts = result.extra.get(oracle)
        return counts["kept"] / counts["data"] if counts and counts["data"] else None

    return found


def _share_of_ceiling(group: Group) -> float | None:
    of = _kept_by("ceiling")
    return ratio_of_means([(kept(run).value, found) for run in group.runs if (found := of(run)) is not None])


GAIN = difference("over_reference", "Over the reference", kept, shown=3)
LOSS_RATIO = ratio("losses_in_references", "Losses, x reference", losses)
#: What the oracle would keep.
CEILING = mean("ceiling", "", _kept_by("ceiling"))
#: Reliability relative to it. With replicas or immediate forwarding it may be above 1.
CEILING_SHARE = number("share_of_ceiling", "Share of the ceiling", _share_of_ceiling)
#: What an oracle with all contacts would keep.
BOUND = mean("bound", "", _kept_by("contacts"), digits=6)
TRANSMISSION_RATIO = ratio("transmissions_in_references", "Sent, x reference", transmissions)


def experiment(failures: float | None = None) -> Experiment:
    """Its declaration. `failures`: the share 0..1 of the drones that die in the same runs once more; None: no more
    runs."""
    worlds = {WORLD: Level(WORLD)}
    if failures is not None:
        worlds[FAILING] = Level(FAILING, {"failures.die_fraction": failures})
    variants = {name: Level(variant.look.title, variant.keys) for name, variant in VARIANTS.items()}
    return Experiment(
        title="Policies, world paper",
        factors=[
            Factor("world", "World", worlds),
            by_topology(PLACES),
            replace(by_policy(POLICIES), heading="Policy"),
            Factor("variant", "Variant", variants, "--variant", show=lambda case: _look(case).title),
        ],
        columns=[
            *STANDARD,
            GAIN,
            difference("delivered_over_reference", "", delivered, shown=3),
            LOSS_RATIO,
            CEILING,
            CEILING_SHARE,
            BOUND,
            TRANSMISSION_RATIO,
            MEMORY,
            # Of a datum that has not arrived.
            mean("copies", "", lambda run: float(run.summary["copies_mean"])),
            replace(LOOPS, heading="Loops"),
            *LOST_BY_REASON,
        ],
        scenario="paper-{topology}",
        world="{world}",
        variant="{variant}",
        measures=lambda case: ("ceiling", "contacts"),
        includes=lambda case: case["policy"] in VARIANTS[case["variant"]].policies,
        if_empty="the policy stigmergy has the variant plain only",
        check=_check,
        reference=REFERENCE,
        intro=(
            "{runs} of {steps} steps. "
            f"The reference is {policy_style(REFERENCE['policy']).label}, {_look(REFERENCE).title}, in the same runs.\n"
            "Ceiling: what an oracle keeps that knows everything beforehand, with one copy and one hop a step. It is\n"
            "no bound for the other variants. An oracle with all contacts is one: it copies each datum to all nodes\n"
            "that it can reach over any number of hops, in each step.\n"
        ),
        sections=("world", "topology"),
        section_title=_title,
        section_notes=_ceilings,
        files=_files,
    )


def _check(run: Run) -> None:
    if run.scenario.radiation.rule != "probability":
        raise ConfigError("radiation.rule: expected probability, the oracle knows no other")


# -- tables ------------------------------------------------------------------------------------------------------------


def _title(groups: Sequence[Group]) -> str:
    case, summary = groups[0].case, groups[0].runs[0].summary
    title = PLACES[case["topology"]].title
    if case["world"] != FAILING:
        return title
    died = summary.get("failures", {}).get("died", 0)
    return f"{title}, {died} of {summary['nodes'] - summary['bases']} drones die"


def _ceilings(groups: Sequence[Group]) -> list[str]:
    """They do not depend on who runs."""
    ceiling, bound = groups[0].estimate(CEILING), groups[0].estimate(BOUND)
    return [
        *([] if ceiling is None else [f"Ceiling: {ceiling.text(3)}\n"]),
        *([] if bound is None else [f"With all contacts: {bound.text(5)}\n"]),
    ]


def _look(case: Case) -> Look:
    return EVERYWHERE if case["policy"] == "stigmergy" else VARIANTS[case["variant"]].look


# -- figures -----------------------------------------------------------------------------------------------------------


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """delay-by-distance.csv and each topology's figures."""
    yield write_distances(out / "delay-by-distance.csv", groups)
    for (topology,), here in split(groups, "topology").items():
        yield _draw_costs(out / f"reliability-by-transmissions-{topology}.png", here)
        for (world,), found in split(here, "world").items():
            panels = _delays(found)
            if panels:
                path = out / f"delay-by-distance-{topology}{'-failures' if world == FAILING else ''}.png"
                note = f"each point: mean over the means of {counted_runs(groups, 'band')}"
                yield draw(path, panels, columns=min(2, len(panels)), note=note)


def _draw_costs(path: Path, groups: Sequence[Group]) -> Path:
    """Reliability against data sent: a panel a world."""
    # Stigmergy keeps a fiftieth of the data: it would squeeze all others into a corner.
    framing = [group for group in groups if group.case["policy"] != "stigmergy"] or groups
    ranges = around([*map(_point, framing)])
    panels = []
    for here in split(groups, "world").values():
        ceiling = here[0].estimate(CEILING)
        panels.append(
            Scatter(
                f"What safety costs: {_title(here)}", "data and copies sent per datum created",
                "reliability (1 - lost / created)", [*map(_point, here)], *ranges, SHARE,
                None if ceiling is None else ceiling.mean,
            )
        )  # fmt: skip
    looks = dict.fromkeys(_look(group.case) for group in groups)
    keys = [replace(policy_style(policy), marker="-") for (policy,) in split(groups, "policy")]
    keys += [Style(look.title, LEVEL.color, look.marker) for look in looks]
    keys.append(replace(LEVEL, label="ceiling: an oracle with one copy,\none hop a step"))
    note = (
        f"mean of {counted_runs(groups, 'error bars')}; in brackets: points outside the axes\n"
        "the ceiling bounds one copy with one hop a step; replicas and immediate forwarding can be above it"
    )
    return draw_scatter(path, panels, keys, note=note)


def _point(group: Group) -> Point:
    style = replace(policy_style(group.case["policy"]), marker=_look(group.case).marker)
    return Point(style, group.certain(TRANSMISSIONS), group.certain(RELIABILITY))


def _delays(groups: Sequence[Group]) -> list[Panel]:
    """Delay by distance: a panel a variant, a line a policy."""
    panels = []
    for name, variant in VARIANTS.items():
        lines = [
            (policy_style(group.case["policy"]), group.runs)
            for group in groups
            if group.case["variant"] == name and group.case["policy"] != "stigmergy"
        ]
        if lines:
            panels.append(distance_panel(f"{_title(groups)}: {variant.look.title}", lines))
    return panels
