"""The units of costs, and how a policy adds them up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

#: Costs are 32-bit fixed point on the wire: this many units are a cost of 1.
COST_ONE = 1 << 20
#: No route, and no shelter. One below the value that only bases announce.
NO_COST = 0xFFFFFFFE


@dataclass(frozen=True, slots=True)
class CostRules:
    """How a policy adds costs up."""

    tag: int
    """The policy's: only costs under it can be compared."""
    hold: float
    """>= 1: the cost of staying where no base is reachable, in tolls."""
    hysteresis: float
    """In (0, 1]: another place must cost less than this share of staying."""
    change_over: int
    """A node changes to another base that is cheaper by this, wire units."""


class Toll(NamedTuple):
    """What a hop from a node adds to the metric of its route, wire units."""

    hop: int
    """By itself. It is also what counts where no base is reachable."""
    queue: int = 0
    """For the data that wait at the node."""
