"""The paper's simulations: four topologies, three ways to store, two worlds. Its Table I and its figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rass_mav.errors import ConfigError
from rass_mav.lab.experiment import distances
from rass_mav.lab.experiment.curves import by_policy, memory_used, over_time, reliability, total_stored
from rass_mav.lab.experiment.figures import SHARE, Curve, Panel, draw, policy_style
from rass_mav.lab.experiment.published import TABLE_1, Published
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, standard, summary_estimate
from rass_mav.lab.experiment.statistics import counted
from rass_mav.lab.experiment.tables import cell, figures_of, markdown, triple, write_csv, write_runs, write_text
from rass_mav.lab.swarm.catalogue import shipped

WORLDS = ("paper", "reference")
TOPOLOGIES = ("grid", "scale-free", "lennard-jones", "random-walk")
#: The policies compared by default.
POLICIES = ("rass", "hop-count", "stigmergy")
#: The policies available. `rass-literal` is a reading of the text, so it runs in the world `paper` only.
ALL_POLICIES = (*POLICIES, "rass-literal")

TOPOLOGY_TITLES = {
    "grid": "grid",
    "scale-free": "scale-free",
    "lennard-jones": "Lennard-Jones",
    "random-walk": "random walk",
}
TABLE_COLUMNS = (
    "world", "topology", "policy", "runs", "steps", "delay_paper", "memory_paper", "reliability_authors",
    *triple("memory"), *COLUMNS,
)  # fmt: skip
DISTANCE_COLUMNS = ("world", "topology", "policy", *distances.COLUMNS)
#: Figures cut distributions off at a delay that at most this share of the data exceeds.
_TAIL = 0.02


def plan(extent: Extent, worlds: Sequence[str], topologies: Sequence[str], policies: Sequence[str]) -> list[Run]:
    """The runs of each combination. Raises `ConfigError`, also for a missing scenario."""
    known = shipped()
    planned = []
    for world in worlds:
        for topology in topologies:
            name = f"{world}-{topology}"
            if name not in known:
                raise ConfigError(f"world {world}: this version of rass-mav has no scenario {name}")
            planned += extent.plan(world, name, [p for p in policies if p != "rass-literal" or world == "paper"])
    if not planned:
        raise ConfigError("nothing to run: rass-literal belongs to the world paper")
    return planned


def report(results: Sequence[Result], out: Path, published: Published) -> list[Path]:
    """Write runs.csv, table1.csv, table1.md, delay-by-distance.csv and the figures; returns their paths."""
    groups: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for result in results:
        groups.setdefault((result.world, result.topology), {})
    for world, topology in groups:
        groups[world, topology] = by_policy(r for r in results if (r.world, r.topology) == (world, topology))
    files = [write_runs(out / "runs.csv", results), *_table_1(groups, out, published), _distances(groups, out)]
    for (world, topology), policies in groups.items():
        where = f"{world}-{topology}"
        title = f"{TOPOLOGY_TITLES.get(topology, topology)}, world {world}"
        runs = max(len(group) for group in policies.values())
        count = counted(runs, "band")
        authors = any((topology, policy) in published.curves for policy in policies)
        dashed = "; dashed: the authors' runs" if authors else ""
        note = f"solid: mean of {count}{dashed}"
        files += [
            draw(out / f"reliability-{where}.png", [_reliability(title, topology, policies, published)], note=note),
            draw(out / f"delays-{where}.png", [_delays(title, topology, policies, published)],
                 legend_columns=2,
                 note=f"solid: the data of {counted(runs)} together{dashed}; the longest {_TAIL:.0%} are cut off"),
            draw(out / f"stored-{where}.png", [_stored(title, topology, policies, published)], note=note),
            draw(
                out / f"delay-by-distance-{where}.png", [_delay_by_distance(title, policies)],
                note=f"each point: mean over the means of {count}",
            ),
        ]  # fmt: skip
    return files


# -- tables ------------------------------------------------------------------------------------------------------------


def _table_1(
    groups: dict[tuple[str, str], dict[str, list[Result]]], out: Path, published: Published
) -> tuple[Path, Path]:
    rows: list[list[object]] = []
    text: dict[str, list[list[str]]] = {}
    for (world, topology), policies in groups.items():
        for policy, results in policies.items():
            delay_paper, memory_paper = TABLE_1.get((topology, policy), (None, None))
            found = standard(results)
            memory = summary_estimate(results, memory_used)
            curve = published.curves.get((topology, policy))
            authors = None if curve is None else curve.reliability[-1]
            rows.append(
                [
                    world, topology, policy, found.runs, found.steps, delay_paper, memory_paper, authors,
                    *figures_of(memory), *found.columns(),
                ]
            )  # fmt: skip
            text.setdefault(world, []).append(
                [
                    TOPOLOGY_TITLES.get(topology, topology), policy_style(policy).label,
                    cell(delay_paper), cell(found.delay), cell(memory_paper), cell(memory),
                    cell(authors, 3), *found.cells(),
                ]
            )  # fmt: skip
    return write_csv(out / "table1.csv", TABLE_COLUMNS, rows), write_text(out / "table1.md", _table_text(text, groups))


def _table_text(rows: dict[str, list[list[str]]], groups: dict[tuple[str, str], dict[str, list[Result]]]) -> str:
    columns = [
        "Topology", "Algorithm", "Delay, paper", "Delay, ours", "Memory, paper", "Memory, ours",
        "Reliability, authors", *HEADINGS,
    ]  # fmt: skip
    parts = [
        "# Table I of the paper, beside ours\n",
        'The paper prints the mean delay as "transfer speed (hops)". Memory: items in a drone, mean over drones and\n'
        "steps, in percent of 50 items. Reliability: 1 - lost / created at the end; the paper has it in figures only,\n"
        "the numbers are those of the authors' logs.\n",
        NOTE,
    ]
    for world, lines in rows.items():
        some = next(results for (w, _), p in groups.items() if w == world for results in p.values())
        parts.append(f"## World {world}: {len(some)} runs of {some[0].steps} steps\n")
        parts.append(markdown(columns, lines))
    return "\n".join(parts)


def _distances(groups: dict[tuple[str, str], dict[str, list[Result]]], out: Path) -> Path:
    rows = [
        [world, topology, policy, *row]
        for (world, topology), policies in groups.items()
        for policy, results in policies.items()
        for row in distances.rows(results)
    ]
    return write_csv(out / "delay-by-distance.csv", DISTANCE_COLUMNS, rows)


# -- figures -----------------------------------------------------------------------------------------------------------


def _reliability(title: str, topology: str, policies: dict[str, list[Result]], published: Published) -> Panel:
    curves = [over_time(results, reliability) for results in policies.values()]
    for policy in policies:
        authors = published.curves.get((topology, policy))
        if authors is not None:
            style = policy_style(policy)
            curves.append(Curve(f"{style.label}, authors", authors.step, authors.reliability, style.color, line="--"))
    return Panel(
        f"Reliability over time: {title}", "step", "reliability (1 - lost / created)", curves, (0, 1.03), bounds=SHARE
    )


def _stored(title: str, topology: str, policies: dict[str, list[Result]], published: Published) -> Panel:
    curves = [over_time(results, total_stored) for results in policies.values()]
    for policy in policies:
        authors = published.curves.get((topology, policy))
        if authors is not None:
            style = policy_style(policy)
            total = [swarm + base for swarm, base in zip(authors.swarm, authors.base, strict=True)]
            curves.append(Curve(f"{style.label}, authors", authors.step, total, style.color, line="--"))
    return Panel(f"Total stored over time: {title}", "step", "items in all drones and at the base", curves)


def _delays(title: str, topology: str, policies: dict[str, list[Result]], published: Published) -> Panel:
    curves, last = [], 1
    for policy, results in policies.items():
        if policy == "stigmergy":
            continue
        counts: Counter[int] = Counter()
        for result in results:
            counts.update(result.delays)
        style = policy_style(policy)
        for delays, label, marker, line in (
            (counts, style.label, style.marker, "-"),
            (published.delays.get((topology, policy), {}), f"{style.label}, authors", "", "--"),
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


def _cut(delays: dict[int, int], total: int) -> int:
    """The delay that all but the longest `_TAIL` do not exceed."""
    seen = 0
    for delay in sorted(delays):
        seen += delays[delay]
        if seen >= (1 - _TAIL) * total:
            return delay
    return max(delays)


def _delay_by_distance(title: str, policies: dict[str, list[Result]]) -> Panel:
    groups = [(policy_style(policy), results) for policy, results in policies.items() if policy != "stigmergy"]
    return distances.panel(f"Mean delay by distance at creation: {title}", groups)
