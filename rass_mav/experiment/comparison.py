"""Groups of runs compared with a reference, run by run: both had the same seed, and so the same world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rass_mav.experiment.curves import final_reliability, mean_delay, memory_used, summary_estimate
from rass_mav.experiment.runs import Result
from rass_mav.experiment.statistics import Estimate, estimate


def losses(result: Result) -> float:
    """Lost / created at the end, 0..1."""
    return 1.0 - final_reliability(result)


def transmissions(result: Result) -> float:
    """Data sent per datum created."""
    return float(result.summary["transmissions_per_datum"])


def ceiling(result: Result) -> float | None:
    """The share of all data that the oracle expects to keep, 0..1; None if no data are due."""
    return _kept(result.extra["ceiling"])


def bound(result: Result) -> float | None:
    """The same for an oracle with all contacts."""
    return _kept(result.extra["contacts"])


def _kept(found: dict[str, Any]) -> float | None:
    return found["kept"] / found["data"] if found["data"] else None


@dataclass(frozen=True)
class Comparison:
    """The figures of the runs of one policy in one variant."""

    runs: int
    reliability: Estimate
    """(created - lost) / created at the end."""
    gain: Estimate | None
    """Reliability above the reference's, run by run; None without a reference."""
    loss_ratio: float | None
    """Losses relative to the reference's."""
    ceiling: Estimate | None
    """What the oracle would keep."""
    ceiling_share: float | None
    """Reliability relative to the ceiling. With spare copies or immediate forwarding it may be above 1."""
    bound: Estimate | None
    """What an oracle with all contacts would keep."""
    delay: Estimate | None
    """Steps from creation to arrival, of data that arrived."""
    transmissions: Estimate
    """Data sent per datum created."""
    transmission_ratio: float | None
    """Relative to the reference's."""
    memory: Estimate
    """Percent of the drones' capacity in use."""
    copies: Estimate
    """Copies of a datum that has not arrived."""
    loops: int
    """Cycles of next hops, in all runs."""
    lost: dict[str, Estimate | None]
    """Share of the data created, 0..1, by reason."""


def compare(results: Sequence[Result], reference: Sequence[Result]) -> Comparison:
    """`results`: runs that differ in their seeds only, at least one. `reference`: runs to pair them with; may be empty.

    Both sides of a ratio are means over the same runs.
    """
    others = {result.seed: result for result in reference}
    pairs = [(result, others[result.seed]) for result in results if result.seed in others]
    ceilings = [(final_reliability(result), found) for result in results if (found := ceiling(result)) is not None]
    return Comparison(
        runs=len(results),
        reliability=_mean(results, final_reliability),
        gain=estimate([final_reliability(a) - final_reliability(b) for a, b in pairs]),
        loss_ratio=_ratio([(losses(a), losses(b)) for a, b in pairs]),
        ceiling=estimate([found for _, found in ceilings]),
        ceiling_share=_ratio(ceilings),
        bound=summary_estimate(results, bound),
        delay=summary_estimate(results, mean_delay),
        transmissions=_mean(results, transmissions),
        transmission_ratio=_ratio([(transmissions(a), transmissions(b)) for a, b in pairs]),
        memory=_mean(results, memory_used),
        copies=_mean(results, lambda result: float(result.summary["copies_mean"])),
        loops=sum(result.summary["routing"]["loops"] for result in results),
        lost={reason: summary_estimate(results, _lost_for(reason)) for reason in results[0].summary["lost"]},
    )


def _mean(results: Sequence[Result], value: Callable[[Result], float]) -> Estimate:
    found = estimate([value(result) for result in results])
    assert found is not None, "no runs"
    return found


def _ratio(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Ratio of the means; None if there is nothing to divide by."""
    below = sum(b for _, b in pairs)
    return sum(a for a, _ in pairs) / below if below else None


def _lost_for(reason: str) -> Callable[[Result], float | None]:
    def share(result: Result) -> float | None:
        summary = result.summary
        return summary["lost"][reason] / summary["created"] if summary["created"] else None

    return share
