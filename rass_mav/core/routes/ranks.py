"""What routing by hops and routing by costs differ in; all else is the routing table's (`RoutingTable`).

By hops is Alg. 2 of the paper. By costs is a distributed Bellman-Ford: c_i = min_j c_j + toll_i, and 0 at a base, for
policies whose potential is a cost that adds up along the way. A node announces its cost as the beacon's potential.
"""

from __future__ import annotations

from collections.abc import Collection
from math import inf
from typing import Protocol

from rass_mav.core.messages import NO_ROUTE, Beacon
from rass_mav.core.routes.costs import NO_COST, CostRules
from rass_mav.core.routes.neighbours import Neighbour

#: By hops, a node changes over to another base when its own is out of reach, or this many hops farther than the other.
CHANGE_OVER_HOPS = 3
#: By costs, a neighbour silent for more than so many of its turns may have moved away.
RECENT_TURNS = 1.5


class Rank(Protocol):
    """How neighbours are compared as ways to a base, and where data stay if there is none. One for each table.

    A way has a metric: the lower the better, 0 at a base, and greater by the node's toll at each hop. It is what
    neighbours announce, and what feasibility compares.
    """

    no_way: int
    """The metric of a node that has no way: greater than that of any way."""
    change_over: int
    """A node changes over to another base whose metric is this much lower."""

    @property
    def tag(self) -> int | None:
        """The metric is the potential announced under this policy tag, and 0 of a base; None: it is the hops."""

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """0, or more if data may have to wait with this neighbour: it is chosen if nobody less behind is feasible."""

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """How much a neighbour is worth that says this; the smaller the better. The last is given up where there is no
        room for all."""

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """Where no base is reachable and nobody can count on an old route of this node's: next hop and metric."""

    def announced(self, metric: int, hold_s: float, now: float) -> None:
        """A beacon without a route has left with this metric; somebody may count on it for `hold_s` seconds."""


class ByHops:
    """The fewest hops win (Alg. 2). Without a base data go nowhere that the table knows of."""

    __slots__ = ()

    no_way = NO_ROUTE
    change_over = CHANGE_OVER_HOPS
    tag = None

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """Nobody is."""
        return 0

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """By hops, also where the policy is another; among equals the fitter one is better."""
        return beacon.hops, -beacon.potential

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """There is none."""
        return None, NO_ROUTE

    def announced(self, metric: int, hold_s: float, now: float) -> None:
        """A beacon without a route says nothing that anybody could count on."""


class ByCost:
    """The cheapest way wins, else the cheapest place to stay.

    Nodes of another policy announce something else: only a base among them can be a next hop.

    Where no base is reachable, staying has a price too: `hold` tolls. Then c_i = min(hold toll_i, min_j c_j + toll_i),
    and data gather on the safest member of the island. There is no base to number announcements. Instead a neighbour
    is feasible while its cost is below all that this node has announced for as long as anybody may remember it: along
    any chain of next hops these lowest announcements fall, so it cannot close. A node that loses its base waits as
    long before it looks for shelter, and one that has a route is no shelter.
    """

    __slots__ = ("_hold_s", "_low", "_low_before", "_since", "_window_s", "change_over", "rules", "tag")

    no_way = NO_COST

    def __init__(self, rules: CostRules) -> None:
        self.rules = rules
        self.tag = rules.tag
        self.change_over = rules.change_over
        self._low = self._low_before = NO_COST
        """The lowest cost announced without a route in the present window and in the one before."""
        self._since = -inf
        self._window_s = self._hold_s = 0.0
        """How long the present window lasts, and the next one at least."""

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """Full: 1, for it may still be the way, but data wait there. Its last beacon is missing: 2."""
        late = neighbour.heard < now - RECENT_TURNS * neighbour.turn_s
        return 2 * late + (not neighbour.beacon.free)

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """By cost. Behind all of them come nodes of another policy, by hops."""
        if not beacon.hops:
            return 0, 0
        return (0, beacon.potential) if beacon.policy == self.tag else (1, beacon.hops)

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """Where data are safest: here, or with a neighbour that has room."""
        stay = min(int(self.rules.hold * toll), NO_COST - 1)
        low = min(self._low, self._low_before)
        best, best_cost = None, stay
        for neighbour in neighbours:
            b = neighbour.beacon
            if b.hops != NO_ROUTE or b.policy != self.tag or self.behind(neighbour, now):
                continue
            cost = b.potential + toll
            limit = stay if b.sender == next_hop else self.rules.hysteresis * stay
            if b.potential < low and cost < limit and cost < best_cost:
                best, best_cost = neighbour.id, cost
        return best, best_cost

    def announced(self, metric: int, hold_s: float, now: float) -> None:
        """Only shelters that cost less are feasible from now on, for one to two windows.

        A window lasts as long as anybody may remember what was announced in the one before, also if turns have become
        shorter since.
        """
        if now - self._since >= self._window_s:
            self._low_before, self._low = self._low, NO_COST
            self._since = now
            self._window_s, self._hold_s = max(self._hold_s, hold_s), hold_s
        elif hold_s > self._hold_s:
            self._hold_s = hold_s
        self._low = min(self._low, metric)
