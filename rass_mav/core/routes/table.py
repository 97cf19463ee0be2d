"""The routing table (Alg. 2) with announcement numbers, ageing and bounds.

Alg. 2 as written counts to infinity when the base vanishes: two nodes go on quoting each other's hop count. Here each
announcement of a base carries a number, and a neighbour's route is taken only if it is feasible (Babel, RFC 8966,
section 2.4 and 3.5): newer than what this node has announced itself, or as new and strictly shorter. So the
graph of next hops has no cycle at any instant, and a route without a base dies out in as many steps as it has hops.

Feasibility compares announcements of one base. Between bases, a node that changes over announces no route for as long
as somebody may still remember its old one; then nobody relies on it, and it cannot close a cycle.
"""

from __future__ import annotations

from math import inf

from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, NO_ROUTE, Beacon, Route
from rass_mav.core.routes.serial import following, newer

#: A beacon this little behind the newest one is a late or doubled frame; one further behind is a restarted neighbour.
_LATE_WINDOW = 32
#: A node changes over to another base when its own is out of reach, or this many hops farther than the other.
CHANGE_OVER_HOPS = 3
#: For so many lifetimes somebody may count on a route after its last announcement: a beacon travels for one at most, is
#: remembered for another, and forgotten at the next step only.
HOLD_LIFETIMES = 2.5
#: A neighbour of whose beacons fewer than this were missed of late is on a clean link (`Neighbour.missed`).
CLEAN_MISSED = 0.2
_MOST_MISSED = 8
#: How many bases a node remembers feasibility distances of.
MAX_BASES = 16


class Neighbour:
    """A neighbour as its last beacon described it."""

    __slots__ = ("beacon", "heard", "id", "lifetime_s", "missed", "turn_s")

    def __init__(self, beacon: Beacon, heard: float, turn_s: float = 1.0, lifetime_s: float = 3.5) -> None:
        self.id = beacon.sender
        self.beacon = beacon
        self.heard = heard
        """When the beacon was heard, seconds."""
        self.turn_s = turn_s
        """It says a beacon every so many seconds."""
        self.lifetime_s = lifetime_s
        """If it is silent for longer, it is gone."""
        self.missed = 1.0
        """Beacons missed of late: each one counts a fifth less with each that is heard."""

    @property
    def clean(self) -> bool:
        """Whether hardly any beacon is missed on this link: then one that is missing means that it has broken."""
        return self.missed < CLEAN_MISSED


class RoutingTable:
    """Who is around, and the way to a base. One route is chosen; several bases compete like an anycast."""

    __slots__ = (
        "_asked",
        "_bound",
        "_bound_until",
        "_feasible",
        "base",
        "distance",
        "epoch",
        "lifetime_s",
        "longest_s",
        "max_hops",
        "max_neighbours",
        "metric",
        "neighbours",
        "next_hop",
        "node_id",
        "number",
        "route",
        "step_s",
        "toll",
        "turn_s",
        "wanted",
    )

    def __init__(
        self,
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
        """`lifetime_s`: a neighbour silent for longer is gone; no frame travels for longer. `max_hops` 1..254.
        `step_s`: beacons are usually that far apart; who says that its own are farther apart lives longer accordingly.
        `turn_s`: how far apart the own ones are; None: `step_s`.

        `restarted`: when a node starts that has announced routes in an earlier life, without its feasibility distances:
        it takes no route until all neighbours have forgotten those. `number`: a base's first announcement number.
        """
        if not 1 <= max_hops <= 254:
            raise ValueError("max_hops must be in 1..254")
        self.node_id = node_id
        self.epoch = epoch
        self.base = base
        self.lifetime_s = lifetime_s
        self.step_s = step_s
        self.turn_s = step_s if turn_s is None else max(step_s, turn_s)
        self.longest_s = lifetime_s * (self.turn_s / step_s)
        """The longest that this node or a neighbour is remembered by what it said last, seconds."""
        self.max_neighbours = max_neighbours
        self.max_hops = max_hops
        self.number = number
        self.neighbours: dict[int, Neighbour] = {}
        self.next_hop: int | None = None
        self.route: Route | None = Route(node_id, epoch, number, 0) if base else None
        """The chosen route; its hops are counted from this node."""
        self.distance = 0 if base else NO_ROUTE
        """Fewest hops that any neighbour announces, plus one: h of Eq. 3. It is known even while no route is feasible;
        then it is not announced, so that nobody counts on it."""
        self.metric = 0
        """What feasibility compares of the chosen route, counted from this node: its hops (`CostTable`: its cost)."""
        self.toll = 1
        """What a hop from this node adds to the metric."""
        self.wanted: tuple[int, int] | None = None
        """(base id, number) this node asks for, for itself or for a neighbour."""
        self._bound: tuple[int, int] | None = None if restarted is None else (-1, -1)
        """The base that this node announced a route to last: no other may be taken before `_bound_until`."""
        self._bound_until = -inf if restarted is None else restarted + HOLD_LIFETIMES * self.longest_s
        self._feasible: dict[tuple[int, int], tuple[int, int]] = {}
        self._asked: tuple[int, int, float] | None = None

    def hear(self, beacon: Beacon, now: float) -> bool:
        """Take in a neighbour's beacon. False: a duplicate, a late one, or there is no room for a new neighbour."""
        known = self.neighbours.get(beacon.sender)
        turn_s = max(self.step_s, beacon.turn / 10) if beacon.turn else self.step_s
        lifetime_s = self.lifetime_s * (turn_s / self.step_s) if beacon.turn else self.lifetime_s
        if known is None:
            if len(self.neighbours) >= self.max_neighbours and not self._make_room(beacon):
                return False
            self.neighbours[beacon.sender] = Neighbour(beacon, now, turn_s, lifetime_s)
        else:
            last = known.beacon
            if (last.number - beacon.number) & 0xFFFF < _LATE_WINDOW and last.epoch == beacon.epoch:
                return False
            known.missed = 0.8 * known.missed + min((beacon.number - last.number - 1) & 0xFFFF, _MOST_MISSED)
            known.beacon = beacon
            known.heard = now
            known.turn_s = turn_s
            known.lifetime_s = lifetime_s
        if beacon.flags & BEACON_WANTED:
            self._hear_request(beacon.wanted_base, beacon.wanted_number, now)
        return True

    def _make_room(self, beacon: Beacon) -> bool:
        worst = min(self.neighbours.values(), key=lambda n: (n.beacon.potential, n.id))
        if worst.beacon.potential >= beacon.potential or worst.id == self.next_hop:
            return False
        del self.neighbours[worst.id]
        return True

    def _hear_request(self, base: int, number: int, now: float) -> None:
        if self.base:
            if base == self.node_id and newer(number, self.number):
                self.raise_number()
        elif self.route is not None and self.route.base == base and newer(number, self.route.number):
            # Only who has a route passes a request on, so requests die out where no base is reachable.
            self._asked = (base, number, now + self.longest_s)

    def raise_number(self) -> None:
        """As a base: announce anew (every `routing.seq_period` steps, or on request)."""
        self.number = following(self.number)
        self.route = Route(self.node_id, self.epoch, self.number, 0)

    def feasible(self, route: Route) -> bool:
        """Whether a route heard from a neighbour may be taken without risking a loop (RFC 8966, 3.5.1)."""
        own = self._feasible.get((route.base, route.base_epoch))
        if own is None or newer(route.number, own[0]):
            return True
        return route.number == own[0] and route.hops < own[1]

    def update(self, now: float) -> None:
        """Forget silent neighbours and choose the route: fewest hops, then newest, then the present next hop."""
        if now >= self._bound_until:
            self._bound = None
        bound_base, bound_epoch = self._bound or (None, None)
        longest = self.lifetime_s * (self.turn_s / self.step_s)
        neighbours = self.neighbours
        gone = None
        nearest = other = NO_ROUTE
        best: Beacon | None = None
        blocked: tuple[int, int] | None = None
        node_id = self.node_id
        feasible = self._feasible
        for neighbour in neighbours.values():
            lifetime = neighbour.lifetime_s
            if neighbour.heard < now - lifetime:
                gone = [neighbour.id] if gone is None else [*gone, neighbour.id]
                continue
            if lifetime > longest:
                longest = lifetime
            b = neighbour.beacon
            hops = b.hops
            if hops >= self.max_hops or (best is not None and hops > best.hops) or b.base == node_id:
                continue
            if hops < nearest:
                nearest = hops
            own = feasible.get((b.base, b.base_epoch))
            if own is not None:
                ahead = (b.route_number - own[0]) & 0xFFFF
                if ahead == 0:
                    if hops >= own[1]:
                        blocked = (b.base, following(own[0]))
                        continue
                elif ahead >= 0x8000:
                    blocked = (b.base, following(own[0]))
                    continue
            if bound_base is not None and (b.base != bound_base or b.base_epoch != bound_epoch):
                other = min(other, hops)
                continue
            if best is None or hops < best.hops or self._preferred(b, best):
                best = b
        if gone is not None:
            for id in gone:
                del neighbours[id]
        self.longest_s = longest
        if self.base:
            return
        self.distance = nearest + 1 if nearest != NO_ROUTE else NO_ROUTE
        if best is None or other + CHANGE_OVER_HOPS <= best.hops:
            self.route = None
            self.next_hop = None
            self.wanted = blocked
            return
        self.next_hop = best.sender
        self._take(best, best.hops + 1, now)

    def _take(self, best: Beacon, metric: int, now: float) -> None:
        """Choose the route that a neighbour announces, and pass on requests for newer numbers."""
        self.metric = metric
        route = self.route
        hops = best.hops + 1
        if (
            route is None
            or route.hops != hops
            or route.number != best.route_number
            or route.base != best.base
            or route.base_epoch != best.base_epoch
        ):
            self.route = route = Route(best.base, best.base_epoch, best.route_number, hops)
        self.wanted = None
        if self._asked is not None:
            base, number, until = self._asked
            if now <= until and route.base == base and newer(number, route.number):
                self.wanted = (base, number)
            else:
                self._asked = None

    def _preferred(self, b: Beacon, best: Beacon) -> bool:
        """Between routes of as many hops: the newer announcement of the same base, else the present next hop."""
        if (b.base, b.base_epoch) == (best.base, best.base_epoch) and b.route_number != best.route_number:
            return newer(b.route_number, best.route_number)
        return b.sender == self.next_hop

    def announced(self, now: float) -> None:
        """The chosen route has been put into a beacon: from now on only better ones are feasible (RFC 8966, 3.7.3)."""
        route = self.route
        if route is None or self.base:
            return
        key = (route.base, route.base_epoch)
        self._bound = key
        self._bound_until = max(self._bound_until, now + HOLD_LIFETIMES * self.longest_s)
        feasible = self._feasible
        own = feasible.get(key)
        best = (route.number, self.metric)
        if own is not None:
            if (self.metric >= own[1]) if own[0] == route.number else not newer(route.number, own[0]):
                best = own
            if len(feasible) > 1:
                # Kept in the order of use, so that the base in use is the last to be forgotten.
                del feasible[key]
        elif len(feasible) >= MAX_BASES:
            del feasible[next(iter(feasible))]
        feasible[key] = best

    @property
    def longest_turn_s(self) -> float:
        """The longest turn, seconds, among this node's and its neighbours': an answer may take so long."""
        return self.step_s * (self.longest_s / self.lifetime_s)

    @property
    def hops(self) -> int:
        """Own hop count, or NO_ROUTE."""
        return NO_ROUTE if self.route is None else self.route.hops


def is_base(beacon: Beacon) -> bool:
    """Whether the sender of a beacon is a base."""
    return bool(beacon.flags & BEACON_BASE)
