"""The routing table of policies whose potential is a cost that adds up along the way: a distributed Bellman-Ford.

c_i = min_j c_j + toll_i, and 0 at a base. A node announces its cost as the beacon's potential. Feasibility is that of
`RoutingTable` with costs instead of hops, so the graph of next hops has no cycle at any instant here either. Nodes of
another policy announce something else: only a base among them can be a next hop.

Where no base is reachable, staying has a price too: `hold` tolls. Then c_i = min(hold toll_i, min_j c_j + toll_i), and
data gather on the safest member of the island. There is no base to number announcements. Instead a neighbour is
feasible while its cost is below all that this node has announced for as long as anybody may remember it: along any
chain of next hops these lowest announcements fall, so it cannot close. A node that loses its base waits as long before
it looks for shelter, and one that has a route is no shelter.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from rass_mav.core.messages import NO_ROUTE, Beacon
from rass_mav.core.routes.serial import following
from rass_mav.core.routes.table import HOLD_LIFETIMES, Neighbour, RoutingTable

#: Costs are 32-bit fixed point on the wire: this many units are a cost of 1.
COST_ONE = 1 << 20
#: A neighbour silent for more than so many of its turns may have moved away.
RECENT_TURNS = 1.5
#: No way, and no shelter. One below the value that only bases announce.
NO_COST = 0xFFFFFFFE


@dataclass(frozen=True, slots=True)
class CostRules:
    """How a policy adds costs up."""

    tag: int
    """The policy's: only costs under it can be compared."""
    hold: float
    """>= 1: staying where no base is reachable costs so many tolls."""
    hysteresis: float
    """In (0, 1]: another place must cost less than this share of staying."""
    change_over: int
    """A node changes over to another base that is this much cheaper, wire units."""


class CostTable(RoutingTable):
    """Chooses the cheapest way to a base, or the cheapest place to stay."""

    __slots__ = (
        "_low",
        "_low_before",
        "_low_hold",
        "_low_since",
        "_low_window",
        "_shelter_from",
        "rules",
    )

    def __init__(
        self,
        rules: CostRules,
        node_id: int,
        epoch: int,
        *,
        base: bool = False,
        lifetime_s: float,
        step_s: float = 1.0,
        turn_s: float | None = None,
        max_neighbours: int = 128,
        max_hops: int = 250,
        restarted: float | None = None,
        number: int = 0,
    ) -> None:
        """As in `RoutingTable`. A neighbour whose last beacon is missing is chosen only if nobody else is feasible.

        `metric` is the cost from here, wire units, NO_COST: no way and no shelter.
        """
        super().__init__(
            node_id, epoch, base=base, lifetime_s=lifetime_s, step_s=step_s, turn_s=turn_s,
            max_neighbours=max_neighbours, max_hops=max_hops, restarted=restarted, number=number,
        )  # fmt: skip
        self.rules = rules
        if not base:
            self.metric = NO_COST
        self._shelter_from = -inf if restarted is None else restarted + HOLD_LIFETIMES * self.longest_s
        self._low = self._low_before = NO_COST
        self._low_since = -inf
        self._low_window = self._low_hold = 0.0

    def update(self, now: float) -> None:
        """Forget silent neighbours and choose the cheapest feasible way, else the cheapest shelter."""
        if now >= self._bound_until:
            self._bound = None
        bound = self._bound
        longest = self.lifetime_s * (self.turn_s / self.step_s)
        gone = None
        nearest = NO_ROUTE
        other = NO_COST
        best: Beacon | None = None
        best_rank = (True, True, NO_COST)
        blocked: tuple[int, int] | None = None
        node_id, tag, feasible = self.node_id, self.rules.tag, self._feasible
        for neighbour in self.neighbours.values():
            heard = neighbour.heard
            lifetime = neighbour.lifetime_s
            if heard < now - lifetime:
                gone = [neighbour.id] if gone is None else [*gone, neighbour.id]
                continue
            if lifetime > longest:
                longest = lifetime
            b = neighbour.beacon
            hops = b.hops
            if hops >= self.max_hops or b.base == node_id:
                continue
            if hops < nearest:
                nearest = hops
            if hops == 0:
                cost = 0
            elif b.policy == tag:
                cost = b.potential
            else:
                continue
            key = (b.base, b.base_epoch)
            own = feasible.get(key)
            if own is not None:
                ahead = (b.route_number - own[0]) & 0xFFFF
                if (ahead == 0 and cost >= own[1]) or ahead >= 0x8000:
                    blocked = (b.base, following(own[0]))
                    continue
            if bound is not None and key != bound:
                other = min(other, cost)
                continue
            # A full neighbour may still be the way, but data wait there.
            rank = (heard < now - RECENT_TURNS * neighbour.turn_s, not b.free, cost)
            if best is None or rank < best_rank or (rank == best_rank and self._preferred(b, best)):
                best, best_rank = b, rank
        if gone is not None:
            for id in gone:
                del self.neighbours[id]
        self.longest_s = longest
        if self.base:
            return
        self.distance = nearest + 1 if nearest != NO_ROUTE else NO_ROUTE
        if best is None or other + self.rules.change_over <= best_rank[2]:
            self.route = None
            self.wanted = blocked
            self._shelter(now)
            return
        self._shelter_from = max(self._shelter_from, now + HOLD_LIFETIMES * longest)
        self.next_hop = best.sender
        self._take(best, min(best_rank[2] + self.toll, NO_COST - 1), now)

    def _shelter(self, now: float) -> None:
        """No base is reachable: where data are safest."""
        held_to = self.next_hop
        self.next_hop = None
        if now < self._shelter_from:
            # Somebody may still count on the route that this node has lost.
            self.metric = NO_COST
            return
        stay = min(int(self.rules.hold * self.toll), NO_COST - 1)
        low = min(self._low, self._low_before)
        best: Neighbour | None = None
        best_cost = stay
        for neighbour in self.neighbours.values():
            b = neighbour.beacon
            if b.hops != NO_ROUTE or b.policy != self.rules.tag or not b.free:
                continue
            if neighbour.heard < now - RECENT_TURNS * neighbour.turn_s:
                continue
            cost = b.potential + self.toll
            limit = stay if b.sender == held_to else self.rules.hysteresis * stay
            if b.potential < low and cost < limit and cost < best_cost:
                best, best_cost = neighbour, cost
        if best is not None:
            self.next_hop = best.id
        self.metric = best_cost

    def announced(self, now: float) -> None:
        """The cost has been put into a beacon: only what costs less is feasible from now on."""
        if self.route is not None:
            super().announced(now)
            return
        # The lowest of the present window and of the one before: between one and two windows back. A window lasts as
        # long as anybody may remember what was announced in the one before, also if turns have become shorter since.
        hold = HOLD_LIFETIMES * self.longest_s
        if now - self._low_since >= self._low_window:
            self._low_before, self._low = self._low, NO_COST
            self._low_since = now
            self._low_window, self._low_hold = max(self._low_hold, hold), hold
        elif hold > self._low_hold:
            self._low_hold = hold
        self._low = min(self._low, self.metric)
