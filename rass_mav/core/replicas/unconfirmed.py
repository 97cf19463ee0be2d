"""Nothing rests indefinitely: data handed over that bring no receipt for long are sent again, by another route.

A node that sent COMMITTED may be an attacker, may have died, or may only claim to be a base. Only a base's receipt
shows that a datum has arrived. When the wait for a receipt is over and a base can be reached, the replica comes back
into custody and is handed over to another neighbour than the last time. Sending in vain costs airtime. Therefore the
wait is long compared with what data usually take, doubles with each try for a datum, and all tries together use a small
share of the bandwidth.
"""

from __future__ import annotations

from rass_mav.core.custody.custody_store import STATED_TURNS, CustodyStore
from rass_mav.core.custody.holdings import Holding, State
from rass_mav.core.custody.journal import JUDGED_TURNS
from rass_mav.core.datum import DatumId
from rass_mav.core.pace import RESERVED, Pace
from rass_mav.core.routes.table import RoutingTable

#: All replicas are checked once in this many turns: as long as it takes at least until one of them is overdue.
LOOK_TURNS = JUDGED_TURNS


class Unconfirmed:
    """The data that one node has handed over and waits for receipts of. The journal records since when."""

    __slots__ = ("_credit", "_custody_store", "_due", "_journal", "_pace", "_reachable", "_routing", "sent_again")

    def __init__(self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace) -> None:
        self._custody_store = custody_store
        self._journal = custody_store.journal
        self._routing = routing
        self._pace = pace
        self._reachable: int | None = None
        """Since which turn a base has been in reach; None: there is none."""
        self._credit = 0.0
        """Data that may be sent again now."""
        self._due: dict[DatumId, None] = {}
        """Replicas whose wait is over, those that have waited longest first."""
        self.sent_again = 0
        """Data that were sent again in this life."""

    def step(self) -> list[Holding]:
        """Once a turn: the replicas that should come back into custody."""
        if self._routing.route is None:
            self._reachable = None
            return []
        if self._reachable is None:
            self._reachable = self._journal.turn
        share = self._pace.items / RESERVED
        self._credit = min(self._credit + share, max(1.0, share))
        # Receipts that were delayed without a route have come by then.
        reachable = self._reachable + STATED_TURNS
        if self._journal.turn % LOOK_TURNS == 0:
            self._look(reachable)
        again: list[Holding] = []
        while self._due and self._credit >= 1.0:
            id = next(iter(self._due))
            del self._due[id]
            holding = self._custody_store.holdings.get(id)
            if holding is not None and holding.state is not State.CUSTODY and self._overdue(holding, reachable) >= 0:
                self._credit -= 1.0
                again.append(holding)
        return again

    def _look(self, reachable: int) -> None:
        holdings = self._custody_store.holdings
        due = []
        for replicas in (holdings.replica, holdings.passed_on):
            due += [(-late, id) for id, holding in replicas.items() if (late := self._overdue(holding, reachable)) >= 0]
        self._due = {id: None for _, id in sorted(due)}

    def _overdue(self, holding: Holding, reachable: int) -> int:
        """For how many turns the wait of a datum has been over; negative: it is not. Unless its forwarder is suspected,
        it lasts until the turn `reachable` at least."""
        journal, given = self._journal, holding.given
        assert given is not None
        if journal.has_failed(holding.id):
            return journal.turn - given.at
        return journal.turn - max(given.at + given.patience, reachable)

    def sends(self, holding: Holding, now: float) -> int | None:
        """A datum is sent again: to the neighbour nearest to a base, except the one that had it last. None: no other
        neighbour has a route, so the policy decides."""
        assert holding.given is not None
        holding.resent += 1
        self.sent_again += 1
        return self._routing.another_way(holding.given.to, now)
