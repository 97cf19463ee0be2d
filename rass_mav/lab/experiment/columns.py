"""The columns of tables: each is declared once, for the CSV file, the Markdown table and the points of figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import TypeAlias

from rass_mav.core.datum import Fate
from rass_mav.lab.experiment.runner import Result
from rass_mav.lab.experiment.statistics import Estimate, Share, estimate, estimate_difference, estimate_share
from rass_mav.lab.experiment.tables import cell, figures_of, triple
from rass_mav.lab.ledger import LOST
from rass_mav.lab.swarm.statistics import percentile

#: What people need to know to read the standard columns.
NOTE = (
    "Means over runs with 95 % confidence intervals. Shares of data: after Korn and Graubard, which gives a bound\n"
    "where nothing is lost too. Others: Student's t. Least, median, most: of the single runs. Delay: steps from\n"
    "creation to arrival, within which 50 % and 95 % of the data came, of all that arrived in all runs. Sent: data\n"
    "and copies, per datum created.\n"
)
#: The same of differences between runs.
PAIRED = "Differences: run by run, of the same seeds; 95 % confidence interval by a paired bootstrap over seeds.\n"

#: What a cell shows; None: nothing to show.
Value: TypeAlias = "Estimate | float | str | None"


@dataclass(frozen=True, eq=False)
class Group:
    """The runs of one case, which differ in their seeds only: at least one."""

    case: Mapping[str, str]
    """The name of its level, by factor."""
    runs: Sequence[Result]
    reference: Sequence[Result] = ()
    """Runs of the same seeds to compare with, and so of the same world; may be empty."""
    _found: dict[Column, Value] = field(default_factory=dict, repr=False)

    def __getitem__(self, column: Column) -> Value:
        """What these runs have in a column."""
        if column not in self._found:
            self._found[column] = column.of(self)
        return self._found[column]

    def estimate(self, column: Column) -> Estimate | None:
        """The same of a column with intervals."""
        found = self[column]
        assert found is None or isinstance(found, Estimate), column.name
        return found

    def certain(self, column: Column) -> Estimate:
        """The same of a column that no runs lack."""
        found = self.estimate(column)
        assert found is not None, column.name
        return found

    @property
    def steps(self) -> int:
        """Of each run."""
        return self.runs[0].steps

    @property
    def pairs(self) -> list[tuple[Result, Result]]:
        """The runs that have a partner in the reference, with it."""
        others = {result.seed: result for result in self.reference}
        return [(result, others[result.seed]) for result in self.runs if result.seed in others]


@dataclass(frozen=True, eq=False)
class Column:
    """A figure of a group of runs, in a CSV file, a Markdown table or both."""

    name: str
    """In a CSV file; empty: not there."""
    heading: str
    """Of a Markdown table; empty: not there."""
    of: Callable[[Group], Value]
    digits: int = 4
    """After the point, in a CSV file."""
    shown: int = 2
    """The same in a Markdown table."""
    interval: bool = True
    """Whether it is an `Estimate`, which has three columns in a CSV file."""
    compared: bool = False
    """Whether it is a difference from the reference: with a sign, and none for the reference itself."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of its columns in a CSV file."""
        if not self.name:
            return ()
        return triple(self.name) if self.interval else (self.name,)

    def fields(self, group: Group) -> Sequence[object]:
        """Under `names`."""
        if not self.name:
            return ()
        if self.interval:
            return figures_of(group.estimate(self), self.digits)
        found = group[self]
        return [round(found, self.digits) if isinstance(found, float) else found]

    def cell(self, group: Group) -> str:
        """In a Markdown table."""
        if self.compared and group.runs is group.reference:
            return "reference"
        found = group[self]
        return found if isinstance(found, str) else cell(found, self.shown, sign="+" if self.compared else "")


# -- kinds of columns --------------------------------------------------------------------------------------------------


def share(name: str, heading: str, of: Callable[[Result], Share | None], *, digits: int = 6, shown: int = 3) -> Column:
    """A share of data, over the runs that have it, with the interval of Korn and Graubard."""

    def found(group: Group) -> Estimate | None:
        shares = [each for run in group.runs if (each := of(run)) is not None]
        return estimate_share(shares) if shares else None

    return Column(name, heading, found, digits, shown)


def mean(name: str, heading: str, of: Callable[[Result], float | None], *, digits: int = 4, shown: int = 2) -> Column:
    """The mean over the runs that have a value, with Student's t."""
    return Column(
        name, heading, lambda group: estimate([v for run in group.runs if (v := of(run)) is not None]), digits, shown
    )


def difference(name: str, heading: str, of: Callable[[Result], Share], *, shown: int) -> Column:
    """How far a share is above that of the reference, run by run, with a paired bootstrap."""
    return Column(
        name, heading, lambda group: estimate_difference([of(a).value - of(b).value for a, b in group.pairs]), 6, shown,
        compared=True,
    )  # fmt: skip


def ratio(name: str, heading: str, of: Callable[[Result], float]) -> Column:
    """Relative to the reference: the ratio of two means over the runs that both have."""
    return number(name, heading, lambda group: ratio_of_means([(of(a), of(b)) for a, b in group.pairs]))


def spread(name: str, heading: str, of: Callable[[Result], Share]) -> tuple[Column, ...]:
    """How far the runs are apart: least, median and most."""
    picks: dict[str, Callable[[Sequence[float]], float]] = {"least": min, "median": median, "most": max}

    def found(pick: Callable[[Sequence[float]], float], group: Group) -> float:
        return pick([of(run).value for run in group.runs])

    return (
        *(number(f"{name}_{which}", "", partial(found, pick)) for which, pick in picks.items()),
        number(
            "", f"{heading}: {', '.join(picks)}",
            lambda group: ", ".join(f"{found(pick, group):.4f}" for pick in picks.values()),
        ),
    )  # fmt: skip


def number(name: str, heading: str, of: Callable[[Group], float | str | None], *, shown: int = 2) -> Column:
    """Something without an interval."""
    return Column(name, heading, of, shown=shown, interval=False)


def ratio_of_means(pairs: Sequence[tuple[float, float]]) -> float | None:
    """None if there is nothing to divide by."""
    below = sum(b for _, b in pairs)
    return sum(a for a, _ in pairs) / below if below else None


# -- figures of a run --------------------------------------------------------------------------------------------------


def kept(result: Result) -> Share:
    """Created and not lost; `vanished` data do not count as lost."""
    created = result.summary["created"]
    lost = result.summary["lost"]
    return Share(created - sum(lost.values()) + lost.get(Fate.VANISHED.value, 0), created)


def delivered(result: Result) -> Share:
    """Created and arrived."""
    return Share(result.summary["delivered"], result.summary["created"])


def share_of_created(result: Result, part: int) -> Share:
    """Part of the data that a run created; 0 if it created none."""
    return Share(part, result.summary["created"] or 1)


def mean_delay(result: Result) -> float | None:
    """Steps from creation to arrival; None if nothing has arrived, or the policy knows no base."""
    found = result.summary["delay_steps"]["mean"]
    return None if found is None or result.policy == "stigmergy" else float(found)


def losses(result: Result) -> float:
    """Lost / created at the end, 0..1."""
    return 1.0 - kept(result).value


def transmissions(result: Result) -> float:
    """Data sent per datum created."""
    return float(result.summary["transmissions_per_datum"])


def memory_used(result: Result) -> float:
    """Items in a drone, mean over drones and steps, in percent of what the scenario counts as full."""
    return float(result.summary["memory_used_percent"])


def _delay_within(part: float) -> Callable[[Group], int | None]:
    """Within how many steps this part of the data arrived, of those of all runs together."""

    def found(group: Group) -> int | None:
        if group[DELAY] is None:
            return None
        return percentile(sorted(sum((Counter(run.delays) for run in group.runs), Counter()).elements()), part)

    return found


def _lost(reason: str) -> Callable[[Result], Share]:
    return lambda result: share_of_created(result, result.summary["lost"].get(reason, 0))


# -- columns of several experiments ------------------------------------------------------------------------------------

RUNS = number("runs", "", lambda group: len(group.runs), shown=0)
STEPS = number("steps", "", lambda group: group.steps, shown=0)
RELIABILITY = share("reliability", "Reliability", kept)
DELIVERED = share("delivered", "Delivered", delivered)
#: Its interval is a bound where none are lost.
LOST_PER_MILLION = Column(
    "lost_per_million", "Lost per million", lambda group: group.certain(RELIABILITY).rest().times(1e6), 1, 0
)
#: Mean over the runs of the mean over data.
DELAY = mean("delay", "", mean_delay)
TRANSMISSIONS = mean("transmissions", "Sent per datum", transmissions)
#: Put on the air by a node in a second.
BYTES = mean(
    "bytes_per_node_s", "Bytes per node and s", lambda run: float(run.summary["bytes_per_node_s"]), digits=1, shown=0
)
#: What every table has.
STANDARD = (
    RELIABILITY, DELIVERED, *spread("reliability", "Reliability", kept), *spread("delivered", "Delivered", delivered),
    LOST_PER_MILLION, DELAY,
    number("delay_p50", "Delay, 50 %", _delay_within(0.5), shown=0),
    number("delay_p95", "Delay, 95 %", _delay_within(0.95), shown=0),
    TRANSMISSIONS, BYTES,
)  # fmt: skip

MEMORY = mean("memory", "Memory, %", memory_used)
#: Cycles of next hops, in all runs.
LOOPS = number("loops", "", lambda group: sum(run.summary["routing"]["loops"] for run in group.runs), shown=0)
#: The share of the data created that were lost, by reason.
LOST_BY_REASON = tuple(share(f"lost_{fate.value}", "", _lost(fate.value)) for fate in LOST)
