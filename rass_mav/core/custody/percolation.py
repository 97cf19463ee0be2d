"""`evict_data` of Alg. 1: which data in custody should leave a node now, and to whom, within its bandwidth."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from itertools import chain, islice

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.effects import Hand
from rass_mav.core.custody.holdings import Holding, Pending
from rass_mav.core.custody.transfers import MAX_OFFERED, Transfers
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BEACON_BASE, INLINE_BYTES, NO_ROUTE
from rass_mav.core.pace import Pace
from rass_mav.core.policy import Policy, View
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.table import RoutingTable

#: Large data that a neighbour may have from here without having passed them on. With more, both would send all the
#: time, and what is on the other side of the neighbour would not be heard.
MAX_HEAPED = 2
#: Bound: Data that a node looks at for some that have not arrived.
MOST_LOOKED_AT = 1024


class Percolation:
    """Says what should be handed over; `Sender` does it."""

    __slots__ = (
        "_by_age",
        "_custody_store",
        "_danger",
        "_exchange",
        "_id",
        "_pace",
        "_risk",
        "_rng",
        "_routing",
        "_transfers",
        "policy",
    )

    def __init__(
        self, custody_store: CustodyStore, transfers: Transfers, routing: RoutingTable, pace: Pace, policy: Policy,
        risk: RiskEstimator, rng: random.Random,
    ) -> None:  # fmt: skip
        self._id = custody_store.settings.node_id
        self._custody_store = custody_store
        self._exchange = custody_store.exchange
        self._transfers = transfers
        self._routing = routing
        self._pace = pace
        self.policy = policy
        self._risk = risk
        self._rng = rng
        self._by_age = False
        """Whether the next datum is chosen by its age; if not, by its priority."""
        self._danger = 0
        """The node's own risk as it announces it, 0..65535; 0: data are in no danger here."""

    def probes(self) -> Iterator[Hand]:
        """One datum for each neighbour that is suspected, if none is on its way there."""
        custody_store, pace = self._custody_store, self._pace
        if not custody_store.journal.suspecting:
            return
        for target in custody_store.journal.probes(self._routing):
            if pace.left <= pace.reserved or self._under_way(target):
                continue
            small = (h for h in custody_store.holdings.custody.values() if h.pending is None and h.size <= INLINE_BYTES)
            for holding in islice(self._few_unproven(small, 1), 1):
                yield Hand(holding, target)

    def plan(self, potential: int, now: float) -> Iterator[Hand]:
        """What the policy hands over. `potential`: the node's own as announced."""
        pace, routing = self._pace, self._routing
        neighbours = routing.neighbours
        if pace.left <= pace.reserved or not neighbours:
            return
        risk = self._risk.risk(now)
        self._danger = round(65535.0 * risk) if self._risk.in_danger(now) else 0
        # A neighbour that has probably moved away is tried only if no other is fit.
        view = View(
            [n for n in neighbours.values() if not (n.suspected or n.is_missing(now))],
            neighbours.get(routing.next_hop) if routing.next_hop is not None else None,
            routing.distance, potential, risk, pace.left - pace.reserved, self._for_neighbour, self._rng,
        )  # fmt: skip
        plan = self.policy.plan(view)
        if not plan and len(view.neighbours) < len(neighbours):
            view.neighbours = neighbours.values()
            plan = self.policy.plan(view)
        for id, target in plan:
            holding = self._custody_store.holdings.custody[id]
            if holding.share:
                target = self._apart(holding, target, view)
            if holding.size <= INLINE_BYTES or self._takes_large(target):
                yield Hand(holding, target)
                self._by_age = not self._by_age

    def detours(self, detours: Iterable[tuple[Holding, int]]) -> Iterator[Hand]:
        """What came back into custody for lack of a receipt, by another way: data and neighbours."""
        custody = self._custody_store.holdings.custody
        for holding, target in detours:
            if (
                holding.id in custody
                and self._pace.left > 0
                and (holding.size <= INLINE_BYTES or self._transfers.free(target))
            ):
                yield Hand(holding, target)

    def scattered(self, now: float) -> Iterator[Hand]:
        """Where no base can be reached, the shares created here do not rest on one drone: each goes to the neighbour
        that its number falls to, or stays. Those who get one keep it."""
        custody_store, pace = self._custody_store, self._pace
        if self._routing.hops != NO_ROUTE:
            return
        near = sorted(
            neighbour.id
            for neighbour in self._routing.neighbours.values()
            if neighbour.beacon.free and not (neighbour.suspected or neighbour.is_missing(now))
        )
        places = [self._id, *near]
        for holding in list(custody_store.holdings.shares.values()):
            target = places[holding.id.sequence % len(places)]
            if pace.left <= pace.reserved:
                return
            if target == self._id or holding.pending is not None:
                continue
            if holding.size <= INLINE_BYTES or self._transfers.free(target):
                yield Hand(holding, target)

    def _apart(self, holding: Holding, target: int, view: View) -> int:
        """Where a share goes, instead of to the neighbour that the policy has chosen: of those that make at least half
        of its progress the one that its number falls to. A drone that fails thus has few shares of a file."""
        best = self._routing.neighbours.get(target)
        if best is None or best.beacon.flags & BEACON_BASE:
            return target
        half = (best.beacon.potential + view.potential) / 2
        sign = 1 if self.policy.costs is None else -1
        fit = sorted(
            neighbour.id
            for neighbour in view.neighbours
            if neighbour.beacon.policy == best.beacon.policy
            and neighbour.beacon.free
            and not neighbour.beacon.flags & BEACON_BASE
            and sign * neighbour.beacon.potential >= sign * half
        )
        return fit[holding.id.sequence % len(fit)] if target in fit else target

    def _for_neighbour(self, neighbour: int) -> Iterator[DatumId]:
        """Held data that can be handed over to a neighbour now, least recently used first.

        Where they differ in priority, every other one is the most urgent instead. A datum waits for at most twice as
        many others as without priorities, whatever these claim. A neighbour that is suspected is given few.

        Large data wait while no more transfers to the neighbour can begin. Small data behind them do not wait. In nine
        turns of ten, data of which another copy has probably arrived, or moves on, wait too.
        """
        custody_store, pace, holdings = self._custody_store, self._pace, self._custody_store.holdings
        allowance = custody_store.journal.allowance(neighbour)
        large = MAX_OFFERED if self._takes_large(neighbour) else 0
        most = None
        if allowance is not None:
            most = max(0, allowance - self._under_way(neighbour))

        def free(custody: Iterable[Holding]) -> Iterator[Holding]:
            found: Iterator[Holding] = (holding for holding in custody if holding.pending is None)
            if most is not None:
                found = self._few_unproven(islice(found, MOST_LOOKED_AT), most)
            if not pace.spares:
                found = self._not_waiting(found)
            return self._few_large(found, large)

        chosen = free(holdings.custody.values())
        if allowance is None and holdings.by_terms.differ:
            chosen = self._few_large(_by_turns(free(holdings.by_terms.urgent()), chosen, self._by_age), large)
        return (holding.id for holding in chosen)

    def _under_way(self, neighbour: int) -> int:
        """How many data are being handed over to a neighbour."""
        return sum(pending.to == neighbour for pending in self._exchange.of(Pending))

    def _few_unproven(self, holdings: Iterator[Holding], most: int) -> Iterator[Holding]:
        """For a neighbour that is suspected: so many data first whose arrival would count for it, or would be news at
        least, the oldest first. What has arrived says nothing of it, and does not wait for that."""
        arrived: list[Holding] = []
        unproven: list[Holding] = []
        for holding in holdings:
            (arrived if holding.id in self._custody_store.receipts else unproven).append(holding)
        unproven.sort(key=self._custody_store.is_proof, reverse=True)
        return chain(unproven[:most], arrived)

    def _not_waiting(self, holdings: Iterator[Holding]) -> Iterator[Holding]:
        """The same without data that may wait, as far as a node looks at a time."""
        for holding in islice(holdings, MOST_LOOKED_AT):
            if holding.id not in self._custody_store.arrived:
                yield holding
        yield from holdings

    def _few_large(self, holdings: Iterator[Holding], large: int) -> Iterator[Holding]:
        """The same with so many large data at most: more cannot begin, and small ones behind them do not wait."""
        for holding in holdings:
            if holding.size > INLINE_BYTES:
                large -= 1
                if large < 0:
                    continue
            yield holding

    def _takes_large(self, neighbour: int) -> bool:
        """Whether a large datum can be handed over to a neighbour now. Data in danger do not wait until a safer one has
        passed others on."""
        there, partner = self._routing.neighbours.get(neighbour), self._custody_store.holdings.partners.get(neighbour)
        heaped = partner is not None and partner.large >= MAX_HEAPED
        saves = there is not None and there.beacon.risk < self._danger
        return self._transfers.free(neighbour) and (saves or not heaped)


def _by_turns(urgent: Iterator[Holding], oldest: Iterator[Holding], by_age: bool) -> Iterator[Holding]:
    """The same data in two orders, as one: the next of each in turn. `by_age`: begin with the oldest."""
    seen: set[DatumId] = set()
    while True:
        holding = next((holding for holding in (oldest if by_age else urgent) if holding.id not in seen), None)
        if holding is None:
            return
        seen.add(holding.id)
        yield holding
        by_age = not by_age
