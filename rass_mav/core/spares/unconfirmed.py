"""Nothing rests for ever: what was handed on and brings no receipt for long goes out again, by another way.

Whoever said COMMITTED may have lied, or died, or be a base in its own words only. A base's receipt alone says that a
datum has arrived. So a spare whose patience is over comes back into custody, while a base can be reached, and is handed
to another neighbour than the last time. What is sent in vain costs airtime; therefore the patience is long against what
data usually take, doubles with each try for a datum, and all tries together have a small share of the bandwidth.
"""

from __future__ import annotations

from math import inf

from rass_mav.core.custody.holdings import Holding, State
from rass_mav.core.custody.keeper import Keeper
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.pace import Pace
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable

#: A receipt is waited for at least so many turns,
PATIENCE_TURNS = 120
#: at least so many times as long as data lately took,
PATIENCE_TIMES = 3
#: and at first for so many turns at most, however slow data are said to be.
MOST_PATIENCE_TURNS = 1200
#: After so many turns with a way to a base, receipts have come that were held up while there was none.
REACHABLE_TURNS = 30
#: Each try for a datum doubles its patience, so many times.
MOST_DOUBLINGS = 6
#: How fast the time that data take follows what happens.
TAKES_GAIN = 0.125
#: One datum in so many that the bandwidth allows.
SHARE = 10
#: All spares are looked at once in so many turns.
LOOK_TURNS = 10


class Unconfirmed:
    """What one node has handed on and waits for receipts of. The times stand in `Holdings`."""

    __slots__ = ("_credit", "_due", "_keeper", "_pace", "_reachable", "_routing", "_takes_s", "_turns", "sent_again")

    def __init__(self, keeper: Keeper, routing: RoutingTable, pace: Pace) -> None:
        self._keeper = keeper
        self._routing = routing
        self._pace = pace
        self._takes_s = 0.0
        """How long it lately took from handing a datum on, the last time, to its receipt, seconds."""
        self._reachable = inf
        """Since when a base has been in reach, seconds."""
        self._turns = 0
        self._credit = 0.0
        """Data that may be sent again now."""
        self._due: dict[DatumId, None] = {}
        """Spares whose patience is over, the longest first."""
        self.sent_again = 0
        """Data that were sent again in this life."""

    def handed_on(self, holding: Holding, to: int, now: float) -> None:
        """A copy here is a spare from now on, for another node has custody."""
        holding.given_to = to
        holding.given = now
        turn_s = self._pace.turn_s
        patience_s = max(PATIENCE_TURNS * turn_s, min(PATIENCE_TIMES * self._takes_s, MOST_PATIENCE_TURNS * turn_s))
        # Settled now: what arrives late because of a liar must not make this node wait longer for what it swallowed.
        holding.patience_s = patience_s * (1 << min(holding.resent, MOST_DOUBLINGS))

    def confirmed(self, holding: Holding, now: float) -> None:
        """A receipt says that a datum has arrived of which a spare is here."""
        took = min(now - holding.given, MOST_PATIENCE_TURNS * self._pace.turn_s)
        self._takes_s += TAKES_GAIN * (took - self._takes_s)

    def step(self, now: float) -> list[Holding]:
        """Once a turn: the spares that are to come back into custody."""
        if self._routing.route is None:
            self._reachable = inf
            return []
        if self._reachable == inf:
            self._reachable = now
        share = self._pace.items / SHARE
        self._credit = min(self._credit + share, max(1.0, share))
        self._turns += 1
        if self._turns % LOOK_TURNS == 0:
            self._look(now)
        again: list[Holding] = []
        while self._due and self._credit >= 1.0:
            id = next(iter(self._due))
            del self._due[id]
            holding = self._keeper.holdings.get(id)
            if holding is not None and holding.state is not State.CUSTODY and self._overdue(holding, now) >= 0.0:
                self._credit -= 1.0
                again.append(holding)
        return again

    def _look(self, now: float) -> None:
        holdings = self._keeper.holdings
        due = []
        for spares in (holdings.spare, holdings.passed_on):
            due += [(-late, id) for id, holding in spares.items() if (late := self._overdue(holding, now)) >= 0.0]
        self._due = {id: None for _, id in sorted(due)}

    def _overdue(self, holding: Holding, now: float) -> float:
        """For how long a datum's patience has been over, seconds; negative: it is not."""
        reachable = self._reachable + REACHABLE_TURNS * self._pace.turn_s
        return now - max(holding.given + holding.patience_s, reachable)

    def sends(self, holding: Holding, now: float) -> int | None:
        """A datum goes out again: to the neighbour that is nearest to a base, but for the one that had it last. None:
        there is no other with a way, so the policy decides."""
        holding.resent += 1
        self.sent_again += 1
        ways = [
            neighbour
            for neighbour in self._routing.neighbours.values()
            if neighbour.id != holding.given_to and neighbour.beacon.hops != NO_ROUTE and neighbour.beacon.free
        ]
        return min(ways, key=lambda neighbour: self._rank(neighbour, now)).id if ways else None

    def _rank(self, neighbour: Neighbour, now: float) -> tuple[int, int, int, int]:
        rank, beacon = self._routing.rank, neighbour.beacon
        # Whose costs cannot be compared is a way for want of others.
        foreign = rank.tag is not None and beacon.hops > 0 and beacon.policy != rank.tag
        metric = beacon.hops if rank.tag is None or foreign or not beacon.hops else beacon.potential
        return rank.behind(neighbour, now), foreign, metric, neighbour.id
