"""Survival routing: data take the route on which they are most likely to arrive."""

from __future__ import annotations

import math

from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.policy import POTENTIAL_BASE, Dispatch, Policy, View
from rass_mav.core.routes.costs import COST_ONE, NO_COST, CostRules
from rass_mav.core.routes.neighbours import Neighbour

from .fitness import all_to, policy_tag
from .settings import PolicyKind, PolicySettings

#: No risk is certain death: readings are not that good, and its logarithm would be infinite.
MAX_RISK = 0.999


class SurvivalPolicy:
    """c_i = min_j c_j + a - log(1 - r_i), 0 at a base; all data go to the neighbour with the lowest cost.

    A datum that is exposed once to each risk on its route survives with probability exp(-sum of -log(1 - r)). With
    a = 0 the cheapest route is the safest one; `hop_cost` a is what a hop is worth in that currency. Every node that
    has a route has a neighbour that is cheaper than itself, so there are no local maxima of fitness where data are
    corrupted. How costs spread without loops, and where data stay when no base is reachable:
    `rass_mav.core.routes.ranks.ByCost`.
    """

    name = "survival"
    replicates = False
    #: A cost adds up the noise of all readings on the route, so they are averaged.
    risk_gain = 0.1
    #: Costs change with every reading, so routes that have become more expensive must be feasible again soon.
    seq_period = 2
    #: Data gather on the safest members of an island, and fill them.
    own_share = 0.4

    def __init__(self, *, hop_cost: float = 0.05, hold: float = 100.0, hysteresis: float = 0.8) -> None:
        """`hop_cost` a > 0; `hold` >= 1: the cost of staying where no base is reachable, in hops; `hysteresis` in (0,
        1]: another place is chosen only if it costs less than this share of staying."""
        if hop_cost <= 0 or hold < 1 or not 0 < hysteresis <= 1:
            raise ValueError("hop_cost must be > 0, hold >= 1, hysteresis in (0, 1]")
        self.hop_cost = hop_cost
        self.tag = policy_tag(self.name, hop_cost, hold, hysteresis)
        # A base that is cheaper by three hops is worth changing to.
        self.costs = CostRules(self.tag, hold, hysteresis, int(3 * hop_cost * COST_ONE))

    def potential(self, hops: int, risk: float, free: int) -> int:
        """What a hop from a node at this risk costs, a - log(1 - r), in wire units, at least 1."""
        cost = self.hop_cost - math.log1p(-min(risk, MAX_RISK))
        return min(max(1, int(cost * COST_ONE + 0.5)), NO_COST - 1)

    def plan(self, view: View) -> list[Dispatch]:
        """Everything to the next hop, within the budget and its free space."""
        target = view.way or self._stranger(view)
        return [] if target is None else all_to(target, view)

    def _stranger(self, view: View) -> Neighbour | None:
        """Without a route of its own kind: a neighbour of another policy that knows one, judged by its hops.

        This node then announces no route, so data that the neighbour has accepted do not come back.
        """
        strangers = [
            n for n in view.neighbours
            if n.beacon.policy != self.tag and n.beacon.hops != NO_ROUTE and n.beacon.free
            and n.beacon.potential not in (0, POTENTIAL_BASE)
        ]  # fmt: skip
        return min(strangers, key=lambda n: (n.beacon.hops, n.id), default=None)


def _make(settings: PolicySettings) -> Policy:
    return SurvivalPolicy() if settings.hop_cost is None else SurvivalPolicy(hop_cost=settings.hop_cost)


POLICIES = (PolicyKind(SurvivalPolicy.name, 4, _make),)
