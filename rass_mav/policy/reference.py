"""Eviction as in the authors' code, where it differs from the paper's text: `policy.rules: authors`.

Source: the authors' repository MISTLab/RASS at d362ebf, as docs/evaluation/reproduction.md describes it rule by rule.
"""

from __future__ import annotations

from itertools import islice

from rass_mav.core.policy import Dispatch, View
from rass_mav.core.routes.neighbours import Neighbour

from .fitness import FitnessPolicy

#: Buckets of the hash tables that hold the authors' neighbours; each bucket is a list.
BUCKETS = 10


def place_in_table(node_id: int) -> tuple[int, int, int]:
    """Sorts node ids in the order of the authors' hash table: the last of equals is chosen."""
    return node_id % BUCKETS, node_id % (2 * BUCKETS), node_id


class ReferencePolicy(FitnessPolicy):
    """Eq. 3 like `FitnessPolicy`; evicts unless strictly fitter than every neighbour, half of the store a step.

    Among equal neighbours the last in the hash table wins. A neighbour's free space is ignored. All nodes of a swarm
    must follow it: it does not judge nodes of other policies by their hops.
    """

    family = "reference"

    def plan(self, view: View) -> list[Dispatch]:
        """ceil(n/2) of the n data held to the fittest neighbour, least recently used first, within the budget."""
        neighbours = view.neighbours
        if not neighbours:
            return []
        fittest = max(neighbours, key=_rank)
        if self.threshold * view.potential > fittest.beacon.potential:
            return []
        id = fittest.id
        held = sum(1 for _ in view.data(id))
        return [Dispatch(datum_id, id) for datum_id in islice(view.data(id), min((held + 1) // 2, view.budget))]


def _rank(neighbour: Neighbour) -> tuple[int, tuple[int, int, int]]:
    return neighbour.beacon.potential, place_in_table(neighbour.id)
