"""The routing table (Alg. 2 of the paper) with announcement numbers: one for hops and for costs (`ranks`).

Alg. 2 as written counts to infinity when the base vanishes: two nodes continue to quote each other's hop count. Here
each announcement of a base has a number, and a node uses a neighbour's route only if it is feasible (Babel, RFC 8966,
sections 2.4 and 3.5.1): newer than what this node has announced itself, or as new and of a strictly lower metric. So
the graph of next hops has no cycle at any instant, and a route without a base dies out in as many steps as it has hops.

Feasibility compares announcements of one base. Between bases, a node that changes announces no route for as long as any
node may still remember its old one. Then no node relies on it, and it cannot close a cycle.
"""

from __future__ import annotations

from math import inf

from rass_mav.core.messages import BEACON_WANTED, NO_ROUTE, Beacon, Route
from rass_mav.core.routes.announcements import following, newer
from rass_mav.core.routes.contacts import Contacts
from rass_mav.core.routes.costs import Toll
from rass_mav.core.routes.neighbours import Neighbour, Neighbours
from rass_mav.core.routes.ranks import Rank
from rass_mav.core.settings import NodeSettings

#: Fact: Lifetimes for which other nodes may count on a route after its last announcement: a beacon travels for at most
#: one, is remembered for another, and forgotten only at the next step.
HOLD_LIFETIMES = 2.5
#: For how many bases a node remembers feasibility distances.
MAX_BASES = 16
#: No node announces more hops than this, 1..254.
MAX_HOPS = 250


class RoutingTable:
    """The neighbours, and the route to a base. One route is chosen; several bases compete like an anycast."""

    __slots__ = (
        "_asked",
        "_bound",
        "_bound_until",
        "base",
        "distance",
        "feasible",
        "life",
        "lifetime_s",
        "longest_s",
        "metric",
        "neighbours",
        "next_hop",
        "node_id",
        "rank",
        "route",
        "step_s",
        "toll",
        "turn_s",
        "wanted",
    )  # fmt: skip

    def __init__(
        self, settings: NodeSettings, life: int, rank: Rank, *, turn_s: float = 0.0, restarted: float | None = None
    ) -> None:
        """`life`: of this node, as sent in its beacons. `turn_s`: the time between its beacons, if more than a step.

        `restarted`: when a node starts that has announced routes in an earlier life, without its feasibility distances:
        it uses no route until all neighbours have forgotten those.
        """
        self.node_id = settings.node_id
        self.life = life
        self.base = settings.base
        self.rank = rank
        self.step_s = settings.step_s
        self.turn_s = max(settings.step_s, turn_s)
        self.lifetime_s = (settings.routing.neighbour_steps + 0.5) * settings.step_s
        """A neighbour silent for longer is gone, unless its turns are longer; no frame travels for longer."""
        self.longest_s = self.lifetime_s * (self.turn_s / self.step_s)
        """The longest time that this node or a neighbour is remembered after its last beacon, seconds."""
        self.neighbours = Neighbours(
            self.step_s, self.lifetime_s, settings.routing.max_neighbours, rank.standing, expects_loss=settings.measured
        )
        self.neighbours.contacts = Contacts() if settings.has("contacts") else None
        self.next_hop: int | None = None
        self.route: Route | None = None
        """The chosen route; its hops are counted from this node. At a base: what it announces (`announce`)."""
        self.distance = 0 if self.base else NO_ROUTE
        """Fewest hops that any neighbour announces, plus one: h of Eq. 3. It is known even while no route is feasible;
        it is then not announced, so that no node counts on it."""
        self.metric = 0 if self.base else rank.no_way
        """The chosen route's value in feasibility comparisons, counted from this node: its hops, or its cost, wire
        units."""
        self.toll = Toll(1)
        """What a hop from this node adds to the metric."""
        self.wanted: tuple[int, int] | None = None
        """(base id, number) that this node requests, for itself or for a neighbour."""
        self._bound: tuple[int, int] | None = None if restarted is None else (-1, -1)
        """The base of the last route that this node announced: it may use no other before `_bound_until`."""
        self._bound_until = -inf if restarted is None else restarted + HOLD_LIFETIMES * self.longest_s
        self.feasible: dict[tuple[int, int], tuple[int, int]] = {}
        """Feasibility distances, (number, metric), by (base id, base life): Babel's source table (RFC 8966, 3.2.5)."""
        self._asked: tuple[int, int, float] | None = None
        """(base id, number, until when) that neighbours request; at a base: the newest since it last announced."""

    def hear(self, beacon: Beacon, now: float) -> bool:
        """Process a neighbour's beacon. False: it is a duplicate or late, or there is no space for a new neighbour."""
        if not self.neighbours.hear(beacon, now, self.next_hop):
            return False
        if beacon.flags & BEACON_WANTED:
            self._hear_request(beacon.wanted_base, beacon.wanted_number, now)
        if self.base and (beacon.base, beacon.base_life) == (self.node_id, self.life) and beacon.hops != NO_ROUTE:
            number = beacon.route_number
            if number != self.number and not newer(self.number, number):
                # It was sent in this base's name, and a node that uses it as a route will accept nothing older.
                self._hear_request(self.node_id, following(number), now)
        return True

    def _hear_request(self, base: int, number: int, now: float) -> None:
        """A neighbour needs an announcement of this base with this number or a newer one (RFC 8966, 3.8.1.2)."""
        route = self.route
        if route is None or route.base != base or number == route.number or newer(route.number, number):
            # Only a node that has a route relays a request, so requests die out where no base is reachable.
            return
        asked = self._asked
        if not self.base or asked is None or newer(number, asked[1]):
            self._asked = (base, number, now + self.longest_s)

    def forget(self, base: int, base_life: int) -> None:
        """Compare the announcements of a base with none from before: so many have passed that 16 bits cannot tell."""
        self.feasible.pop((base, base_life), None)

    @property
    def number(self) -> int:
        """At a base: the announcement number, 16 bits."""
        return 0 if self.route is None else self.route.number

    @property
    def requested(self) -> int | None:
        """At a base: the newest number that neighbours have requested since the last `announce`, if it must be newer
        than the present one."""
        return None if self._asked is None else self._asked[1]

    def announce(self, number: int) -> None:
        """At a base: announce this number from now on."""
        self._asked = None
        if self.route is None or self.route.number != number:
            self.route = Route(self.node_id, self.life, number, 0)

    def update(self, now: float) -> None:
        """Forget silent neighbours and choose the route (Alg. 2: the minimum of what the neighbours announce)."""
        longest_s = self.neighbours.age(now)
        own_s = self.lifetime_s * (self.turn_s / self.step_s)
        self.longest_s = longest_s if longest_s > own_s else own_s
        if self.base:
            return
        if now >= self._bound_until:
            self._bound = None
        best, metric = self._best(now)
        if best is not None:
            self._take(best.beacon, metric, now)
            return
        self.route = None
        if self._bound is None:
            self.next_hop, self.metric = self.rank.shelter(self.neighbours.values(), self.toll.hop, self.next_hop, now)
        else:
            # Other nodes may still count on the route that this node has lost.
            self.next_hop, self.metric = None, self.rank.no_way

    def _best(self, now: float) -> tuple[Neighbour | None, int]:
        """The best feasible route and its metric (RFC 8966, 3.5.1 and 3.6). None: there is none, or a change of base is
        due.

        It also finds the distance, and what to request if no route is taken.
        """
        rank, tag, bound, node_id = self.rank, self.rank.tag, self._bound, self.node_id
        nearest = nearest_feasible = nearest_suspected = NO_ROUTE
        farthest = MAX_HOPS - 1
        best: Neighbour | None = None
        best_behind = 0
        best_metric = rank.no_way
        # By neighbours that are not suspected, and by those that are.
        elsewhere = [rank.no_way, rank.no_way]
        # About the base that the last neighbour announced; in most cases the next one announces the same.
        base = base_life = -1
        own_number, own_metric = -1, 0
        other = False
        wanted: tuple[int, int] | None = None
        for neighbour in self.neighbours.values():
            beacon = neighbour.beacon
            hops = beacon.hops
            if hops > farthest or (announced := beacon.base) == node_id:
                continue
            suspected = neighbour.suspected
            if suspected:
                nearest_suspected = min(nearest_suspected, hops)
            elif hops < nearest:
                nearest = hops
            if announced != base or beacon.base_life != base_life:
                base, base_life = key = announced, beacon.base_life
                own_number, own_metric = self.feasible.get(key, (-1, 0))
                other = bound is not None and key != bound
            if tag is None or not hops:
                metric = hops
            elif beacon.policy == tag:
                metric = beacon.potential
            else:
                continue
            number = beacon.route_number
            if own_number >= 0 and (metric >= own_metric if number == own_number else not newer(number, own_number)):
                wanted = key
                continue
            nearest_feasible = hops if hops < nearest_feasible and not suspected else nearest_feasible
            if tag is not None and neighbour.odds > 1.0:
                # Feasible is what it announces; what counts from here on is what it delivers.
                metric = self._expected(metric, neighbour.odds)
            if other:
                elsewhere[suspected] = min(elsewhere[suspected], metric)
            elif best is None or metric <= best_metric or best_behind:
                behind = rank.behind(neighbour, now)
                worse = behind - best_behind or metric - best_metric
                if best is None or worse < 0 or (not worse and self._preferred(neighbour, best)):
                    best, best_behind, best_metric = neighbour, behind, metric
                    if tag is None and not behind:
                        # By hops, neighbours that are farther need not be considered.
                        farthest = hops
        self.wanted = None if wanted is None else (wanted[0], following(self.feasible[wanted][0]))
        if nearest == NO_ROUTE or (nearest_feasible == NO_ROUTE and nearest_suspected < nearest):
            # Those that are not suspected may count on this node: data would rest at the one that seems to be nearer.
            nearest = nearest_suspected
        self.distance = nearest + 1 if nearest != NO_ROUTE else NO_ROUTE
        return (None if best is None or self._changes(best, best_metric, *elsewhere) else best), best_metric

    def _changes(self, best: Neighbour, metric: int, elsewhere: int, suspected: int) -> bool:
        """Whether to change to another base. `elsewhere`, `suspected`: the best metrics of ways there, by neighbours
        that are not suspected, and by those that are: such a way is not worth leaving one that is not."""
        if best.suspected and elsewhere != self.rank.no_way:
            return True
        return (suspected if best.suspected else elsewhere) + self.rank.change_over <= metric

    def _expected(self, metric: int, odds: float) -> int:
        """The metric of a way by a neighbour that does not deliver all it takes: the last hop has to be repeated."""
        toll = sum(self.toll)
        return min(int((metric + toll) * odds) - toll, self.rank.no_way - 1)

    def _preferred(self, neighbour: Neighbour, best: Neighbour) -> bool:
        """Between routes of the same rank: the newer announcement of the same base, else the present next hop."""
        a, b = neighbour.beacon, best.beacon
        if a.route_number != b.route_number and (a.base, a.base_life) == (b.base, b.base_life):
            return newer(a.route_number, b.route_number)
        return neighbour.id == self.next_hop

    def _take(self, beacon: Beacon, metric: int, now: float) -> None:
        """Choose the route that a neighbour announces, and relay requests for newer numbers (RFC 8966, 3.8.1.2)."""
        self.next_hop = beacon.sender
        metric += sum(self.toll)
        self.metric = metric if metric < self.rank.no_way else self.rank.no_way - 1
        base, number = beacon.base, beacon.route_number
        way = (base, beacon.base_life, number, beacon.hops + 1)
        if self.route != way:
            self.route = Route(*way)
        self.wanted = None
        if self._asked is not None:
            wanted_base, wanted_number, until = self._asked
            if now <= until and wanted_base == base and wanted_number != number and not newer(number, wanted_number):
                self.wanted = (wanted_base, wanted_number)
            else:
                self._asked = None

    def another_way(self, than: int, now: float) -> int | None:
        """The neighbour nearest to a base, except one that had its chance; None: no other has a route and space."""
        ways = [n for n in self.neighbours.values() if n.id != than and n.beacon.hops != NO_ROUTE and n.beacon.free]
        return min(ways, key=lambda neighbour: self._distance(neighbour, now)).id if ways else None

    def _distance(self, neighbour: Neighbour, now: float) -> tuple[bool, int, int, int, int]:
        rank, beacon = self.rank, neighbour.beacon
        # A neighbour whose cost cannot be compared is used only if there is no other.
        foreign = rank.tag is not None and beacon.hops > 0 and beacon.policy != rank.tag
        metric = beacon.hops if rank.tag is None or foreign or not beacon.hops else beacon.potential
        return neighbour.suspected, rank.behind(neighbour, now), foreign, metric, neighbour.id

    def announced(self, now: float) -> None:
        """The table has been put into a beacon: from now on only better routes are feasible (RFC 8966, 3.7.3)."""
        if self.base:
            return
        route = self.route
        hold_s = HOLD_LIFETIMES * self.longest_s
        if route is None:
            self.rank.announced(self.metric, hold_s, now)
            return
        base, base_life, number, _ = route
        self._bound = key = (base, base_life)
        self._bound_until = max(self._bound_until, now + hold_s)
        feasible = self.feasible
        own = feasible.get(key)
        best = (number, self.metric)
        if own is not None:
            if (self.metric >= own[1]) if own[0] == number else not newer(number, own[0]):
                best = own
            if len(feasible) > 1:
                # Kept in the order of use, so that the base in use is the last to be forgotten.
                del feasible[key]
        elif len(feasible) >= MAX_BASES:
            del feasible[next(iter(feasible))]
        feasible[key] = best

    @property
    def longest_turn_s(self) -> float:
        """The longest turn of this node and its neighbours, seconds: the longest time that an answer may take."""
        return self.step_s * (self.longest_s / self.lifetime_s)

    @property
    def hops(self) -> int:
        """Own hop count, or NO_ROUTE."""
        return NO_ROUTE if self.route is None else self.route.hops
