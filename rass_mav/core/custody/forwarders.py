"""Forwarders that deliver, and forwarders that do not: what each neighbour made of the data that it took from this
node.

COMMITTED says that a neighbour has taken a datum; only a base's word shows that the datum has arrived. So a node
remembers what it has handed over to whom. What a base confirms counts for the forwarder, what is overdue counts against
it, and the older counts fade. The result is the chance p that this neighbour delivers:

- By costs, the way by a neighbour costs 1 / p times as much, as a lossy link does (ETX, De Couto et al. 2003).
- With p below `SUSPECTED` a neighbour is suspected: it is chosen only if no other is fit. It may have few data at a
  time, and after each failure none for a while, twice as long each time. Now and then it is given a single datum to
  prove itself, because it may be an honest drone whose own next hop has failed. What it has is handed over again at
  once.

Blame must hit the right one:

- Who says that it is near a base must deliver soon, and who is farther gets more time. So a drone beside the one that
  drops data learns before others doubt the drone.
- Time counts only while this node and the forwarder have a route, the forwarder is heard, and news of arrivals comes
  in. So nobody is blamed on an island, or where receipts are off.
- The data of each sender count alike, own data as those of one sender. Others' data count against a forwarder only if
  data of their origin have arrived. So whoever hands over junk that no base confirms cannot discredit those that take
  it.
- Junk may have the numbers of honest drones, and reach this node among other data. So who delivers the node's own data,
  which are no junk, is not suspected for others'.
- But a neighbour may deliver what the node has created, and drop all else. So samples of what it did not deliver are
  handed over to another neighbour. If they arrive soon, they were no junk, and it is judged by others' data.
- Names are free, so one that drops data may come back under a new one. So a node also counts what all neighbours
  deliver that have delivered nothing before, together. If that is too little, a new one is given a datum, and no more
  until this one has arrived, as long as another neighbour delivers.
- A late confirmation takes back the blame, for all may be slow. But it does not if the neighbour is suspected by then,
  nor for others' data if it delivers the node's own in time: those that had the datum before have probably sent it
  again, by another way. For the same reason the node's own data show how long data usually take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Summary
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.summaries import matched
from rass_mav.core.news.table import Pair
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.shares import greediest

#: Each datum that is judged makes those judged before count for this much less.
FADE = 1 / 12
#: The data of one sender count in full from this many on,
MATURE = 4.0
#: and before any is judged it counts for this many senders that all goes well.
PRIOR = 0.25
#: From so many of the node's own data on, older ones counting less, a neighbour delivers at least as large a share as
#: of these,
OWN = 2.0
#: until so many samples, older ones counting less, show that others' data were no junk,
REAL = 1.5
#: and at least so many for each that shows nothing: it may have been junk, or was dropped behind the other neighbour.
REAL_EACH = 0.5
#: A neighbour that delivers less than this share is suspected.
SUSPECTED = 0.5
#: A suspected neighbour that failed again is left alone for as long as it had time, twice as long each time, up to this
#: many times.
MOST_DOUBLINGS = 3
#: A suspected neighbour may have twice as many data with each one that arrives. With this many it is suspected no more.
TRUSTED = 16
#: So many data a neighbour may have that has not delivered any yet, if others like it did not deliver: names are free.
NEW = 1
#: The most senders for each neighbour that a node remembers.
MAX_CUSTODIANS = 8


class HandedOver(NamedTuple):
    """A datum that a neighbour took."""

    to: int
    received_from: int | None
    since: int
    """By the forwarder's clock."""
    turn: int
    """By the node's."""
    before: int | None
    """Who took it before and did not deliver it: its confirmation may be due to that one."""


class Forwarder:
    """One neighbour."""

    __slots__ = (
        "clock",
        "custodians",
        "delivers",
        "failed",
        "hops",
        "late",
        "new",
        "open",
        "probe",
        "real",
        "rests_until",
        "suspected",
        "suspected_for_others",
        "suspected_since",
        "unknown",
        "window",
    )  # fmt: skip

    def __init__(self) -> None:
        self.clock = 0
        """Turns in which it could have delivered."""
        self.open: dict[DatumId, HandedOver] = {}
        """What it took and has not been judged, the oldest first."""
        self.late: dict[DatumId, HandedOver] = {}
        """What was overdue and may still arrive, the oldest first."""
        self.custodians: dict[int | None, tuple[float, float]] = {}
        """By the node that the data were from: how many arrived, and how many were overdue; older ones count less."""
        self.delivers = 1.0
        """The chance that it delivers what it takes, 0..1."""
        self.probe: DatumId | None = None
        """Which of the overdue data should be handed over to another neighbour."""
        self.real = 0.0
        """Samples that arrived soon by another neighbour,"""
        self.unknown = 0.0
        """and those that did not; older ones count less."""
        self.new = True
        """Whether it has delivered nothing yet."""
        self.hops = NO_ROUTE
        """How far from a base it was when it was last heard."""
        self.suspected = False
        self.suspected_for_others = False
        """While it is suspected: whether it delivered the node's own data."""
        self.suspected_since = 0
        """By its clock."""
        self.window = 1
        """While it is suspected: how many data it may have at a time."""
        self.failed = 0
        """While it is suspected: how often it failed in a row."""
        self.rests_until = 0
        """While it is suspected: when it may have the next one, by the node's turns."""

    # -- what it delivers ----------------------------------------------------------------------------------------------

    def count(self, custodian: int | None, *, good: float = 0.0, bad: float = 0.0) -> None:
        """A datum from a sender is judged, or judged otherwise than before."""
        custodians = self.custodians
        was = custodians.pop(custodian, (0.0, 0.0))
        fade = 1.0 - FADE
        if len(custodians) >= MAX_CUSTODIANS:
            del custodians[min(custodians, key=lambda other: sum(custodians[other]))]
        custodians[custodian] = (fade * was[0] + good, max(0.0, fade * was[1] + bad))
        self._estimate()

    def probed(self, *, arrived: bool) -> None:
        """A datum that it did not deliver was handed over to another neighbour. `arrived`: soon after that."""
        fade = 1.0 - FADE
        self.real = fade * self.real + arrived
        self.unknown = fade * self.unknown + (not arrived)
        self._estimate()

    def _estimate(self) -> None:
        if self.real >= max(REAL, REAL_EACH * self.unknown):
            self.delivers = self.of_others
        else:
            self.delivers = max(self.of_own, self._mean(self.custodians))

    @property
    def of_others(self) -> float:
        """The share that it delivers of what others gave to the node, 0..1."""
        return self._mean(custodian for custodian in self.custodians if custodian is not None)

    def _mean(self, custodians: Iterable[int | None]) -> float:
        """The share that it delivers of each sender's data, 0..1, the mean."""
        weight = share = PRIOR
        for custodian in custodians:
            good, bad = self.custodians[custodian]
            judged = good + bad
            if judged > 0.0:
                counts = min(1.0, judged / MATURE)
                weight += counts
                share += counts * good / judged
        return share / weight

    @property
    def of_own(self) -> float:
        """The share that it delivers of the node's own data, 0..1; 0: of too few to tell."""
        good, bad = self.custodians.get(None, (0.0, 0.0))
        return good / (good + bad) if good + bad >= OWN else 0.0

    # -- while it is suspected -----------------------------------------------------------------------------------------

    def suspect(self, rests_until: int) -> None:
        """From now on. `rests_until`: when it may have a datum again, by the node's turns."""
        self.suspected = True
        self.suspected_for_others = self.of_own >= SUSPECTED
        self.suspected_since = self.clock
        self.window = 1
        self.failed = 0
        self.rests_until = rests_until

    def delivered(self, handover: HandedOver) -> None:
        """It delivered a datum in time."""
        if self.suspected_for_others and handover.received_from is None:
            # It has always delivered these.
            return
        self.window *= 2
        self.failed = 0
        self.rests_until = 0
        if self.window >= TRUSTED:
            self.suspected = False
            self.custodians.clear()
            self._estimate()

    def dropped(self, handover: HandedOver, turn: int, longest: int) -> None:
        """A datum is overdue in this turn of the node. `longest`: after that many turns it may have another one."""
        if handover.since >= self.suspected_since and turn >= self.rests_until:
            self.rests_until = min(turn + (self.clock - handover.since << self.failed), handover.turn + longest)
            self.failed = min(self.failed + 1, MOST_DOUBLINGS)
        self.window = 1


#: A datum is overdue this many turns after it was taken, and as many more for each hop between its forwarder and the
#: base,
JUDGED_TURNS = 20
#: up to this many hops,
MOST_HOPS = 4
#: but not before the usual time and this many times its deviation have passed.
DEVIATIONS = 6.0
#: A sample arrives soon if it takes no longer than the usual time and this many times its deviation.
SOON = 2.0
#: Which datum is the sample changes every so many turns.
PROBE_TURNS = 15
#: However slow data seem to be, a datum is overdue after this many turns.
MOST_TURNS = 1200
#: How fast the usual time and its deviation follow.
TAKES_GAIN, DEVIATION_GAIN = 1 / 16, 1 / 8
#: A neighbour that delivers more than this share costs no more than others: some receipts are always late.
FINE = 0.75
#: The least that p counts as.
LEAST = 1 / 64
#: A suspected neighbour is never given nothing for more turns than this.
LONGEST_REST = JUDGED_TURNS << MOST_DOUBLINGS
#: Without news of arrivals for this many turns nobody is judged.
NEWS_TURNS = 30
#: After this many turns without a route all waits begin again.
GAP_TURNS = 10
#: The most data, and neighbours, that a node remembers.
MAX_SEQUENCE_MARKS = 2048
MAX_FORWARDERS = 64


class NoForwarders:
    """For a node that does not hear what arrives: it judges nobody."""

    __slots__ = ("suspecting",)

    def __init__(self) -> None:
        self.suspecting = False
        """Whether any neighbour is suspected."""

    def gave(self, id: DatumId, custodian: int | None, to: int, before: int | None) -> None:
        """A neighbour has taken custody of a datum. `custodian`: the node that this one had it from; None: it is its
        own. `before`: who took it before and did not deliver it."""

    def came_back(self, id: DatumId) -> None:
        """A datum is in custody here again."""

    def apply(self, changed: set[Pair], receipts: NoReceipts) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""

    def apply_summary(self, summary: Summary) -> None:
        """A base reports what has arrived lately."""

    def step(self, routing: RoutingTable) -> None:
        """Once a turn: judge what is overdue, and tell the neighbours' table."""

    def allowance(self, neighbour: int) -> int | None:
        """How many more data a neighbour may be given now; None: any number."""
        return None

    def has_failed(self, id: DatumId) -> bool:
        """Whether a datum that was handed over should go to another node now: its forwarder came to be suspected
        since."""
        return False

    def probes(self, neighbours: Iterable[Neighbour]) -> Iterator[int]:
        """The suspected neighbours that may prove themselves now, with one datum each."""
        return iter(())

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {}


class Forwarders(NoForwarders):
    """What one node knows of those that take data from it."""

    __slots__ = (
        "_arrives",
        "_by_own",
        "_deviation",
        "_forwarders",
        "_gap",
        "_heard",
        "_new",
        "_of",
        "_takes",
        "_turn",
        "_wary",
    )  # fmt: skip

    def __init__(self, arrives: Callable[[Pair], bool]) -> None:
        """`arrives`: whether any datum of an (origin, epoch) has arrived."""
        super().__init__()
        self._arrives = arrives
        self._forwarders: dict[int, Forwarder] = {}
        """By node id, the latest used last."""
        self._of: dict[DatumId, int] = {}
        """Who took a datum that may still be confirmed, the oldest first."""
        self._turn = 0
        self._heard = -NEWS_TURNS
        """The turn in which news of arrivals came last."""
        self._gap = 0
        """Turns without a route."""
        self._new = Forwarder()
        """What all those delivered, together, that had delivered nothing before."""
        self._wary = False
        """Whether they deliver too little, and another neighbour with a route has delivered."""
        self._takes = 0.0
        """The usual time from a hand-over to its confirmation, turns,"""
        self._deviation = 0.0
        """and its mean deviation,"""
        self._by_own = False
        """by the node's own data. False: none has arrived yet, so by others'."""

    def gave(self, id: DatumId, custodian: int | None, to: int, before: int | None) -> None:
        self._forget(id)
        forwarder = self._forwarders.pop(to, None) or Forwarder()
        self._forwarders[to] = forwarder
        if len(self._forwarders) > MAX_FORWARDERS:
            self._drop_forwarder()
        forwarder.open[id] = HandedOver(to, custodian, forwarder.clock, self._turn, before)
        self._of[id] = to
        if len(self._of) > MAX_SEQUENCE_MARKS:
            self._drop_given()

    def _drop_forwarder(self) -> None:
        """Too many neighbours are remembered: forget one that has delivered nothing, if there is any; of these one that
        is not suspected, if there is any; and of these the longest unused."""
        forwarders = self._forwarders
        forwarder = forwarders.pop(min(forwarders, key=lambda to: (not forwarders[to].new, forwarders[to].suspected)))
        for id in (*forwarder.open, *forwarder.late):
            del self._of[id]

    def _drop_given(self) -> None:
        """Too many data are remembered: forget the oldest of the neighbour that has most of them."""
        forwarder = self._forwarders[greediest({to: len(t.open) + len(t.late) for to, t in self._forwarders.items()})]
        self._forget(next(iter(forwarder.late or forwarder.open)))

    def _forget(self, id: DatumId) -> tuple[Forwarder, HandedOver, bool] | None:
        """Returns who took it, how, and whether it was overdue."""
        to = self._of.pop(id, None)
        if to is None:
            return None
        forwarder = self._forwarders[to]
        handover = forwarder.open.pop(id, None)
        return (forwarder, forwarder.late.pop(id), True) if handover is None else (forwarder, handover, False)

    def came_back(self, id: DatumId) -> None:
        self._forget(id)

    # -- news ----------------------------------------------------------------------------------------------------------

    def apply(self, changed: set[Pair], receipts: NoReceipts) -> None:
        self._heard = self._turn
        for id in [id for id in self._of if id[:2] in changed]:
            if id in receipts:
                self._confirmed(id)
            elif receipts.is_reported_lost(id):
                self._failed(id)

    def apply_summary(self, summary: Summary) -> None:
        self._heard = self._turn
        for id in matched(summary, self._of):
            self._confirmed(id)

    def _confirmed(self, id: DatumId) -> None:
        found = self._forget(id)
        if found is None:
            return
        forwarder, handover, late = found
        own = handover.received_from is None
        took = min(self._turn - handover.turn, MOST_TURNS)
        if handover.before is not None:
            self._probed(handover, arrived=took <= self._usual(SOON))
        elif own or not self._by_own:
            self._by_own |= own
            self._deviation += DEVIATION_GAIN * (abs(took - self._takes) - self._deviation)
            self._takes += TAKES_GAIN * (took - self._takes)
        elsewhere = late and not own and forwarder.of_own >= FINE
        if elsewhere or (forwarder.suspected and (late or handover.since < forwarder.suspected_since)):
            # It has probably arrived by another way.
            return
        forwarder.count(handover.received_from, good=1.0, bad=-1.0 if late else 0.0)
        if forwarder.new:
            self._new.count(None, good=1.0, bad=-1.0 if late else 0.0)
            forwarder.new = late
        if forwarder.suspected:
            forwarder.delivered(handover)

    def _failed(self, id: DatumId) -> None:
        found = self._forget(id)
        if found is not None and not found[2]:
            self._judge(id, found[0], found[1])

    def _judge(self, id: DatumId, forwarder: Forwarder, handover: HandedOver) -> None:
        """A datum was not delivered."""
        if handover.received_from is not None and not self._arrives(id[:2]):
            # It may be junk, which no base ever confirms.
            return
        self._probed(handover, arrived=False)
        if handover.before is not None and not forwarder.suspected:
            # Another forwarder did not deliver it either: the cause may be the datum.
            return
        forwarder.count(handover.received_from, bad=1.0)
        if forwarder.new:
            self._new.count(None, bad=1.0)
        if forwarder.suspected:
            forwarder.dropped(handover, self._turn, LONGEST_REST)
        elif forwarder.delivers < SUSPECTED:
            forwarder.suspect(self._turn + JUDGED_TURNS)

    def _probed(self, handover: HandedOver, *, arrived: bool) -> None:
        """What became of a datum. If another neighbour had it before, that says whether it was junk."""
        before = None if handover.before is None else self._forwarders.get(handover.before)
        if before is not None and handover.received_from is not None and handover.before != handover.to:
            before.probed(arrived=arrived)

    # -- judgement -----------------------------------------------------------------------------------------------------

    def step(self, routing: RoutingTable) -> None:
        self._turn += 1
        neighbours = routing.neighbours
        if routing.route is None:
            self._gap += 1
        elif self._gap:
            if self._gap >= GAP_TURNS:
                self._begin_again()
            self._gap = 0
        ticks = not self._gap and self._turn - self._heard < NEWS_TURNS
        self.suspecting = False
        self._wary = self._new.delivers <= FINE and any(
            not (forwarder.new or forwarder.suspected)
            and (neighbour := neighbours.get(to))
            and neighbour.beacon.hops != NO_ROUTE
            for to, forwarder in self._forwarders.items()
        )
        for to, forwarder in self._forwarders.items():
            neighbour = neighbours.get(to)
            if neighbour is not None:
                forwarder.hops = neighbour.beacon.hops
            elif not forwarder.new:
                continue
            # What a new one had when it left becomes overdue all the same.
            hops = forwarder.hops
            if ticks and hops != NO_ROUTE:
                forwarder.clock += 1
                before = forwarder.clock - self._wait(hops) if forwarder.open else 0.0
                while forwarder.open:
                    id, handover = next(iter(forwarder.open.items()))
                    if handover.since >= before:
                        break
                    forwarder.late[id] = forwarder.open.pop(id)
                    self._judge(id, forwarder, handover)
            if neighbour is None:
                continue
            p = forwarder.delivers
            forwarder.probe = None
            if forwarder.late and not forwarder.suspected and forwarder.of_others < SUSPECTED:
                others = [id for id, handover in forwarder.late.items() if handover.received_from is not None]
                # A node may have copies of only some.
                forwarder.probe = others[self._turn // PROBE_TURNS % len(others)] if others else None
            neighbour.suspected = forwarder.suspected or (self._wary and self._may_have(forwarder) == 0)
            self.suspecting |= forwarder.suspected
            neighbour.odds = 1.0 if p > FINE and not forwarder.suspected else 1.0 / max(p, LEAST)

    def _wait(self, hops: int) -> float:
        """After how many turns a datum is overdue at a neighbour that is this far from a base."""
        return min(max(JUDGED_TURNS * (1 + min(hops, MOST_HOPS)), self._usual(DEVIATIONS)), MOST_TURNS)

    def _usual(self, deviations: float) -> float:
        return self._takes + deviations * self._deviation

    def _begin_again(self) -> None:
        for forwarder in self._forwarders.values():
            forwarder.open = {id: handover._replace(since=forwarder.clock) for id, handover in forwarder.open.items()}

    # -- who may have what ---------------------------------------------------------------------------------------------

    def has_failed(self, id: DatumId) -> bool:
        to = self._of.get(id)
        if to is None:
            return False
        forwarder = self._forwarders[to]
        if not forwarder.suspected:
            return id == forwarder.probe or (self._wary and forwarder.new and id in forwarder.late)
        handover = forwarder.open.get(id)
        return handover is None or handover.since < forwarder.suspected_since

    def allowance(self, neighbour: int) -> int | None:
        forwarder = self._forwarders.get(neighbour)
        if forwarder is None or not forwarder.suspected:
            return self._may_have(forwarder)
        if self._turn < forwarder.rests_until:
            return 0
        # Where it is the only way to a base there is no news until it delivers something, so nothing is judged.
        recent = sum(handover.turn > self._turn - LONGEST_REST for handover in forwarder.open.values())
        return max(0, forwarder.window - recent)

    def _may_have(self, forwarder: Forwarder | None) -> int | None:
        """How many more data a neighbour may be given that is not suspected; None: any number. One that has delivered
        nothing yet may have few, if others like it did not deliver."""
        if not self._wary or not (forwarder is None or forwarder.new):
            return None
        if forwarder is None:
            return NEW
        since = self._turn - LONGEST_REST
        recent = sum(each.turn > since for each in (*forwarder.open.values(), *forwarder.late.values()))
        return max(0, NEW - recent)

    def probes(self, neighbours: Iterable[Neighbour]) -> Iterator[int]:
        for neighbour in neighbours:
            beacon = neighbour.beacon
            if neighbour.suspected and beacon.hops != NO_ROUTE and beacon.free and self.allowance(neighbour.id):
                yield neighbour.id

    def figures(self) -> dict[str, int]:
        return {"doubted": sum(forwarder.suspected for forwarder in self._forwarders.values())}

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        known = {id: to for to, forwarder in self._forwarders.items() for id in (*forwarder.open, *forwarder.late)}
        if known != self._of:
            return "the data are not those of the forwarders"
        if len(self._of) > MAX_SEQUENCE_MARKS or len(self._forwarders) > MAX_FORWARDERS:
            return "too much is remembered"
        return (
            "" if all(len(t.custodians) <= MAX_CUSTODIANS for t in self._forwarders.values()) else "too many custodians"
        )
