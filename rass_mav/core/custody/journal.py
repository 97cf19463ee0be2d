"""The journal: what this node has handed over, and what became of it.

COMMITTED says that a neighbour has taken a datum; only a base's receipt shows that it has arrived. Each custody
transfer has an entry until its datum is confirmed or comes back. A copy that stays here has the entry too, and when its
patience is over the datum goes out again by another way (`replicas.unconfirmed`). What is confirmed in time counts for
the neighbour, what is overdue or was never answered counts against it, and older counts fade. The result is the chance
p that this neighbour delivers:

- By costs, the way by a neighbour costs 1 / p times as much, as a lossy link does (ETX, De Couto et al. 2003).
- With p below `SUSPECTED` a neighbour is suspected: it is chosen only if no other is fit, and what it has is handed
  over again at once. In each rest period it gets one datum, the probe, because it may be an honest drone whose own next
  hop has failed. A probe that is confirmed ends the suspicion; each one that is not makes the next rest twice as long.
- Names are free, so one that drops data may come back under a new name. The node therefore also counts together what
  those deliver that have delivered nothing before. While that share is below `NEW_SUSPECTED`, and another neighbour
  with a route has delivered, a new one is treated as if it were suspected.

Time counts only while this node has a route and news of arrivals comes in, so no node is blamed on an island, or where
receipts are off; and only while the neighbour is heard, if it has delivered before: one that has flown away took its
data along, and brings them to a base by a way of its own. Others' data count against no node before a later datum of
their origin has arrived: they may be junk, which no base confirms, of an invented origin or with a number that its
origin has yet to assign. Nor do data count whose origin denies what bases state: no receipt about them is believed.
Nor do, where there are keys, data without a seal: a base confirms none of these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from rass_mav.core.datum import DatumId
from rass_mav.core.exchange import MAX_TRIES, TRIP_GAIN
from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.shares import greediest

# Tuned: python -m tools.sensitivity custody.journal
#: Each datum that is judged makes those judged before count for this much less.
FADE = 1 / 12
#: A neighbour of which nothing is known counts as one that has delivered this many data.
PRIOR = 1.0
#: A neighbour that delivers less than this share is suspected.
SUSPECTED = 0.5
#: The same for all those together that have delivered nothing before.
NEW_SUSPECTED = 0.75
#: Bound: The least that p counts as: a way by a neighbour costs at most 64 times as much.
LEAST = 1 / 64
#: A datum is overdue this many turns after it was taken, and as many more for each hop between its forwarder and the
#: base, up to `MOST_HOPS`; but not before this long and the time in which the bases' statements about all origins are
#: relayed once, up to `PATIENCE_TURNS`; nor before the usual time and `DEVIATIONS` times its deviation, up to
#: `MOST_TURNS`.
JUDGED_TURNS = 10
MOST_HOPS = 4
DEVIATIONS = 6.0
#: Bound: With junk of invented origins an attacker makes them many: the statements of each base count for so many turns
#: at most, as those about a hundred origins do.
MOST_ROUND = 30
#: How fast the usual time follows: half as fast as that of a round trip. The deviation follows twice as fast, as there.
TAKES_GAIN = TRIP_GAIN / 2
DEVIATION_GAIN = 2 * TAKES_GAIN
#: A copy that stays waits for a receipt for this many turns at least, and for so many times the usual time, up to
#: `MOST_TURNS`. Each time that its datum was sent again doubles this, up to so many times.
PATIENCE_TURNS, PATIENCE_TIMES, MOST_DOUBLINGS = 120, 3, 6
#: No wait for a receipt is longer, turns, unless the datum was sent again.
MOST_TURNS = 10 * PATIENCE_TURNS
#: Turns from a suspicion to the first probe, and twice as many after each probe, up to the second.
REST_TURNS = 40
LONGEST_REST = 4 * REST_TURNS
#: Without news of arrivals for this many turns no node is judged. It is less than the least wait: a pause of the news
#: alone makes nothing overdue.
NEWS_TURNS = JUDGED_TURNS
#: How often a node looks for what is overdue, turns.
LOOK_TURNS = JUDGED_TURNS // 2
#: The most entries, and neighbours, that a node remembers.
MAX_ENTRIES = 2048
MAX_FORWARDERS = 64


class Entry:
    """One custody transfer."""

    __slots__ = ("at", "judged", "patience", "received_from", "since", "to")

    def __init__(self, received_from: int | None, to: int, at: int, patience: int, since: int = 0) -> None:
        self.received_from = received_from
        """The node that handed the datum over to this one; None: it was created here."""
        self.to = to
        """The node that took it."""
        self.at = at
        """When, by this node's turns."""
        self.patience = patience
        """How long a copy that stays here waits for a receipt, turns. It is fixed from the start: data that an attacker
        delays must not make this node wait longer for the data that it dropped."""
        self.since = since
        """When it was taken, by its forwarder's clock."""
        self.judged = False
        """Whether it was overdue, or is not to be judged."""


class Forwarder:
    """What the journal says of one neighbour."""

    __slots__ = (
        "bad", "clock", "good", "hops", "new", "probe", "refusals", "refused_at", "rest", "rests_until", "suspected",
    )  # fmt: skip

    def __init__(self) -> None:
        self.new = True
        """Whether it has delivered nothing yet."""
        self.hops = NO_ROUTE
        """How far from a base it was when it was last heard."""
        self.clock = 0
        """Turns in which news of what it took could have come."""
        self.good = 0.0
        """Data that were confirmed in time,"""
        self.bad = 0.0
        """and those that were overdue; older ones count less."""
        self.suspected = False
        self.probe: DatumId | None = None
        """While it is suspected: the datum that may end this."""
        self.rest = REST_TURNS
        """How long it is left alone, turns."""
        self.rests_until = 0
        """When it may have the next one, by this node's turns."""
        self.refusals = self.refused_at = 0
        """In how many turns it has refused data since it took any, and the last of them."""

    @property
    def delivers(self) -> float:
        """The chance that it delivers what it takes, 0..1."""
        return (self.good + PRIOR) / (self.good + self.bad + PRIOR)

    def count(self, *, good: float = 0.0, bad: float = 0.0) -> None:
        """A datum is judged."""
        self.good = (1 - FADE) * self.good + good
        self.bad = (1 - FADE) * self.bad + bad


class Journal:
    """The custody transfers of one node."""

    __slots__ = (
        "_deviation",
        "_entries",
        "_forwarders",
        "_heard",
        "_new",
        "_own",
        "_receipts",
        "_takes",
        "_wary",
        "judges",
        "suspecting",
        "turn",
    )

    def __init__(self, receipts: NoReceipts, *, judges: bool) -> None:
        """`judges`: whether neighbours are judged."""
        self._receipts = receipts
        self.judges = judges
        self._entries: dict[DatumId, Entry] = {}
        """The oldest first."""
        self._forwarders: dict[int, Forwarder] = {}
        """By node id, the latest used last."""
        self.turn = 0
        """Turns of this node."""
        self._heard = -NEWS_TURNS
        """The turn in which news of arrivals came last."""
        self._new = Forwarder()
        """What all those delivered together that had delivered nothing before."""
        self._wary = False
        """Whether that is too little, and a neighbour with a route has delivered."""
        self._takes = 0.0
        """The usual time from a hand-over to its confirmation, turns,"""
        self._deviation = 0.0
        """and its mean deviation, by the node's own data, once one of them was confirmed. Who drops others' data would
        stretch it: their copies arrive late by other ways."""
        self._own = False
        """Whether one of its own data was confirmed."""
        self.suspecting = False
        """Whether any neighbour is suspected."""

    def __contains__(self, id: object) -> bool:
        """Whether a datum was passed on, and is not known to have arrived."""
        return id in self._entries

    def waits(self, to: int, resent: int, received_from: int | None = None, since: int = 0) -> Entry:
        """A copy here waits for a receipt from now on. `to`: the node that has custody; `resent`: how often the datum
        was sent again."""
        patience = max(PATIENCE_TURNS, min(int(PATIENCE_TIMES * self._takes), MOST_TURNS))
        return Entry(received_from, to, self.turn, patience << min(resent, MOST_DOUBLINGS), since)

    def gave(
        self, id: DatumId, received_from: int | None, to: int, resent: int = 0, *, judged: bool = False
    ) -> Entry:  # fmt: skip
        """A neighbour has taken custody of a datum. `received_from`: the node that this one had it from; None: it is
        its own. `judged`: it counts neither for nor against the neighbour."""
        self._entries.pop(id, None)
        forwarder = self._forwarder(to)
        forwarder.refusals = 0
        entry = self._entries[id] = self.waits(to, resent, received_from, forwarder.clock)
        entry.judged = judged
        if len(self._entries) > MAX_ENTRIES:
            most = greediest(Counter(entry.to for entry in self._entries.values()))
            del self._entries[next(id for id, entry in self._entries.items() if entry.to == most)]
        if self._doubts(forwarder) and self.turn >= forwarder.rests_until:
            forwarder.probe = id
            self._rest_longer(forwarder)
        return entry

    def refused(self, to: int) -> None:
        """A neighbour has refused a hand-over, and not for lack of space if it does so again and again: then its
        beacons would say so."""
        forwarder = self._forwarder(to)
        if forwarder.refused_at != self.turn:
            forwarder.refused_at = self.turn
            forwarder.refusals += 1
            if forwarder.suspected or forwarder.refusals >= MAX_TRIES:
                self.failed(to)

    def failed(self, to: int) -> None:
        """A neighbour that is heard has not taken a datum, however often it was sent. It may not hear this node, or
        hold data up."""
        if self.judges:
            forwarder = self._forwarder(to)
            if forwarder.suspected:
                self._rest_longer(forwarder)
            self._blame(forwarder)

    def _forwarder(self, to: int) -> Forwarder:
        """What is known of a neighbour, as the latest used."""
        forwarder = self._forwarders.pop(to, None) or Forwarder()
        if len(self._forwarders) == MAX_FORWARDERS:
            self._drop_forwarder()
        self._forwarders[to] = forwarder
        return forwarder

    def _rest_longer(self, forwarder: Forwarder) -> None:
        """It has had a probe."""
        forwarder.rest = min(2 * forwarder.rest, LONGEST_REST)
        forwarder.rests_until = self.turn + forwarder.rest

    def _drop_forwarder(self) -> None:
        """Too many neighbours are remembered: forget the longest unused, of those that are not suspected if there are
        any."""
        gone = min(self._forwarders, key=lambda to: self._forwarders[to].suspected)
        del self._forwarders[gone]
        self._entries = {id: entry for id, entry in self._entries.items() if entry.to != gone}

    def came_back(self, id: DatumId) -> None:
        """A datum is in custody here again."""
        self._entries.pop(id, None)

    # -- news ----------------------------------------------------------------------------------------------------------

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""
        self._heard, receipts = self.turn, self._receipts
        for id in [id for id in self._entries if id[:2] in changed]:
            if id in receipts:
                self._confirmed(id)
            elif receipts.is_reported_lost(id):
                self._judge(id, self._entries.pop(id))

    def _confirmed(self, id: DatumId) -> None:
        entry = self._entries.pop(id)
        own = entry.received_from is None
        self._own = self._own or own
        if own or not self._own:
            took = min(self.turn - entry.at, MOST_TURNS)
            self._deviation += DEVIATION_GAIN * (abs(took - self._takes) - self._deviation)
            self._takes += TAKES_GAIN * (took - self._takes)
        forwarder = self._forwarders[entry.to]
        if entry.judged or (forwarder.suspected and id != forwarder.probe):
            # It has probably arrived by another way.
            return
        self._count(forwarder, good=1.0)
        if forwarder.suspected:
            # Its routes would cost too much to be used, and it could never show that it delivers.
            forwarder.bad = 0.0
        forwarder.new = forwarder.suspected = False
        forwarder.probe, forwarder.rest = None, REST_TURNS

    def _count(self, forwarder: Forwarder, *, good: float = 0.0, bad: float = 0.0) -> None:
        forwarder.count(good=good, bad=bad)
        if forwarder.new:
            self._new.count(good=good, bad=bad)

    def _judge(self, id: DatumId, entry: Entry) -> None:
        """A datum was not delivered."""
        if entry.judged:
            return
        entry.judged = True
        if self._receipts.is_disputed(id) or (entry.received_from is not None and not self._receipts.arrives_after(id)):
            # No receipt would be believed, or it may be junk.
            return
        self._blame(self._forwarders[entry.to])

    def _blame(self, forwarder: Forwarder) -> None:
        self._count(forwarder, bad=1.0)
        if not forwarder.suspected and forwarder.delivers < SUSPECTED:
            forwarder.suspected = True
            forwarder.rests_until = self.turn + forwarder.rest

    # -- judgement -----------------------------------------------------------------------------------------------------

    def step(self, routing: RoutingTable) -> None:
        """Once a turn: judge what is overdue, and tell the neighbours' table."""
        self.turn += 1
        if not self.judges:
            return
        if routing.route is not None and self.turn - self._heard < NEWS_TURNS:
            for to, forwarder in self._forwarders.items():
                forwarder.clock += forwarder.new or to in routing.neighbours
            if self.turn % LOOK_TURNS == 0:
                self._look()
        suspecting = wary = False
        for id, neighbour in routing.neighbours.items():
            known = self._forwarders.get(id)
            if known is None:
                doubts = self._wary
            else:
                doubts = self._doubts(known)
                known.hops = neighbour.beacon.hops
                neighbour.odds = 1.0 / max(known.delivers, LEAST)
                wary = wary or (not (known.new or known.suspected) and known.hops != NO_ROUTE)
            neighbour.suspected = doubts
            suspecting = suspecting or doubts
        self.suspecting = suspecting
        self._wary = wary and self._new.delivers < NEW_SUSPECTED

    def _doubts(self, forwarder: Forwarder | None) -> bool:
        """Whether a neighbour gets probes only."""
        return self._wary if forwarder is None else forwarder.suspected or (forwarder.new and self._wary)

    def _look(self) -> None:
        """Judge what is overdue."""
        least = JUDGED_TURNS + min(self._receipts.round_turns(MOST_ROUND), PATIENCE_TURNS)
        least = max(least, self._takes + DEVIATIONS * self._deviation)
        for id, entry in self._entries.items():
            forwarder = self._forwarders[entry.to]
            took = forwarder.clock - entry.since
            if took > JUDGED_TURNS and not entry.judged:
                wait = max(least, JUDGED_TURNS * (1 + min(forwarder.hops, MOST_HOPS)))
                if took > min(wait, MOST_TURNS):
                    self._judge(id, entry)

    # -- who may have what ---------------------------------------------------------------------------------------------

    def has_failed(self, id: DatumId) -> bool:
        """Whether a datum that was handed over should go to another node now: its forwarder is suspected, and the datum
        is no probe, or an overdue one."""
        entry = self._entries.get(id)
        if entry is None:
            return False
        forwarder = self._forwarders[entry.to]
        return self._doubts(forwarder) and (entry.judged or (forwarder.suspected and id != forwarder.probe))

    def allowance(self, neighbour: int) -> int | None:
        """How many more data a neighbour may be given now; None: any number."""
        forwarder = self._forwarders.get(neighbour)
        if not self._doubts(forwarder):
            return None
        return int(forwarder is None or self.turn >= forwarder.rests_until)

    def probes(self, routing: RoutingTable) -> Iterator[int]:
        """The suspected neighbours nearer to a base that may prove themselves now, with one datum each."""
        for neighbour in routing.neighbours.values():
            beacon = neighbour.beacon
            if neighbour.suspected and beacon.hops < routing.hops and beacon.free and self.allowance(neighbour.id):
                yield neighbour.id

    @property
    def suspects(self) -> set[int]:
        """The neighbours that are suspected for what they did not deliver."""
        return {to for to, forwarder in self._forwarders.items() if forwarder.suspected}

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {"doubted": len(self.suspects)} if self.judges else {}

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        if not {entry.to for entry in self._entries.values()} <= self._forwarders.keys():
            return "an entry names an unknown forwarder"
        too_much = len(self._entries) > MAX_ENTRIES or len(self._forwarders) > MAX_FORWARDERS
        return "too much is remembered" if too_much else ""
