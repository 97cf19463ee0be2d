"""Offers of replicas: data in custody without a holder are offered to the safest neighbour.

Only data that fit one frame are offered. An offer is answered like a hand-over, but it is not one: custody stays here.

With `custody.copies: auto` a datum gets as many replicas, on different neighbours, as its risk requires. While it
stays here it is struck before the next step with probability r. If it is being handed over, it stays here only if the
hand-over fails: because the receiver turns out to have gone (`gone` is the share of neighbours to which that happens),
or because the frame is struck while it waits for the air. Frames wait for half the usual time between a hand-over and
its answer, a share w of a turn, so fail = gone + (1 - gone) w r. A neighbour j does not save the datum if the offer
fails, or if j is struck itself: f_j = fail + (1 - fail) r_j. It gets one more replica, on the safest neighbour that
has none, as long as the product of

    r,  fail (while it is being handed over),  f_j of each neighbour that is offered a replica,
    gone + (1 - gone) r_j of the neighbour that has one

exceeds 1 - `TARGET`. Where no neighbour moves away and frames take no time, that never happens to data that move on.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable, Iterator
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
from rass_mav.core.risk import DANGER, RiskEstimator
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable

# Tuned: python -m tools.sensitivity replicas.offers
#: Turns in which a neighbour that refused a replica is offered none.
REFUSED_TURNS = 5
#: How fast the estimated share of neighbours that fall silent follows what happens.
GONE_GAIN = 0.05
#: With `custody.copies: auto`: the chance of surviving the next step that a datum should have.
TARGET = 0.999
#: Bound: Data without a holder that are looked at at a time, besides those that are sent or on their way.
LOOK = 256


class ReplicaOffers:
    """Which replicas one node offers to which neighbours. `Holdings` records the offers."""

    __slots__ = (
        "_auto",
        "_custody_store",
        "_pace",
        "_risk",
        "_rng",
        "_routing",
        "gone",
    )  # fmt: skip

    def __init__(
        self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, risk: RiskEstimator, rng: random.Random
    ) -> None:
        self._auto = custody_store.settings.custody.copies == "auto"
        """Whether a datum gets as many replicas as its risk requires."""
        self._custody_store = custody_store
        self._routing = routing
        self._pace = pace
        self._risk = risk
        self._rng = rng
        self.gone = 0.0
        """Recent share of the neighbours that fall silent unexpectedly from one step to the next; 0..1."""

    def step(self, now: float) -> None:
        """Once a step: neighbours that refused long ago may be asked again; update the share that has fallen silent."""
        self._custody_store.came.clear()
        if self._auto:
            self._count_gone(now)

    def _count_gone(self, now: float) -> None:
        neighbours = self._routing.neighbours
        here, silent = len(neighbours), 0
        for neighbour in neighbours.values():
            late = (now - neighbour.noticed) / neighbour.turn_s - neighbour.patience
            if late >= 0.0:
                here -= 1
                if late < 1.0 and neighbour.leaves > neighbour.heard + neighbour.patience * neighbour.turn_s:
                    # Those that were expected to leave are given nothing.
                    silent += 1
        if silent or here:
            self.gone += GONE_GAIN * (silent / (here + silent) - self.gone)

    def spread(self, now: float) -> Iterator[Hand]:
        """Replicas for the safest neighbours, of the data that need them, within the bandwidth."""
        auto, holdings, came = self._auto, self._custody_store.holdings, self._custody_store.came
        due = (h for h in holdings.unbacked.values() if _is_due(h, now) and (auto or h.pending is None))
        needy = list(islice(due, LOOK + max(self._pace.left, 0) + len(holdings.exchange.open)))
        # Data without a holder are in `unbacked`.
        needy += [h for id in came if (h := holdings.custody.get(id)) is not None and h.partner is not None]
        came.clear()
        return self._offer(needy, now)

    def spread_at_once(self, ids: Iterable[DatumId], now: float) -> Iterator[Hand]:
        """The same for some data, if they have no holder."""
        auto, unbacked = self._auto, self._custody_store.holdings.unbacked
        needy = [unbacked[id] for id in ids if id in unbacked]
        needy = [h for h in needy if _is_due(h, now) and (auto or h.pending is None)]
        return self._offer(needy, now)

    def _offer(self, needy: list[Holding], now: float) -> Iterator[Hand]:
        if not needy or self._pace.left <= 0:
            return
        arrived = self._custody_store.arrived
        risk = self._risk.risk(now)
        share = min(0.5 * self._custody_store.exchange.mean_s / self._pace.turn_s, 1.0)
        fail = self.gone + (1.0 - self.gone) * risk * share
        wanted: list[tuple[Holding, float]] = []
        for holding in needy:
            if holding.id in arrived:
                # A base has stated that it has the datum.
                self._custody_store.holdings.want_none(holding)
            elif self._is_wanting(holding, loss := self._loss(holding, risk, fail)):
                wanted.append((holding, loss))
        if not wanted:
            return
        safest = self._safest_first(now)
        given: Counter[int] = Counter()
        again_at = now + (OFFER_TURNS - 0.5) * max(self._pace.turn_s, self._routing.longest_turn_s)
        for holding, loss in wanted:
            yield from self._offers_of(holding, loss, safest, given, fail, now, again_at)

    def _loss(self, holding: Holding, risk: float, fail: float) -> float:
        """The chance that a datum is lost in the next step if nothing is offered."""
        loss = risk if holding.pending is None else risk * fail
        if holding.partner is not None:
            loss *= _failing(self._routing.neighbours.get(holding.partner.id), self.gone)
        return loss

    def _is_wanting(self, holding: Holding, loss: float, offered: int = 0) -> bool:
        """Whether a datum needs one more replica. `offered`: how many neighbours are offered one now."""
        if self._pace.full:
            # Replicas would take airtime from the data themselves: only for what is in danger.
            return self._auto and loss > DANGER
        # A datum that rests alone gets one replica, however safe it is here.
        rests_alone = holding.pending is None and holding.partner is None and not offered
        return rests_alone or (self._auto and loss > 1.0 - TARGET)

    def _offers_of(
        self, holding: Holding, loss: float, safest: list[Neighbour], given: Counter[int], fail: float,
        now: float, again_at: float,
    ) -> Iterator[Hand]:  # fmt: skip
        """The offers of one datum, and their targets. `given`: how many each neighbour is offered now."""
        pace, offered = self._pace, 0
        way = None if holding.pending is None else holding.pending.to
        holder = None if holding.partner is None else holding.partner.id
        # A datum that the sender has too must not use what is reserved for new data.
        kept = 0 if holder is None else pace.reserved
        for neighbour in safest:
            to = neighbour.id
            if given[to] >= neighbour.beacon.free or to in (holder, way):
                continue
            if pace.left <= kept:
                return
            offer = self._new(holding, to, now, again_at)
            yield Hand(holding, to, offer)
            if offer not in holding.offers:
                # Its bytes were corrupt.
                return
            given[to] += 1
            offered += 1
            loss *= _failing(neighbour, fail)
            if not self._is_wanting(holding, loss, offered):
                return

    def avoid(self, neighbour: int, now: float) -> bool:
        """Offer a neighbour no replicas for some time if there is another one; returns whether there is."""
        if (near := self._routing.neighbours.get(neighbour)) is not None:
            near.enclosed_until = now + KNOWN_TURNS * self._routing.longest_turn_s
        return any(other.enclosed_until <= now for other in self._safest_first(now))

    def _new(self, holding: Holding, to: int, now: float, again_at: float) -> ReplicaOffer:
        """A new offer; those of earlier steps are forgotten."""
        holdings = self._custody_store.holdings
        if holding.offer_at != again_at:
            for unanswered in holding.offers:
                self._unanswered(unanswered, now)
            holdings.withdraw(holding)
        if holding.offer_at is not None:
            holding.offer_at = again_at
        return ReplicaOffer(holdings.exchange.draw(), holding.id, to, now)

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


def _is_due(holding: Holding, now: float) -> bool:
    return holding.offer_at is not None and holding.offer_at <= now


def _failing(neighbour: Neighbour | None, fail: float) -> float:
    """The chance that a replica at this neighbour does not help: f in the module's docstring."""
    return 1.0 if neighbour is None else fail + (1.0 - fail) * neighbour.beacon.risk / 65535.0
