"""Offers of replicas: data in custody that have no holder are offered to the safest neighbour.

These are data that rest and, in danger, those that are being handed over: if the hand-over fails, they stay here. Only
data that fit one frame are offered, to one neighbour at a time. An offer is answered like a hand-over, but it is not
one: custody stays here.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from math import inf

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.effects import Hand
from rass_mav.core.custody.holdings import Holding, ReplicaOffer
from rass_mav.core.datum import DatumId
from rass_mav.core.exchange import MAX_TRIES
from rass_mav.core.messages import BEACON_BASE
from rass_mav.core.pace import Pace
from rass_mav.core.replicas.distant import KNOWN_TURNS, OFFER_TURNS
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable

# Tuned: python -m tools.sensitivity replicas.offers
#: Turns in which a neighbour that refused a replica is offered none.
REFUSED_TURNS = 5
#: Bound: Data without a holder that are looked at at a time, besides those that are sent or on their way.
LOOK = 256


class ReplicaOffers:
    """Which replicas one node offers to which neighbours. `Holdings` records the offers."""

    __slots__ = ("_custody_store", "_pace", "_risk", "_rng", "_routing")

    def __init__(
        self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, risk: RiskEstimator, rng: random.Random
    ) -> None:
        self._custody_store = custody_store
        self._routing = routing
        self._pace = pace
        self._risk = risk
        self._rng = rng

    def spread(self, now: float) -> Iterator[Hand]:
        """Replicas for the safest neighbours, of the data that need them, within the bandwidth."""
        holdings = self._custody_store.holdings
        look = LOOK + max(self._pace.left, 0) + len(holdings.exchange.open)
        return self._offer(holdings.unbacked.values(), look, now)

    def spread_at_once(self, ids: Sequence[DatumId], now: float) -> Iterator[Hand]:
        """The same for some data, if they have no holder."""
        unbacked = self._custody_store.holdings.unbacked
        return self._offer([unbacked[id] for id in ids if id in unbacked], len(ids), now)

    def _offer(self, holdings: Iterable[Holding], most: int, now: float) -> Iterator[Hand]:
        pace, danger, arrived = self._pace, self._risk.in_danger(now), self._custody_store.arrived
        if pace.left <= 0:
            return
        due = (h for h in holdings if (danger or h.pending is None) and h.offer_at is not None and h.offer_at <= now)
        wanted: list[Holding] = []
        for holding in list(islice(due, most)):
            if holding.id in arrived:
                # A base has stated that it has the datum.
                self._custody_store.holdings.want_none(holding)
            elif danger or not pace.full:
                # Otherwise replicas would take airtime from the data themselves.
                wanted.append(holding)
        if not wanted:
            return
        safest = self._safest_first(now)
        given: Counter[int] = Counter()
        again_at = now + (OFFER_TURNS - 0.5) * max(pace.turn_s, self._routing.longest_turn_s)
        for holding in wanted:
            way = None if holding.pending is None else holding.pending.to
            to = next((one.id for one in safest if one.id != way and given[one.id] < one.beacon.free), None)
            if pace.left <= 0:
                return
            if to is not None:
                given[to] += 1
                yield Hand(holding, to, self._new(holding, to, now, again_at))

    def avoid(self, neighbour: int, now: float) -> bool:
        """Offer a neighbour no replicas for some time if there is another one; returns whether there is."""
        if (near := self._routing.neighbours.get(neighbour)) is not None:
            near.enclosed_until = now + KNOWN_TURNS * self._routing.longest_turn_s
        return any(other.enclosed_until <= now for other in self._safest_first(now))

    def _new(self, holding: Holding, to: int, now: float, again_at: float) -> ReplicaOffer:
        if holding.offer is not None:
            self._unanswered(holding.offer, now)
        holding.offer_at = again_at
        return ReplicaOffer(self._custody_store.exchange.draw(), holding.id, to, now)

    def _unanswered(self, offer: ReplicaOffer, now: float) -> None:
        """If a neighbour that is heard has answered no offer for long, others are asked for a while: it may not hear
        this node."""
        neighbour = self._routing.neighbours.get(offer.to)
        if neighbour is not None:
            neighbour.unanswered_since = min(neighbour.unanswered_since, offer.sent)
            turn_s = self._routing.longest_turn_s
            if now - neighbour.unanswered_since >= MAX_TRIES * turn_s:
                neighbour.unanswered_since, neighbour.refused_until = inf, now + KNOWN_TURNS * turn_s

    def taken(self, by: int) -> None:
        """A neighbour has taken a replica."""
        if (neighbour := self._routing.neighbours.get(by)) is not None:
            neighbour.unanswered_since = inf

    def _safest_first(self, now: float) -> list[Neighbour]:
        """The neighbours that may have space for a replica, lowest risk first; ties are broken at random."""
        safest = [
            neighbour
            for neighbour in self._routing.neighbours.values()
            if not neighbour.is_missing(now)
            and neighbour.beacon.free
            and not neighbour.beacon.flags & BEACON_BASE
            and neighbour.refused_until <= now
        ]
        self._rng.shuffle(safest)
        safest.sort(key=lambda one: (one.suspected, one.enclosed_until > now, one.beacon.risk))
        return safest

    def refused(self, offers: Iterable[ReplicaOffer], now: float) -> Iterator[Hand]:
        """A neighbour refused replicas of data in custody: others are tried."""
        again: list[DatumId] = []
        for offer in offers:
            holding = self._custody_store.holdings.custody[offer.id]
            self._custody_store.holdings.withdraw(holding)
            if (neighbour := self._routing.neighbours.get(offer.to)) is not None:
                neighbour.refused_until = now + REFUSED_TURNS * self._routing.longest_turn_s
                neighbour.unanswered_since = inf
            if holding.offer_at is not None:
                holding.offer_at = -inf
                again.append(holding.id)
        return self.spread_at_once(again, now)
