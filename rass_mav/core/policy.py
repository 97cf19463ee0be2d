"""What the node expects of a policy: which node is fit, and which data go where. The policies are in
`rass_mav.policy`."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rass_mav.core.datum import DatumId
from rass_mav.core.routes.costs import CostRules
from rass_mav.core.routes.neighbours import Neighbour

#: Potentials are 32-bit fixed point on the wire: this many units are a fitness of 1.
POTENTIAL_ONE = 1 << 24
#: The potential of a base: fitter than anything a drone can reach.
POTENTIAL_BASE = 0xFFFFFFFF


class Dispatch(NamedTuple):
    """One item of a policy's plan: custody of a datum should be handed over."""

    id: DatumId
    neighbour: int
    """Node id."""


@dataclass(slots=True)
class View:
    """What a policy may look at when it plans a step."""

    neighbours: Collection[Neighbour]
    """Neighbours heard recently."""
    way: Neighbour | None
    """The routing table's next hop."""
    hops: int
    """Own hop count, or NO_ROUTE."""
    potential: int
    """Own potential as announced, in wire units."""
    risk: float
    """Own risk, 0..1."""
    budget: int
    """How many items may still be sent this step."""
    data: Callable[[int], Iterator[DatumId]]
    """Data that can be handed over to a neighbour (node id) now, least recently used first."""
    rng: random.Random
    """For choosing between equals."""


class Policy(Protocol):
    """One way to decide. Stateless: all it needs is in the view, so one instance can serve many nodes."""

    name: str
    """Its name in configurations."""
    tag: int
    """16 bits for name and weights: potentials can be compared only between equal tags."""
    replicates: bool
    """Whether data are broadcast and kept by all nodes, as `rass_mav.core.stigmergy` does; then nothing is planned."""

    @property
    def costs(self) -> CostRules | None:
        """How costs add up, if the potential is a cost that adds up along the route, so that lower is better. Otherwise
        None."""

    risk_gain: float
    """Gain of the moving average over readings unless one is set, in (0, 1]."""
    seq_period: int
    """Steps after which a base raises its announcement number unless `routing.seq_period` is set."""
    own_share: float
    """Part of a drone's store that is reserved for its own measurements unless one is set, 0..1."""

    def potential(self, hops: int, risk: float, free: int) -> int:
        """A drone's potential in wire units, 0..POTENTIAL_BASE - 1. `hops` may be NO_ROUTE; `risk` 0..1.

        With `costs`: what a hop from this node adds to the cost of its route.
        """

    def plan(self, view: View) -> list[Dispatch]:
        """What to send this step, at most `view.budget` items."""
