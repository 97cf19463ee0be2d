"""Backpressure routing: data flow from long queues to short ones."""

from __future__ import annotations

from rass_mav.core.custody.holdings import Holding
from rass_mav.core.datum import DatumId
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.lab.baselines.common import Baseline

#: How many waiting data outweigh one hop.
HOP_WEIGHT = 5


class Backpressure(Baseline):
    """L. Tassiulas and A. Ephremides, Stability Properties of Constrained Queueing Systems and Scheduling Policies for
    Maximum Throughput in Multihop Radio Networks, IEEE Transactions on Automatic Control 37, 1992: a datum goes to the
    neighbour for which the own backlog exceeds its backlog most, if it does.

    By backlog alone, data walk at random where there is little traffic. So hops to a base count as backlog too, as in
    M. J. Neely, E. Modiano and C. E. Rohrs, Dynamic Power Allocation and Routing for Time-Varying Wireless Networks,
    IEEE JSAC 23, 2005. That favours it. The beacon announces the backlog. There is one copy, and a full store takes no
    more.
    """

    __slots__ = ("_added",)
    summarises = False

    def begin_life(self, now: float) -> None:
        self._added: dict[int, int] = {}
        """Data sent to each neighbour since its beacon."""

    def hear(self, neighbour: Neighbour, now: float) -> None:
        self._added.pop(neighbour.id, None)

    def announce(self, now: float) -> int:
        return 0 if self.base else len(self.holdings)

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        own = len(self.holdings) - len(self._pending) + HOP_WEIGHT * self.routing.hops
        best = max(contacts, key=lambda n: own - self._backlog(n), default=None)
        return best if best is not None and own > self._backlog(best) and best.beacon.free else None

    def _backlog(self, neighbour: Neighbour) -> int:
        beacon = neighbour.beacon
        return beacon.potential + self._added.get(neighbour.id, 0) + HOP_WEIGHT * beacon.hops

    def mark(self, id: DatumId, neighbour: Neighbour) -> int:
        self._added[neighbour.id] = self._added.get(neighbour.id, 0) + 1
        return 0

    def given(self, id: DatumId, neighbour: int, mark: int) -> bool:
        return True

    def victim(self) -> Holding | None:
        return None
