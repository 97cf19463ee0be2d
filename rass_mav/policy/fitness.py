"""Fitness-driven percolation: Eq. 3 and 4 of the paper with different weights."""

from __future__ import annotations

import zlib
from itertools import islice

from rass_mav.core.messages import NO_ROUTE, UNBOUNDED_FREE
from rass_mav.core.policy import POTENTIAL_BASE, POTENTIAL_ONE, Dispatch, View
from rass_mav.core.routes.neighbours import Neighbour

#: Hop count that represents "no route" in Eq. 3 unless another is set: more than any real one.
UNREACHABLE_HOPS = 255


def policy_tag(name: str, *weights: float) -> int:
    """16 bits that almost certainly differ between policies whose potentials cannot be compared."""
    text = ":".join([name, *(format(w, ".9g") for w in weights)])
    return zlib.crc32(text.encode()) & 0xFFFF


def all_to(target: Neighbour, view: View) -> list[Dispatch]:
    """Everything to one neighbour, within the budget and its free space."""
    free = target.beacon.free
    count = view.budget if free == UNBOUNDED_FREE else min(view.budget, free)
    id = target.id
    return [Dispatch(datum_id, id) for datum_id in islice(view.data(id), count)]


class FitnessPolicy:
    """phi = 1/(alpha h + beta r) if there is space, else 0 (Eq. 3); unfit when T phi < the fittest neighbour's (Eq. 4).

    All data go to the fittest neighbour, least recently used first; ties are broken at random.
    """

    replicates = False
    costs = None
    risk_gain = 1.0
    seq_period = 30
    own_share = 0.0
    #: Part of the tag: potentials are compared only within a family.
    family = "fitness"

    def __init__(
        self, name: str, *, alpha: float, beta: float, threshold: float = 1.0, unknown_hops: int = UNREACHABLE_HOPS
    ) -> None:
        """`alpha` weighs hops, `beta` weighs risk, both >= 0 and not both 0; `threshold` is T >= 0.

        `unknown_hops`, >= 1: the hop count in Eq. 3 of a node without a route.
        """
        if alpha < 0 or beta < 0 or alpha + beta == 0 or threshold < 0:
            raise ValueError("alpha and beta must be >= 0 and not both 0, threshold >= 0")
        self.name = name
        self.alpha = alpha
        self.beta = beta
        self.threshold = threshold
        self.unknown_hops = unknown_hops
        others = () if unknown_hops == UNREACHABLE_HOPS else (unknown_hops,)
        self.tag = policy_tag(self.family, alpha, beta, *others)

    def potential(self, hops: int, risk: float, free: int) -> int:
        """Eq. 3 in wire units (`POTENTIAL_ONE` = fitness 1), rounded, at most one below a base's."""
        if free <= 0:
            return 0
        if hops == NO_ROUTE:
            hops = self.unknown_hops
        cost = self.alpha * hops + self.beta * risk
        if cost * (POTENTIAL_BASE - 1) <= POTENTIAL_ONE:
            return POTENTIAL_BASE - 1
        # Never 0: that means there is no space.
        return max(1, int(POTENTIAL_ONE / cost + 0.5))

    def plan(self, view: View) -> list[Dispatch]:
        """Everything to the fittest neighbour if this node is unfit, within the budget and the neighbour's free
        space."""
        best = self.threshold * view.potential
        fittest: list[Neighbour] = []
        tag = self.tag
        for neighbour in view.neighbours:
            beacon = neighbour.beacon
            if beacon.policy == tag or beacon.potential in (0, POTENTIAL_BASE):
                potential = beacon.potential
            else:
                # Another policy's numbers mean nothing here: judge by hops, as if the neighbour had our risk.
                potential = self.potential(beacon.hops, view.risk, beacon.free)
            if potential > best:
                best = potential
                fittest = [neighbour]
            elif potential == best and fittest:
                fittest.append(neighbour)
        if not fittest:
            return []
        target = fittest[0] if len(fittest) == 1 else fittest[view.rng.randrange(len(fittest))]
        return all_to(target, view)
