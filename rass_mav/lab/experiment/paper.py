"""The paper's simulations: four topologies, three ways to store, two worlds. Its Table I and its figures."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from rass_mav.errors import ConfigError, why
from rass_mav.lab.experiment.columns import DELAY, MEMORY, STANDARD, Column, Group, number
from rass_mav.lab.experiment.curves import distance_panel, over_time, reliability, total_stored, write_distances
from rass_mav.lab.experiment.declaration import (
    TOPOLOGIES,
    Experiment,
    Factor,
    Level,
    by_policy,
    by_topology,
    counted_runs,
    split,
)
from rass_mav.lab.experiment.figures import SHARE, Curve, Panel, draw, policy_style

#: arXiv 2201.01349, section IV: delay in steps (the paper prints it as "transfer speed (hops)"; None: not applicable)
#: and memory used in percent.
TABLE_1: dict[tuple[str, str], tuple[float | None, float]] = {
    ("grid", "rass"): (11.45, 1.35),
    ("grid", "hop-count"): (9.11, 0.61),
    ("grid", "stigmergy"): (None, 100.0),
    ("scale-free", "rass"): (11.44, 1.95),
    ("scale-free", "hop-count"): (6.85, 0.50),
    ("scale-free", "stigmergy"): (None, 100.0),
    ("lennard-jones", "rass"): (12.51, 1.69),
    ("lennard-jones", "hop-count"): (7.32, 0.51),
    ("lennard-jones", "stigmergy"): (None, 100.0),
    ("random-walk", "rass"): (12.68, 1.67),
    ("random-walk", "hop-count"): (7.76, 0.57),
    ("random-walk", "stigmergy"): (None, 100.0),
}


@dataclass
class AuthorsCurve:
    """Means over the authors' 30 runs, one entry for each of `step`."""

    step: list[int] = field(default_factory=list)
    reliability: list[float] = field(default_factory=list)
    """1 - lost / created."""
    swarm: list[float] = field(default_factory=list)
    """Items in all stores except the base's."""
    base: list[float] = field(default_factory=list)
    """Distinct items at the base."""


@dataclass
class Published:
    """The authors' results (public repository MISTLab/RASS) by (topology, policy); empty if no files were given."""

    curves: dict[tuple[str, str], AuthorsCurve] = field(default_factory=dict)
    delays: dict[tuple[str, str], dict[int, int]] = field(default_factory=dict)
    """Delay in steps -> data that arrived after it, in all runs together."""


def default_directory() -> Path | None:
    """shared/data/paper beside a checkout, if it exists. The product does not ship the files."""
    path = Path(__file__).parents[4] / "shared" / "data" / "paper"
    return path if (path / "curves.csv").is_file() else None


def load_published(directory: Path | None) -> Published:
    """Read curves.csv and delays.csv. Raises `ConfigError` that names the file; None: nothing."""
    published = Published()
    if directory is None:
        return published
    path = directory / "curves.csv"
    for key, row in _rows(path, ("step", "reliability_mean", "swarm_stored_mean", "base_stored_mean")):
        curve = published.curves.setdefault(key, AuthorsCurve())
        curve.step.append(int(row[0]))
        curve.reliability.append(row[1])
        curve.swarm.append(row[2])
        curve.base.append(row[3])
    for key, row in _rows(directory / "delays.csv", ("delay_steps", "count")):
        published.delays.setdefault(key, {})[int(row[0])] = int(row[1])
    return published


def _rows(path: Path, columns: tuple[str, ...]) -> Iterator[tuple[tuple[str, str], list[float]]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                yield (row["topology"], row["policy"]), [float(row[column]) for column in columns]
    except OSError as error:
        raise ConfigError(f"--reference-data: {path}: {why(error)}") from None
    except (KeyError, TypeError, ValueError) as error:
        expected = ", ".join(("topology", "policy", *columns))
        raise ConfigError(f"--reference-data: {path}: expected the columns {expected} ({error})") from None


WORLDS = ("paper", "reference")
#: The policies compared by default.
POLICIES = ("rass", "hop-count", "stigmergy")
#: It is a reading of the text, so it runs in the world `paper` only.
LITERAL = "rass-literal"
#: Figures cut distributions off at a delay that at most this share of the data exceeds.
_TAIL = 0.02


def experiment(world: str = "both", reference_data: str | None = None) -> Experiment:
    """Its declaration. `world`: one of `WORLDS`, or both. `reference_data`: the folder with the authors' results; None:
    the usual one, if it exists. Raises `ConfigError`."""
    published = load_published(default_directory() if reference_data is None else Path(reference_data))
    worlds = WORLDS if world == "both" else (world,)
    return Experiment(
        title="Table I of the paper, beside ours",
        factors=[
            Factor("world", "World", {name: Level(name) for name in worlds}),
            by_topology(),
            by_policy((*POLICIES, LITERAL), POLICIES),
        ],
        columns=[
            number("delay_paper", "Delay, paper", lambda group: _printed(group)[0]),
            Column("", "Delay, ours", lambda group: group[DELAY]),
            number("memory_paper", "Memory, paper", lambda group: _printed(group)[1]),
            Column("", "Memory, ours", lambda group: group[MEMORY]),
            number("reliability_authors", "Reliability, authors", partial(_authors_reliability, published), shown=3),
            replace(MEMORY, heading=""),
            *STANDARD,
        ],
        scenario="{world}-{topology}",
        world="{world}",
        includes=lambda case: case["policy"] != LITERAL or case["world"] == "paper",
        if_empty="rass-literal belongs to the world paper",
        intro=(
            'The paper prints the mean delay as "transfer speed (hops)". Memory: items in a drone, mean over drones\n'
            "and steps, in percent of 50 items. Reliability: 1 - lost / created at the end; the paper has it in\n"
            "figures only, the numbers are those of the authors' logs.\n"
        ),
        sections=("world",),
        section_title=_title,
        table="table1",
        files=partial(_files, published),
    )


def _title(groups: Sequence[Group]) -> str:
    return f"World {groups[0].case['world']}: {counted_runs(groups)} of {groups[0].steps} steps"


def _where(group: Group) -> tuple[str, str]:
    """Topology and policy, as the authors' results are listed."""
    return group.case["topology"], group.case["policy"]


def _printed(group: Group) -> tuple[float | None, float | None]:
    """Delay and memory in the paper's table."""
    return TABLE_1.get(_where(group), (None, None))


def _authors_reliability(published: Published, group: Group) -> float | None:
    curve = published.curves.get(_where(group))
    return None if curve is None else curve.reliability[-1]


# -- figures -----------------------------------------------------------------------------------------------------------


def _files(published: Published, groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """delay-by-distance.csv and the figures of each topology."""
    yield write_distances(out / "delay-by-distance.csv", groups)
    for (world, topology), found in split(groups, "world", "topology").items():
        where = f"{world}-{topology}"
        title = f"{TOPOLOGIES[topology]}, world {world}"
        count = counted_runs(found, "band")
        dashed = "; dashed: the authors' runs" if any(_where(group) in published.curves for group in found) else ""
        note = f"solid: mean of {count}{dashed}"
        yield draw(out / f"reliability-{where}.png", [_reliability(title, found, published)], note=note)
        yield draw(
            out / f"delays-{where}.png", [_delays(title, found, published)], legend_columns=2,
            note=f"solid: the data of {counted_runs(found)} together{dashed}; the longest {_TAIL:.0%} are cut off",
        )  # fmt: skip
        yield draw(out / f"stored-{where}.png", [_stored(title, found, published)], note=note)
        yield draw(
            out / f"delay-by-distance-{where}.png", [_delay_by_distance(title, found)],
            note=f"each point: mean over the means of {count}",
        )  # fmt: skip


def _reliability(title: str, groups: Sequence[Group], published: Published) -> Panel:
    curves = [over_time(group.runs, reliability) for group in groups]
    curves += _authors(groups, published, lambda curve: curve.reliability)
    return Panel(
        f"Reliability over time: {title}", "step", "reliability (1 - lost / created)", curves, (0, 1.03), bounds=SHARE
    )


def _stored(title: str, groups: Sequence[Group], published: Published) -> Panel:
    curves = [over_time(group.runs, total_stored) for group in groups]
    curves += _authors(groups, published, lambda curve: [a + b for a, b in zip(curve.swarm, curve.base, strict=True)])
    return Panel(f"Total stored over time: {title}", "step", "items in all drones and at the base", curves)


def _authors(
    groups: Sequence[Group], published: Published, values: Callable[[AuthorsCurve], Sequence[float]]
) -> Iterator[Curve]:
    """The authors' curves of these policies, where there are any."""
    for group in groups:
        curve = published.curves.get(_where(group))
        if curve is not None:
            style = policy_style(group.case["policy"])
            yield Curve(f"{style.label}, authors", curve.step, values(curve), style.color, line="--")


def _delays(title: str, groups: Sequence[Group], published: Published) -> Panel:
    curves, last = [], 1
    for group in groups:
        if group.case["policy"] == "stigmergy":
            continue
        counts: Counter[int] = Counter()
        for run in group.runs:
            counts.update(run.delays)
        style = policy_style(group.case["policy"])
        for delays, label, marker, line in (
            (counts, style.label, style.marker, "-"),
            (published.delays.get(_where(group), {}), f"{style.label}, authors", "", "--"),
        ):
            total = sum(delays.values())
            if total:
                mean = sum(delay * count for delay, count in delays.items()) / total
                x = list(range(max(delays) + 1))
                y = [100 * delays.get(delay, 0) / total for delay in x]
                curves.append(Curve(f"{label} (mean {mean:.1f})", x, y, style.color, marker, line=line))
                last = max(last, _cut(delays, total))
    return Panel(
        f"Distribution of transfer delays: {title}", "delay from creation to arrival at the base (steps)",
        "share of the data that arrived (%)", curves, x_range=(0, last),
    )  # fmt: skip


def _cut(delays: Mapping[int, int], total: int) -> int:
    """The delay that all but the longest `_TAIL` do not exceed."""
    seen = 0
    for delay in sorted(delays):
        seen += delays[delay]
        if seen >= (1 - _TAIL) * total:
            return delay
    return max(delays)


def _delay_by_distance(title: str, groups: Sequence[Group]) -> Panel:
    lines = [(policy_style(g.case["policy"]), g.runs) for g in groups if g.case["policy"] != "stigmergy"]
    return distance_panel(f"Mean delay by distance at creation: {title}", lines)
