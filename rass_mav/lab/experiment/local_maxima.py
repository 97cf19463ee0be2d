"""How many data are in basins: nodes that are fitter than all neighbours, and not next to the base.

Eq. 3 and 4 let data climb to the fittest neighbour. Behind a source a node may be fitter than all its neighbours, while
every route to the base leads through them: data stay there until readings change.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rass_mav.lab.experiment.curves import by_policy
from rass_mav.lab.experiment.figures import Bars, draw_bars, policy_style
from rass_mav.lab.experiment.paper import TOPOLOGY_TITLES
from rass_mav.lab.experiment.runs import Extent, Result, Run
from rass_mav.lab.experiment.standard import COLUMNS, HEADINGS, NOTE, standard
from rass_mav.lab.experiment.statistics import Estimate, counted, estimate
from rass_mav.lab.experiment.tables import figures_of, markdown, triple, write_csv, write_runs, write_text

#: The policies that follow a fitness.
POLICIES = ("rass", "hop-count", "rass-literal")
#: The reported shares: column, heading, and the two sums of `Basins` whose ratio it is.
SHARES = (
    ("nodes_in_basins", "nodes that are basins", "basins", "node_steps"),
    ("nodes_lasting", "nodes that are basins without noise", "lasting", "node_steps"),
    ("stored_in_basins", "stored data in basins", "stored_in_basins", "stored"),
    ("stored_in_lasting", "in those without noise", "stored_in_lasting", "stored"),
    ("corrupted_in_basins", "corrupted data lost in basins", "corrupted_in_basins", "corrupted"),
    ("corrupted_in_lasting", "in those without noise", "corrupted_in_lasting", "corrupted"),
)
TABLE_COLUMNS = (
    "topology", "policy", "runs", "steps", *COLUMNS, *(part for column, *_ in SHARES for part in triple(column)),
)  # fmt: skip


def plan(extent: Extent, topologies: Sequence[str], policies: Sequence[str]) -> list[Run]:
    """The runs in the world `paper`. Raises `ConfigError`."""
    return [
        run
        for topology in topologies
        for run in extent.plan("local-maxima", f"paper-{topology}", policies, measures=("basins",))
    ]


def share(results: Sequence[Result], part: str, whole: str) -> Estimate | None:
    """Mean over runs of a share 0..1, of the runs in which the whole is not 0."""
    counts = [result.extra["basins"] for result in results]
    return estimate([c[part] / c[whole] for c in counts if c[whole]])


def report(results: Sequence[Result], out: Path) -> list[Path]:
    """Write runs.csv, table.csv, table.md and two figures; returns their paths."""
    topologies = list(dict.fromkeys(result.topology for result in results))
    groups = {topology: by_policy(r for r in results if r.topology == topology) for topology in topologies}
    rows: list[list[object]] = []
    cells: list[list[str]] = []
    for topology, policies in groups.items():
        for policy, group in policies.items():
            shares = [share(group, part, whole) for _, _, part, whole in SHARES]
            figures = (figure for found in shares for figure in figures_of(found))
            found = standard(group)
            rows.append([topology, policy, found.runs, found.steps, *found.columns(), *figures])
            cells.append(
                [
                    TOPOLOGY_TITLES.get(topology, topology), policy_style(policy).label, *map(_percent, shares),
                    *found.cells(),
                ]
            )  # fmt: skip
    runs = max(len(group) for policies in groups.values() for group in policies.values())
    text = (
        "# Local maxima, world paper\n\n"
        f"{counted(runs)} of {results[0].steps} steps; basins in percent. A basin: a node that knows a route to the\n"
        "base and has neighbours, none of them the base and none fitter by Eq. 4. Without noise: a basin by the true\n"
        f"risk, which the next reading does not end.\n\n{NOTE}\n"
        + markdown(["Topology", "Algorithm", *(heading for _, heading, *_ in SHARES), *HEADINGS], cells)
    )
    note = f"mean of {counted(runs, 'error bars')}; hatched: in nodes that are basins without noise"
    return [
        write_runs(out / "runs.csv", results),
        write_csv(out / "table.csv", TABLE_COLUMNS, rows),
        write_text(out / "table.md", text),
        _draw(out / "stored-in-basins.png", groups, "Stored data in basins", "share of stored data (%)",
              SHARES[2:4], note),
        _draw(out / "corrupted-in-basins.png", groups, "Corruption losses in basins", "share of corrupted data (%)",
              SHARES[4:6], note),
    ]  # fmt: skip


def _draw(
    path: Path,
    groups: dict[str, dict[str, list[Result]]],
    title: str,
    y_label: str,
    shares: Sequence[tuple[str, str, str, str]],
    note: str,
) -> Path:
    policies = list(dict.fromkeys(policy for group in groups.values() for policy in group))
    series = []
    for policy in policies:
        style = policy_style(policy)
        for (_, _, part, whole), hatch in zip(shares, ("", "///"), strict=True):
            found = [share(group.get(policy, []), part, whole) for group in groups.values()]
            series.append(
                Bars(
                    style.label if not hatch else "",
                    style.color,
                    [e and e.times(100) for e in found],
                    hatch,
                )
            )
    names = [TOPOLOGY_TITLES.get(topology, topology) for topology in groups]
    return draw_bars(path, f"{title} (world paper)", y_label, names, series, bounds=(0, 100), note=note)


def _percent(value: Estimate | None) -> str:
    return "n/a" if value is None else value.times(100).text(1)
