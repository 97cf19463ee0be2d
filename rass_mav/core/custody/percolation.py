"""`evict_data` of Alg. 1: what leaves a node in a step, within its bandwidth."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from itertools import chain, islice

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.holdings import Holding, Pending
from rass_mav.core.custody.transfers import MAX_OFFERED, Transfers
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.exchange import MOST_DOUBLINGS
from rass_mav.core.messages import BEACON_BASE, INLINE_BYTES, NO_ROUTE, Data, Handover, Message
from rass_mav.core.pace import Pace
from rass_mav.core.policy import Policy, View
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.table import RoutingTable

#: Unanswered transmissions after which another neighbour may be chosen.
MAX_TRIES = 8
#: From this risk on a hand-over is sent again as soon as its answer is late: what stays here may be gone in a turn.
DANGER = 0.05
#: Large data that a neighbour may have from here without having passed them on. With more, both would send all the
#: time, and what is on the other side of the neighbour would not be heard.
MAX_HEAPED = 2
#: Data that a node looks at for some that have not arrived, while the air is full or the neighbour is suspected.
MOST_LOOKED_AT = 1024
#: Turns for which a datum that the receiver was heard to hand over is not sent to it again.
MOVING_TURNS = 4


class Percolation:
    """The order is: retransmissions, data that take another route than before, the policy's plan, replicas of resting
    data."""

    __slots__ = (
        "_batches",
        "_by_age",
        "_custody_store",
        "_exchange",
        "_id",
        "_in_danger",
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
        self._batches: dict[int, list[Handover]] = {}
        """The hand-overs to each neighbour, until they are sent."""
        self._by_age = False
        """Whether the next datum is chosen by its age; if not, by its priority."""
        self._in_danger = False

    def evict(self, potential: int, now: float, out: list[Message]) -> None:
        """Send what has to leave. `potential`: the node's own as announced; `out` receives the messages."""
        self._retry(now, out)
        if self._routing.hops == NO_ROUTE:
            self._scatter(now, out)
        for holding, target in self._custody_store.replicas.detours():
            if self._pace.left > 0 and (holding.size <= INLINE_BYTES or self._transfers.free(target)):
                self._hand_over(holding, target, now, out)
        self.forward(potential, now, out)

    def forward(self, potential: int, now: float, out: list[Message]) -> None:
        """The same between two turns."""
        pace = self._pace
        self._in_danger = self._risk.risk(now) >= DANGER
        if pace.left > 0 and self._routing.neighbours:
            if self._custody_store.journal.suspecting:
                for target in self._custody_store.journal.probes(self._routing):
                    self._probe(target, now, out)
            if pace.left > pace.reserved:
                self._percolate(potential, now, out)
            self._custody_store.replicas.spread(now, out)
        self._flush(out)

    def tend(self, now: float, out: list[Message]) -> None:
        """Between two turns: repeat what is late, and in danger here."""
        self._retry(now, out)
        self._flush(out)

    def _flush(self, out: list[Message]) -> None:
        if self._batches:
            out += [Data(self._id, target, tuple(handovers)) for target, handovers in self._batches.items()]
            self._batches.clear()

    def _probe(self, target: int, now: float, out: list[Message]) -> None:
        """Hand one datum over to a neighbour that is suspected, if none is on its way there."""
        holdings = self._custody_store.holdings
        if self._pace.left <= self._pace.reserved or self._under_way(target):
            return
        small = (h for h in holdings.custody.values() if h.pending is None and h.size <= INLINE_BYTES)
        for holding in islice(self._few_unproven(small, 1), 1):
            self._hand_over(holding, target, now, out)

    def _percolate(self, potential: int, now: float, out: list[Message]) -> None:
        custody_store, pace, routing = self._custody_store, self._pace, self._routing
        neighbours = routing.neighbours
        # A neighbour that has probably moved away is tried only if no other is fit.
        view = View(
            [n for n in neighbours.values() if not (n.suspected or n.is_missing(now))],
            neighbours.get(routing.next_hop) if routing.next_hop is not None else None,
            routing.distance, potential, self._risk.risk(now), pace.left - pace.reserved, self._for_neighbour,
            self._rng,
        )  # fmt: skip
        plan = self.policy.plan(view)
        if not plan and len(view.neighbours) < len(neighbours):
            view.neighbours = neighbours.values()
            plan = self.policy.plan(view)
        for id, target in plan:
            holding = custody_store.holdings.custody[id]
            if holding.share:
                target = self._apart(holding, target, view)
            if holding.size <= INLINE_BYTES or self._takes_large(target):
                self._hand_over(holding, target, now, out)
                self._by_age = not self._by_age

    def _scatter(self, now: float, out: list[Message]) -> None:
        """Where no base can be reached, the shares created here do not rest on one drone: each goes to the neighbour
        that its number falls to, or stays. Those who get one keep it."""
        custody_store, pace = self._custody_store, self._pace
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
                self._hand_over(holding, target, now, out)

    def _apart(self, holding: Holding, target: int, view: View) -> int:
        """Where a share goes, instead of to the neighbour that the policy has chosen: of those that make at least half
        of its progress the one that its number falls to. So one drone that fails has few shares of a file."""
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

    def _hand_over(self, holding: Holding, target: int, now: float, out: list[Message]) -> None:
        """Hand a datum over to a neighbour; a large one only to a neighbour that is free for a transfer."""
        custody_store = self._custody_store
        datum = custody_store.load(holding)
        if datum is None:
            return
        if holding.size > INLINE_BYTES:
            self._transfers.begin(holding, datum, target, now, out)
            return
        number = 0
        if custody_store.settings.acknowledged:
            number = self._exchange.draw()
            pending = Pending(number, holding.id, target, now)
            self._wait(pending, now)
            custody_store.holdings.give(holding, pending)
        else:
            custody_store.drop(holding, Fate.PASSED_ON)
        self._send(target, number, datum)

    def _send(self, target: int, number: int, datum: Datum, *, again: bool = False) -> None:
        self._pace.spend(again=again)
        self._batches.setdefault(target, []).append(Handover(number, datum))

    def _for_neighbour(self, neighbour: int) -> Iterator[DatumId]:
        """Held data that can be handed over to a neighbour now, least recently used first.

        Where they differ in priority, every other one is the most urgent instead. So a datum waits for at most twice as
        many others as without priorities, whatever these claim. A neighbour that is suspected is given few.

        Large data wait while no more transfers to the neighbour can begin. Small data behind them do not wait. While
        the air is full, data that have probably arrived wait too: other copies of them have.
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
            if pace.full:
                found = self._not_arrived(found)
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
        least, the oldest first. What has probably arrived says nothing of it, and does not wait for that."""
        arrived: list[Holding] = []
        unproven: list[Holding] = []
        for holding in holdings:
            (arrived if self._custody_store.has_probably_arrived(holding) else unproven).append(holding)
        unproven.sort(key=self._custody_store.is_proof, reverse=True)
        return chain(unproven[:most], arrived)

    def _not_arrived(self, holdings: Iterator[Holding]) -> Iterator[Holding]:
        """The same without data that have probably arrived, as far as a node looks at a time."""
        for holding in islice(holdings, MOST_LOOKED_AT):
            if not self._custody_store.has_probably_arrived(holding):
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
        """Whether a large datum can be handed over to a neighbour now. In danger it need not have passed others on."""
        partner = self._custody_store.holdings.partners.get(neighbour)
        heaped = partner is not None and partner.large >= MAX_HEAPED
        return self._transfers.free(neighbour) and (self._in_danger or not heaped)

    def _retry(self, now: float, out: list[Message]) -> None:
        """Repeat unanswered hand-overs; give up on neighbours that are gone or stay silent."""
        self._in_danger = self._risk.risk(now) >= DANGER
        custody_store, pace = self._custody_store, self._pace
        self._exchange.keep(self._routing.neighbours.keys())
        for pending in self._exchange.of(Pending):
            holding = custody_store.holdings.custody[pending.id]
            if self._is_hopeless(pending, now):
                custody_store.holdings.put_off(holding)
            elif pending.due <= now and pace.left > 0:
                self._send_again(holding, pending, now, out)
            elif now < pending.due < now + pace.turn_s and self._in_danger:
                self._exchange.wake(pending.due)

    def _is_hopeless(self, pending: Pending, now: float) -> bool:
        """Whether to try another neighbour: this one is gone, or silent."""
        neighbour = self._routing.neighbours.get(pending.to)
        if neighbour is None or pending.tries >= MAX_TRIES:
            return True
        # It has probably moved away, so another is tried before the routing table gives it up. Where beacons get lost,
        # two must be missing: it may have the datum already, and another neighbour would create a second copy.
        return neighbour.noticed < now - max(neighbour.patience, 1.5 if neighbour.clean else 2.5) * neighbour.turn_s

    def _wait(self, pending: Pending, now: float) -> None:
        """Set when a hand-over that is sent now is sent again: twice as late each time, and at random, because others
        may wait for the same air."""
        settings, turn_s, again = self._custody_store.settings, self._pace.turn_s, pending.tries - 1
        if not settings.measured or pending.sending is not None:
            # Where this is a transfer, its turns without progress are counted.
            pending.due = now + 0.5 * turn_s
            return
        trip = self._exchange.trip(pending.to)
        wait_s = trip.usual_s if again else trip.wait_s
        urgent = wait_s > 0.0 and self._risk.risk(now) >= DANGER
        if not urgent:
            # The neighbour repeats its answer in its next beacon.
            wait_s = max(wait_s, 1.5 * turn_s)
        if again or urgent:
            wait_s *= (1 << min(again, MOST_DOUBLINGS)) * (0.75 + 0.5 * self._rng.random())
        pending.due = now + wait_s
        if urgent:
            self._exchange.wake(pending.due)

    def not_answered(self, neighbour: int, now: float) -> None:
        """A neighbour repeated its answers of the last turn: what it has not answered by now it has not got."""
        if self._custody_store.settings.measured:
            wait_s = self._exchange.trip(neighbour).wait_s
            for pending in self._exchange.of(Pending):
                if pending.to != neighbour or pending.sending is not None or pending.moves_on:
                    continue
                if 0.0 < wait_s <= now - pending.sent:
                    # In the next turn: many have heard this beacon.
                    pending.due = min(pending.due, now)

    def answered(self, pending: Pending, now: float) -> None:
        """A neighbour has taken a datum that was handed over to it."""
        if pending.tries == 1 and pending.sending is None:
            self._exchange.trip(pending.to).measure(now - pending.sent)

    def moves_on(self, data: Data, now: float) -> None:
        """A neighbour hands data over. It may have had one of them from this node: then it need not be sent again at
        once, but its answer is still needed. The copy that moves may be a replica, or have come from elsewhere."""
        custody = self._custody_store.holdings.custody
        for _, datum in data.handovers:
            holding = custody.get(datum.id)
            pending = None if holding is None else holding.pending
            if pending is not None and pending.to == data.sender and not pending.moves_on:
                pending.moves_on = True
                pending.due = max(pending.due, now) + MOVING_TURNS * self._pace.turn_s

    def _send_again(self, holding: Holding, pending: Pending, now: float, out: list[Message]) -> None:
        if pending.sending is not None:
            self._transfers.check(pending, pending.sending, now, out)
            self._wait(pending, now)
            return
        datum = self._custody_store.load(holding)
        if datum is not None:
            most_s = (1 << MOST_DOUBLINGS) * 1.5 * self._pace.turn_s
            self._exchange.trip(pending.to).missed(now, now - pending.sent, most_s)
            pending.tries += 1
            pending.sent = now
            self._wait(pending, now)
            self._send(pending.to, pending.number, datum, again=True)


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
