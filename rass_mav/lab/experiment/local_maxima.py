"""How many data are in basins: nodes that are fitter than all neighbours, and not next to the base.

Eq. 3 and 4 let data climb to the fittest neighbour. Behind a source a node may be fitter than all its neighbours, while
every route to the base leads through them: data stay there until readings change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median

from rass_mav.lab.experiment.columns import STANDARD, Column, Group, mean, number
from rass_mav.lab.experiment.declaration import TOPOLOGIES, Experiment, by_policy, by_topology, counted_runs, split
from rass_mav.lab.experiment.figures import Bars, draw_bars, policy_style
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import Estimate


def _ratio(part: str, whole: str) -> Callable[[Result], float | None]:
    """Of two sums of `Basins`; None if the whole is 0."""

    def found(result: Result) -> float | None:
        counts = result.extra["basins"]
        return counts[part] / counts[whole] if counts[whole] else None

    return found


#: Of what the shares are: two sums of `Basins`.
_PARTS = (
    ("basins", "node_steps"), ("lasting", "node_steps"), ("stored_in_basins", "stored"),
    ("stored_in_lasting", "stored"), ("corrupted_in_basins", "corrupted"), ("corrupted_in_lasting", "corrupted"),
)  # fmt: skip
_NAMES = (
    "nodes_in_basins", "nodes_lasting", "stored_in_basins", "stored_in_lasting", "corrupted_in_basins",
    "corrupted_in_lasting",
)  # fmt: skip
#: Shares 0..1, for CSV files.
SHARES = tuple(mean(name, "", _ratio(*parts)) for name, parts in zip(_NAMES, _PARTS, strict=True))
#: The same for people.
_HEADINGS = (
    "nodes that are basins", "nodes that are basins without noise", "stored data in basins", "in those without noise",
    "corrupted data lost in basins", "in those without noise",
)  # fmt: skip


def _percent(column: Column) -> Callable[[Group], Estimate | None]:
    def found(group: Group) -> Estimate | None:
        share = group.estimate(column)
        return share and share.times(100)

    return found


def _spread(heading: str, part: str, whole: str) -> Column:
    """Least, median and most of the single runs, in percent."""
    of = _ratio(part, whole)

    def found(group: Group) -> str | None:
        shares = [100 * share for run in group.runs if (share := of(run)) is not None]
        return ", ".join(f"{pick(shares):.1f}" for pick in (min, median, max)) if shares else None

    return number("", f"{heading}: least, median, most", found)


def experiment() -> Experiment:
    """Its declaration."""
    percent = [_spread(heading, part, whole) for heading, (part, whole) in zip(_HEADINGS, _PARTS, strict=True)]
    return Experiment(
        title="Local maxima, world paper",
        # The policies that follow a fitness.
        factors=[by_topology(), by_policy(("rass", "hop-count", "rass-literal"))],
        columns=[*percent, *STANDARD, *SHARES],
        scenario="paper-{topology}",
        world="local-maxima",
        measures=lambda case: ("basins",),
        intro=(
            "{runs} of {steps} steps; basins in percent. A basin: a node that knows a route to the\n"
            "base and has neighbours, none of them the base and none fitter by Eq. 4. Without noise: a basin by the\n"
            "true risk, which the next reading does not end.\n"
        ),
        files=_files,
    )


def _files(groups: Sequence[Group], out: Path) -> Iterator[Path]:
    """Bars of the stored data and of the corrupted data in basins."""
    for name, title, of, shares in (
        ("stored-in-basins", "Stored data in basins", "stored", SHARES[2:4]),
        ("corrupted-in-basins", "Corruption losses in basins", "corrupted", SHARES[4:]),
    ):
        yield _draw(out / f"{name}.png", groups, title, f"share of {of} data (%)", shares)


def _draw(path: Path, groups: Sequence[Group], title: str, y_label: str, shares: Sequence[Column]) -> Path:
    series = []
    for (policy,), found in split(groups, "policy").items():
        style = policy_style(policy)
        for share, hatch in zip(shares, ("", "///"), strict=True):
            heights = [_percent(share)(group) for group in found]
            series.append(Bars("" if hatch else style.label, style.color, heights, hatch))
    names = [TOPOLOGIES[topology] for (topology,) in split(groups, "topology")]
    note = f"mean of {counted_runs(groups, 'error bars')}; hatched: in nodes that are basins without noise"
    return draw_bars(path, f"{title} (world paper)", y_label, names, series, bounds=(0, 100), note=note)
