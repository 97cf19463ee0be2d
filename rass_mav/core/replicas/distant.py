"""Distant replicas: of data that rest, copies are out of reach of whatever strikes all drones around their custodian.

A custodian knows only its neighbours, so its holder is one of them, and both may be struck at once. But the holder has
neighbours that do not hear the custodian, and these have neighbours that do not hear the holder. Where no base can be
reached, the holder of a datum that rests has a holder of its own, and that one too: a chain of `FURTHER` replicas
that leads away from the custodian. Each node of the chain sends its replica to a neighbour, and names the node before
itself and the custodian. A neighbour that hears one of them refuses.

Within the chain each node is to the next one what a custodian is to its holder: a replica that is lost is replaced, and
a node whose predecessor is gone takes custody. The chain ends when the custodian passes the datum on. Its copies
stay until the receipt, like those that data leave behind on their route.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from itertools import islice

from rass_mav.core.custody.custody_store import FURTHER, CustodyStore
from rass_mav.core.custody.effects import Hand, Tell
from rass_mav.core.custody.holdings import Holding, ReplicaOffer
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import (
    BEACON_BASE,
    NO_ROUTE,
    CopyStatus,
    Distance,
)
from rass_mav.core.pace import Pace
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable

# Tuned: python -m tools.sensitivity replicas.distant
#: Turns after which an unanswered offer is forgotten, or repeated.
OFFER_TURNS = 2
#: For how many turns a node remembers which of its neighbours hear another node, are enclosed, or answer nothing: they
#: may move.
KNOWN_TURNS = 30
#: How many such pairs it remembers.
MAX_KNOWN = 256
#: Bound: How many replicas without a holder are looked at in a turn.
LOOK = 64


class DistantOffer(ReplicaOffer):
    """A distant replica that is on offer."""

    __slots__ = ("near",)

    def __init__(self, number: int, id: DatumId, to: int, now: float, near: tuple[int, int]) -> None:
        super().__init__(number, id, to, now)
        self.near = near
        """Nodes that the receiver must not hear."""


class DistantReplicas:
    """Which neighbours are offered distant replicas. `Holdings` records which of them have one."""

    __slots__ = (
        "_custody_store",
        "_exchange",
        "_hears",
        "_pace",
        "_rng",
        "_routing",
    )

    def __init__(self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, rng: random.Random) -> None:
        self._rng = rng
        self._custody_store = custody_store
        self._exchange = custody_store.exchange
        self._routing = routing
        self._pace = pace
        self._hears: dict[tuple[tuple[int, int], int], tuple[bool, float]] = {}
        """(two nodes, neighbour): whether the neighbour refused, as one that hears any of them does, and until when
        that is remembered, seconds."""

    def avoid(self, holding: Holding, holder: int, now: float) -> bool:
        """The holder of a replica is enclosed: send it no more for some time, if there may be another one."""
        self._remember(self._away_from(holding), holder, now, hears=True)
        return not self._is_enclosed(self._away_from(holding), now)

    def _away_from(self, holding: Holding) -> tuple[int, int]:
        """Which nodes the holder of a replica must not hear."""
        assert holding.partner is not None
        assert holding.custodian is not None
        return holding.partner.id, holding.custodian

    def lost(self, holding: Holding, now: float) -> None:
        """The holder of a replica has no copy any more."""
        if holding.further:
            self._custody_store.holdings.unchained[holding.id] = now

    def spread(self, now: float) -> Iterator[Hand | Tell]:
        """Once a turn, after all else: distant replicas, within the bandwidth."""
        holdings = self._custody_store.holdings
        replica, unchained = holdings.replica, holdings.unchained
        for offer in self._exchange.of(DistantOffer):
            if offer.due <= now:
                holdings.withdraw(replica[offer.id])
        if not unchained or self._routing.route is not None:
            # With a base in reach data do not rest for long.
            return
        pace = self._pace
        sent: Counter[tuple[int, Distance]] = Counter()
        for id, due in list(islice(unchained.items(), LOOK)):
            if pace.left <= pace.reserved:
                break
            del unchained[id]
            holding = replica.get(id)
            if holding is None or not self._needs(holding):
                continue
            # To the end: all have their turn.
            unchained[id] = due
            near = self._away_from(holding)
            if due > now or holding.offer is not None or not self._rests(holding, near[0]):
                continue
            distance = Distance(*near, holding.further - 1)
            to = self._receiver(near, now, sent)
            if to is None and self._is_enclosed(near, now):
                unchained[id] = now + KNOWN_TURNS * self._routing.longest_turn_s
                yield Tell(near[0], id, CopyStatus.ENCLOSED)
            elif to is not None:
                offer = DistantOffer(self._exchange.draw(), id, to, now, near)
                offer.due = now + (OFFER_TURNS - 0.5) * self._routing.longest_turn_s
                sent[to, distance] += 1
                yield Hand(holding, to, offer, distance)

    def _needs(self, holding: Holding) -> bool:
        return holding.further > 0 and holding.holder is None and holding.id not in self._custody_store.arrived

    def _rests(self, holding: Holding, near: int) -> bool:
        """Data rest at a custodian without a route to a base; at others they move on soon."""
        if holding.further < FURTHER:
            return True
        custodian = self._routing.neighbours.get(near)
        return custodian is not None and custodian.beacon.hops == NO_ROUTE

    def _receiver(self, near: tuple[int, int], now: float, sent_at: Counter[tuple[int, Distance]]) -> int | None:
        """The neighbour to offer a distant replica to: one that is known not to hear `near`, or else one that has not
        been asked, with a single datum."""
        sent: dict[int, int] = {}
        for (to, distance), count in sent_at.items():
            if distance[:2] == near:
                sent[to] = sent.get(to, 0) + count
        around: list[Neighbour] = []
        unknown: list[Neighbour] = []
        for neighbour in self._routing.neighbours.values():
            beacon = neighbour.beacon
            fresh = not neighbour.is_missing(now)
            room = beacon.free > sent.get(neighbour.id, 0)
            if neighbour.id in near or not fresh or not room or beacon.flags & BEACON_BASE:
                continue
            hears, until = self._hears.get((near, neighbour.id), (False, 0.0))
            if until <= now:
                unknown.append(neighbour)
            elif not hears:
                around.append(neighbour)
        if around:
            # Not always the safest one: its store would fill up.
            return self._rng.choice(around).id
        if not unknown or sent or any(offer.near == near for offer in self._exchange.of(DistantOffer)):
            return None
        return min(unknown, key=_by_risk).id

    def _remember(self, near: tuple[int, int], neighbour: int, now: float, *, hears: bool) -> None:
        self._hears.pop((near, neighbour), None)
        if len(self._hears) >= MAX_KNOWN:
            del self._hears[next(iter(self._hears))]
        self._hears[near, neighbour] = (hears, now + KNOWN_TURNS * self._routing.longest_turn_s)

    def _is_enclosed(self, near: tuple[int, int], now: float) -> bool:
        """Whether all neighbours have refused distant replicas because they hear one of `near`."""
        others = [id for id in self._routing.neighbours if id not in near]
        return all(hears and until > now for id in others for hears, until in [self._hears.get((near, id), (False, 0))])

    def answered(self, offer: DistantOffer, now: float, *, takes: bool) -> Holding | None:
        """A neighbour took a distant replica, or refused it. Returns the copy here that it backs now."""
        holding = self._custody_store.holdings.replica[offer.id]
        self._custody_store.holdings.withdraw(holding)
        self._remember(offer.near, offer.to, now, hears=not takes)
        if not takes or holding.partner is None or holding.partner.id == offer.to:
            return None
        self._custody_store.holdings.unchained.pop(holding.id, None)
        return holding


def _by_risk(neighbour: Neighbour) -> tuple[int, int]:
    return neighbour.beacon.risk, neighbour.id
