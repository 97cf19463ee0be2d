"""The figures that the table of every experiment has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rass_mav.core.datum import Fate
from rass_mav.lab.experiment.runs import Result
from rass_mav.lab.experiment.statistics import Estimate, Share, estimate, estimate_share
from rass_mav.lab.experiment.tables import cell, figures_of, triple
from rass_mav.lab.swarm.statistics import percentile

#: Columns of a CSV file.
COLUMNS = (
    *triple("reliability"), *triple("delivered"), *triple("lost_per_million"), *triple("delay"), "delay_p50",
    "delay_p95", *triple("transmissions"), *triple("bytes_per_node_s"),
)  # fmt: skip
#: Of a Markdown table.
HEADINGS = (
    "Reliability", "Delivered", "Lost per million", "Delay, 50 %", "Delay, 95 %", "Sent per datum",
    "Bytes per node and s",
)  # fmt: skip
#: What people need to know to read them.
NOTE = (
    "Means over runs with 95 % confidence intervals. Shares of data: after Korn and Graubard, which gives a bound\n"
    "where nothing is lost too. Others: Student's t. Delay: steps from creation to arrival, within which 50 % and\n"
    "95 % of the data came, of all that arrived in all runs. Sent: data and copies, per datum created.\n"
)
#: The same of differences between runs.
PAIRED = "Differences: run by run, of the same seeds; 95 % confidence interval by a paired bootstrap over seeds.\n"


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
    mean = result.summary["delay_steps"]["mean"]
    return None if mean is None or result.policy == "stigmergy" else float(mean)


def summary_estimate(results: Sequence[Result], value: Callable[[Result], float | None]) -> Estimate | None:
    """Mean over the runs that have the value."""
    return estimate([v for result in results if (v := value(result)) is not None])


@dataclass(frozen=True)
class Standard:
    """The figures of runs that differ in their seeds only."""

    runs: int
    steps: int
    reliability: Estimate
    """(created - lost) / created at the end."""
    delivered: Estimate
    """Arrived / created."""
    delay: Estimate | None
    """Steps from creation to arrival: mean over the runs of the mean over data. None: nothing arrived, or the policy
    knows no base."""
    delay_p50: int | None
    """Of the data of all runs together."""
    delay_p95: int | None
    transmissions: Estimate
    """Data sent per datum created."""
    bytes_per_node_s: Estimate
    """Put on the air by a node in a second."""

    @property
    def lost_per_million(self) -> Estimate:
        """Data lost of a million created; its interval is a bound where none are lost."""
        return self.reliability.rest().times(1e6)

    def columns(self) -> list[float | int | None]:
        """`COLUMNS`."""
        return [
            *figures_of(self.reliability, 6), *figures_of(self.delivered, 6), *figures_of(self.lost_per_million, 1),
            *figures_of(self.delay), self.delay_p50, self.delay_p95, *figures_of(self.transmissions),
            *figures_of(self.bytes_per_node_s, 1),
        ]  # fmt: skip

    def cells(self) -> list[str]:
        """Under `HEADINGS`."""
        return [
            cell(self.reliability, 3), cell(self.delivered, 3), cell(self.lost_per_million, 0), cell(self.delay_p50, 0),
            cell(self.delay_p95, 0), cell(self.transmissions), cell(self.bytes_per_node_s, 0),
        ]  # fmt: skip


def standard(results: Sequence[Result]) -> Standard:
    """`results`: at least one."""
    delay = summary_estimate(results, mean_delay)
    delays = sorted(sum((Counter(result.delays) for result in results), Counter()).elements()) if delay else []
    return Standard(
        runs=len(results),
        steps=results[0].steps,
        reliability=estimate_share([kept(result) for result in results]),
        delivered=estimate_share([delivered(result) for result in results]),
        delay=delay,
        delay_p50=percentile(delays, 0.5),
        delay_p95=percentile(delays, 0.95),
        transmissions=_mean(results, "transmissions_per_datum"),
        bytes_per_node_s=_mean(results, "bytes_per_node_s"),
    )


def _mean(results: Sequence[Result], key: str) -> Estimate:
    found = estimate([float(result.summary[key]) for result in results])
    assert found is not None, "no runs"
    return found
