"""Fair shares of what is bounded: no sender can fill a table or a store alone.

The rule is max-min. While there is space, every sender may use it. When there is little or none, the one that has most
gives way, or gets no more. Each can thus have as much as all others that want it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from rass_mav.core.datum import DatumId

K = TypeVar("K")

#: Bound: The last part of a store, one place in this many, is for those that have less than their share.
LAST_PART = 8


def greediest(counts: Mapping[K, int]) -> K:
    """The one that has most; among equals the first."""
    return max(counts, key=lambda key: counts[key])


def is_fair(has: int, places: int, sharing: int) -> bool:
    """Whether one of `sharing` that has so many has less than an equal share of the places."""
    return has * sharing < places


def is_last_part(used: int, places: int) -> bool:
    """Whether so little is left that it is kept for those that have less than their share."""
    return used >= places - places // LAST_PART


class Portions:
    """Whose data a node has in custody, and whose replicas that no custodian counts on."""

    __slots__ = ("_node_id", "custodians", "origins", "passed_on")

    def __init__(self, node_id: int) -> None:
        """`node_id`: of the node itself, the origin of its own data."""
        self._node_id = node_id
        self.custodians: dict[int | None, list[int]] = {}
        """Data in custody by the node that they are from, None: this one: how many, and their bytes of payload."""
        self.origins: dict[int, list[int]] = {}
        """The same by origin."""
        self.passed_on: dict[int | None, dict[DatumId, None]] = {}
        """Replicas that no custodian counts on, by the node that they are from, the oldest first."""

    def add(self, custodian: int | None, origin: int, size: int) -> None:
        """A datum is in custody now."""
        count(self.custodians, custodian, 1, size)
        count(self.origins, origin, 1, size)

    def remove(self, custodian: int | None, origin: int, size: int) -> None:
        """A datum is in custody no more."""
        count(self.custodians, custodian, -1, -size)
        count(self.origins, origin, -1, -size)

    def retire(self, custodian: int | None, id: DatumId) -> None:
        """No custodian counts on a replica any more."""
        self.passed_on.setdefault(custodian, {})[id] = None

    def unretire(self, custodian: int | None, id: DatumId) -> None:
        """Such a replica goes, or a custodian counts on it again."""
        replicas = self.passed_on[custodian]
        del replicas[id]
        if not replicas:
            del self.passed_on[custodian]

    def is_fair(self, custodian: int, origin: int, which: int, places: int) -> bool:
        """Whether a neighbour, and an origin, have less than an equal share of the places. `which`: 0: items, 1: bytes.
        This node counts as one of those that share, whether it holds own data or not."""
        custodians = len(self.custodians.keys() | {None, custodian})
        origins = len(self.origins.keys() | {self._node_id, origin})
        return is_fair(self.custodians.get(custodian, NOTHING)[which], places, custodians) and is_fair(
            self.origins.get(origin, NOTHING)[which], places, origins
        )

    def superfluous(self) -> DatumId | None:
        """The oldest replica from the node that more than half of the uncounted ones are from; None: no node has so
        many."""
        counts = {custodian: len(replicas) for custodian, replicas in self.passed_on.items()}
        most = greediest(counts)
        return next(iter(self.passed_on[most])) if 2 * counts[most] > sum(counts.values()) else None


#: Items and bytes of a node that has nothing.
NOTHING = (0, 0)


def count(portions: dict[K, list[int]], key: K, items: int, size: int) -> None:
    """One has so many more items, and bytes; negative: fewer. None has none."""
    has = portions.get(key)
    if has is None:
        portions[key] = [items, size]
        return
    has[0] += items
    has[1] += size
    if not has[0]:
        del portions[key]
