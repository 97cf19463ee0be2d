"""How routing by hops and routing by costs differ; the rest is in the routing table (`RoutingTable`).

By hops is Alg. 2 of the paper. By costs is a distributed Bellman-Ford: c_i = min_j c_j + toll_i, and 0 at a base, for
policies whose potential is a cost that adds up along the route. A node announces its cost as the beacon's potential.
"""

from __future__ import annotations

from collections.abc import Collection
from math import inf
from typing import Protocol

from rass_mav.core.messages import NO_ROUTE, Beacon
from rass_mav.core.routes.costs import NO_COST, CostRules
from rass_mav.core.routes.neighbours import Neighbour

# Tuned: python -m tools.sensitivity routes.ranks
#: By hops, a node changes to another base when its own is out of reach, or this many hops farther than the other.
CHANGE_OVER_HOPS = 3


class Rank(Protocol):
    """How neighbours are compared as routes to a base, and where data stay if there is none. One for each table.

    A route has a metric: the lower the better, 0 at a base, and greater by the node's toll at each hop. Neighbours
    announce it, and feasibility compares it.
    """

    no_way: int
    """The metric of a node without a route: greater than that of any route."""
    change_over: int
    """A node changes to another base whose metric is this much lower."""

    @property
    def tag(self) -> int | None:
        """The metric is the potential announced under this policy tag, and 0 for a base; None: it is the hops."""

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """0, or more if data may have to wait at this neighbour, or be lost: it is chosen only if no feasible one has
        less."""

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """The rank of a neighbour with this beacon; the smaller the better. If there is not enough space, the last is
        given up."""

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """Where no base is reachable and no node can count on an old route of this node: next hop and metric."""

    def announced(self, metric: int, hold_s: float, now: float) -> None:
        """A beacon without a route has left with this metric; other nodes may count on it for `hold_s` seconds."""


class ByHops:
    """The fewest hops win (Alg. 2). Without a base the table knows nowhere for data to go."""

    __slots__ = ()

    no_way = NO_ROUTE
    change_over = CHANGE_OVER_HOPS
    tag = None

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """One that is suspected: 4."""
        return 4 * neighbour.suspected

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """By hops, even where the policy is another; among equals the fitter one is better."""
        return beacon.hops, -beacon.potential

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """There is none."""
        return None, NO_ROUTE

    def announced(self, metric: int, hold_s: float, now: float) -> None:
        """A beacon without a route contains nothing that other nodes could count on."""


class ByCost:
    """The cheapest route wins, or else the cheapest place to stay.

    Nodes of another policy announce something else: only a base among them can be a next hop.

    Where no base is reachable, staying has a cost too: `hold` tolls. Then c_i = min(hold toll_i, min_j c_j + toll_i),
    and data gather on the safest member of the island. There is no base to number announcements. Instead a neighbour is
    feasible while its cost is below all that this node has announced for as long as any node may remember it. These
    lowest announcements fall along any chain of next hops, so the chain cannot close. A node that loses its base waits
    as long before it looks for shelter, and a node that has a route is no shelter.
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
        """How long the present window lasts, and the least length of the next one."""

    def behind(self, neighbour: Neighbour, now: float) -> int:
        """Full: 1, because it may still be the route, but data wait there. It has probably moved away: 2. It is
        suspected: 4."""
        return 4 * neighbour.suspected + 2 * neighbour.is_missing(now) + (not neighbour.beacon.free)

    def standing(self, beacon: Beacon) -> tuple[int, int]:
        """By cost. After all of them come nodes of another policy, by hops."""
        if not beacon.hops:
            return 0, 0
        return (0, beacon.potential) if beacon.policy == self.tag else (1, beacon.hops)

    def shelter(
        self, neighbours: Collection[Neighbour], toll: int, next_hop: int | None, now: float
    ) -> tuple[int | None, int]:
        """Where data are safest: here, or at a neighbour that has space."""
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
        """From now on only shelters that cost less are feasible, for one to two windows.

        A window lasts as long as any node may remember what was announced in the one before, even if turns have become
        shorter since.
        """
        if now - self._since >= self._window_s:
            self._low_before, self._low = self._low, NO_COST
            self._since = now
            self._window_s, self._hold_s = max(self._hold_s, hold_s), hold_s
        elif hold_s > self._hold_s:
            self._hold_s = hold_s
        self._low = min(self._low, metric)
