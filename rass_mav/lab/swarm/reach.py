"""Who can reach a base, over any number of hops."""

from __future__ import annotations

from collections.abc import Sequence


def reachable(neighbours: Sequence[Sequence[int]], bases: int) -> int:
    """How many drones have a way to a base.

    :param neighbours: for each node the ids in its range.
    :param bases: nodes 0 .. bases - 1 are bases.
    """
    found = set(range(bases))
    border = list(found)
    while border:
        new = {other for node in border for other in neighbours[node]} - found
        found |= new
        border = list(new)
    return len(found) - bases
