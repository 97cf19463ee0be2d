"""Groups of runs compared with a reference, run by run: both had the same seed, and so the same world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rass_mav.lab.experiment.curves import memory_used
from rass_mav.lab.experiment.runs import Result
from rass_mav.lab.experiment.standard import Standard, delivered, kept, share_of_created, standard, summary_estimate
from rass_mav.lab.experiment.statistics import Estimate, estimate, estimate_difference, estimate_share


def losses(result: Result) -> float:
    """Lost / created at the end, 0..1."""
    return 1.0 - kept(result).value


def transmissions(result: Result) -> float:
    """Data sent per datum created."""
    return float(result.summary["transmissions_per_datum"])


def ceiling(result: Result) -> float | None:
    """The share of all data that the oracle expects to keep, 0..1; None if no data are due, or nobody asked it."""
    return _kept(result, "ceiling")


def bound(result: Result) -> float | None:
    """The same for an oracle with all contacts."""
    return _kept(result, "contacts")


def _kept(result: Result, oracle: str) -> float | None:
    found = result.extra.get(oracle)
    return found["kept"] / found["data"] if found and found["data"] else None


@dataclass(frozen=True)
class Comparison:
    """The figures of the runs of one policy in one variant."""

    standard: Standard
    gain: Estimate | None
    """Reliability above the reference's, run by run; None without a reference."""
    delivered_gain: Estimate | None
    """Likewise the share that was delivered."""
    loss_ratio: float | None
    """Losses relative to the reference's."""
    ceiling: Estimate | None
    """What the oracle would keep."""
    ceiling_share: float | None
    """Reliability relative to the ceiling. With spare copies or immediate forwarding it may be above 1."""
    bound: Estimate | None
    """What an oracle with all contacts would keep."""
    transmission_ratio: float | None
    """Relative to the reference's."""
    memory: Estimate | None
    """Percent of the drones' capacity in use."""
    copies: Estimate | None
    """Copies of a datum that has not arrived."""
    loops: int
    """Cycles of next hops, in all runs."""
    lost: dict[str, Estimate]
    """Share of the data created, 0..1, by reason."""


def compare(results: Sequence[Result], reference: Sequence[Result]) -> Comparison:
    """`results`: runs that differ in their seeds only, at least one. `reference`: runs to pair them with; may be empty.

    Both sides of a ratio are means over the same runs.
    """
    others = {result.seed: result for result in reference}
    pairs = [(result, others[result.seed]) for result in results if result.seed in others]
    ceilings = [(kept(result).value, found) for result in results if (found := ceiling(result)) is not None]
    return Comparison(
        standard=standard(results),
        gain=estimate_difference([kept(a).value - kept(b).value for a, b in pairs]),
        delivered_gain=estimate_difference([delivered(a).value - delivered(b).value for a, b in pairs]),
        loss_ratio=_ratio([(losses(a), losses(b)) for a, b in pairs]),
        ceiling=estimate([found for _, found in ceilings]),
        ceiling_share=_ratio(ceilings),
        bound=summary_estimate(results, bound),
        transmission_ratio=_ratio([(transmissions(a), transmissions(b)) for a, b in pairs]),
        memory=summary_estimate(results, memory_used),
        copies=summary_estimate(results, lambda result: float(result.summary["copies_mean"])),
        loops=sum(result.summary["routing"]["loops"] for result in results),
        lost={
            reason: estimate_share([share_of_created(result, result.summary["lost"][reason]) for result in results])
            for reason in results[0].summary["lost"]
        },
    )


def _ratio(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Ratio of the means; None if there is nothing to divide by."""
    below = sum(b for _, b in pairs)
    return sum(a for a, _ in pairs) / below if below else None
