"""Takers that deliver, and takers that do not: what each neighbour made of the data that it took from this node.

COMMITTED says that a neighbour has taken a datum; only a base's word shows that the datum has arrived. So a node
remembers what it has handed over to whom. What a base confirms counts for the taker, what is overdue counts against it,
and the older counts fade. The result is the chance p that this neighbour delivers:

- By costs, the way by a neighbour costs 1 / p times as much, as a lossy link does (ETX, De Couto et al. 2003).
- With p below `DOUBTED` a neighbour is doubted: it is chosen only if no other is fit. It may have few data at a time,
  and after each failure none for a while, twice as long each time. Now and then it is given a single datum to prove
  itself, because it may be an honest drone whose own next hop has failed. What it has is handed over again at once.

Blame must hit the right one:

- Who says that it is near a base must deliver soon, and who is farther gets more time. So a drone beside the one that
  drops data learns before others doubt the drone.
- Time counts only while this node and the taker have a route, the taker is heard, and news of arrivals comes in. So
  nobody is blamed on an island, or where receipts are off.
- The data of each giver count alike, own data as those of one giver. Others' data count against a taker only if data of
  their origin have arrived. So whoever hands over junk that no base confirms cannot discredit those that take it.
- Junk may have the numbers of honest drones, and reach this node among other data. So who delivers the node's own data,
  which are no junk, is not doubted for others'.
- A late confirmation takes back the blame, unless the neighbour is doubted by then: those that had the datum before
  have probably sent it again, by another way. So a doubted neighbour is judged by what it is given from then on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Digest
from rass_mav.core.news.digests import matched
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.shares import greediest

#: A datum is overdue this many turns after it was taken, and as many more for each hop between its taker and the base,
JUDGED_TURNS = 20
#: up to this many hops,
MOST_HOPS = 4
#: but not before the usual time and this many times its deviation have passed.
DEVIATIONS = 6.0
#: However slow data seem to be, a datum is overdue after this many turns.
MOST_TURNS = 1200
#: How fast the usual time and its deviation follow.
TAKES_GAIN, DEVIATION_GAIN = 1 / 16, 1 / 8
#: Each datum that is judged makes those judged before count for this much less.
FADE = 1 / 12
#: The data of one giver count in full from this many on,
MATURE = 4.0
#: and before any is judged it counts for this many givers that all goes well.
PRIOR = 0.25
#: From so many of the node's own data on, older ones counting less, a neighbour delivers at least as large a share as
#: of these.
OWN = 2.0
#: A neighbour that delivers less than this share is doubted.
DOUBTED = 0.5
#: A neighbour that delivers more than this share costs no more than others: some receipts are always late.
FINE = 0.75
#: The least that p counts as.
LEAST = 1 / 64
#: A doubted neighbour that failed again is left alone for as long as it had time, twice as long each time, up to this
#: many times.
MOST_DOUBLINGS = 3
#: A doubted neighbour may have twice as many data with each one that arrives. With this many it is doubted no more.
TRUSTED = 16
#: Without news of arrivals for this many turns nobody is judged.
NEWS_TURNS = 30
#: After this many turns without a route all waits begin again.
GAP_TURNS = 10
#: The most data, neighbours, and givers for each neighbour, that a node remembers.
MAX_GIVEN = 2048
MAX_TAKERS = 64
MAX_GIVERS = 8


class NoTakers:
    """For a node that does not hear what arrives: it judges nobody."""

    __slots__ = ("doubting",)

    def __init__(self) -> None:
        self.doubting = False
        """Whether any neighbour is doubted."""

    def gave(self, id: DatumId, giver: int | None, to: int, *, again: bool) -> None:
        """A neighbour has taken custody of a datum. `giver`: the node that this one had it from; None: it is its own.
        `again`: it was handed over before, so its receipt may be due to the taker before."""

    def came_back(self, id: DatumId) -> None:
        """A datum is in custody here again."""

    def heed(self, changed: set[Pair], receipts: NoReceipts) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""

    def heed_digest(self, digest: Digest) -> None:
        """A base reports what has arrived lately."""

    def step(self, routing: RoutingTable) -> None:
        """Once a turn: judge what is overdue, and tell the neighbours' table."""

    def allowance(self, neighbour: int) -> int | None:
        """How many more data a neighbour may be given now; None: any number."""
        return None

    def has_failed(self, id: DatumId) -> bool:
        """Whether a datum that was handed over should go to another node now: its taker came to be doubted since."""
        return False

    def probes(self, neighbours: Iterable[Neighbour]) -> Iterator[int]:
        """The doubted neighbours that may prove themselves now, with one datum each."""
        return iter(())

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {}


class Given(NamedTuple):
    """A datum that a neighbour took."""

    to: int
    giver: int | None
    since: int
    """By the taker's clock."""
    turn: int
    """By the node's."""
    again: bool


class Taker:
    """What is remembered of one neighbour."""

    __slots__ = ("clock", "doubted", "doubted_since", "failed", "givers", "late", "open", "rests_until", "window")

    def __init__(self) -> None:
        self.clock = 0
        """Turns in which it could have delivered."""
        self.open: dict[DatumId, Given] = {}
        """What it took and has not been judged, the oldest first."""
        self.late: dict[DatumId, Given] = {}
        """What was overdue and may still arrive, the oldest first."""
        self.givers: dict[int | None, tuple[float, float]] = {}
        """By the node that the data were from: how many arrived, and how many were overdue; older ones count less."""
        self.doubted = False
        self.doubted_since = 0
        """By its clock."""
        self.window = 1
        """While it is doubted: how many data it may have at a time."""
        self.failed = 0
        """While it is doubted: how often it failed in a row."""
        self.rests_until = 0
        """While it is doubted: when it may have the next one, by its clock."""

    def count(self, giver: int | None, *, good: float = 0.0, bad: float = 0.0) -> None:
        """A datum from a giver is judged, or judged otherwise than before."""
        givers = self.givers
        was = givers.pop(giver, (0.0, 0.0))
        fade = 1.0 - FADE
        if len(givers) >= MAX_GIVERS:
            del givers[min(givers, key=lambda other: sum(givers[other]))]
        givers[giver] = (fade * was[0] + good, max(0.0, fade * was[1] + bad))

    @property
    def delivers(self) -> float:
        """The chance that it delivers what it takes, 0..1."""
        weight = share = PRIOR
        own = 0.0
        for giver, (good, bad) in self.givers.items():
            judged = good + bad
            if judged > 0.0:
                counts = min(1.0, judged / MATURE)
                weight += counts
                share += counts * good / judged
                if giver is None and judged >= OWN:
                    own = good / judged
        return max(own, share / weight)


class Takers(NoTakers):
    """What one node knows of those that take data from it."""

    __slots__ = ("_arrives", "_deviation", "_gap", "_heard", "_of", "_takers", "_takes", "_turn")

    def __init__(self, arrives: Callable[[Pair], bool]) -> None:
        """`arrives`: whether any datum of an (origin, epoch) has arrived."""
        super().__init__()
        self._arrives = arrives
        self._takers: dict[int, Taker] = {}
        """By node id, the latest used last."""
        self._of: dict[DatumId, int] = {}
        """Who took a datum that may still be confirmed, the oldest first."""
        self._turn = 0
        self._heard = -NEWS_TURNS
        """The turn in which news of arrivals came last."""
        self._gap = 0
        """Turns without a route."""
        self._takes = 0.0
        """The usual time from a hand-over to its confirmation, turns,"""
        self._deviation = 0.0
        """and its mean deviation."""

    def gave(self, id: DatumId, giver: int | None, to: int, *, again: bool) -> None:
        self._forget(id)
        taker = self._takers.pop(to, None) or Taker()
        self._takers[to] = taker
        if len(self._takers) > MAX_TAKERS:
            self._drop_taker()
        taker.open[id] = Given(to, giver, taker.clock, self._turn, again)
        self._of[id] = to
        if len(self._of) > MAX_GIVEN:
            self._drop_given()

    def _drop_taker(self) -> None:
        """Too many neighbours are remembered: forget one that is not doubted, if there is any, the longest unused."""
        takers = self._takers
        gone = next((to for to, taker in takers.items() if not taker.doubted), next(iter(takers)))
        taker = takers.pop(gone)
        for id in (*taker.open, *taker.late):
            del self._of[id]

    def _drop_given(self) -> None:
        """Too many data are remembered: forget the oldest of the neighbour that has most of them."""
        taker = self._takers[greediest({to: len(t.open) + len(t.late) for to, t in self._takers.items()})]
        self._forget(next(iter(taker.late or taker.open)))

    def _forget(self, id: DatumId) -> tuple[Taker, Given, bool] | None:
        """Returns who took it, how, and whether it was overdue."""
        to = self._of.pop(id, None)
        if to is None:
            return None
        taker = self._takers[to]
        given = taker.open.pop(id, None)
        return (taker, taker.late.pop(id), True) if given is None else (taker, given, False)

    def came_back(self, id: DatumId) -> None:
        self._forget(id)

    # -- news ----------------------------------------------------------------------------------------------------------

    def heed(self, changed: set[Pair], receipts: NoReceipts) -> None:
        self._heard = self._turn
        for id in [id for id in self._of if id[:2] in changed]:
            if id in receipts:
                self._confirmed(id)
            elif receipts.told_lost(id):
                self._failed(id)

    def heed_digest(self, digest: Digest) -> None:
        self._heard = self._turn
        for id in matched(digest, self._of):
            self._confirmed(id)

    def _confirmed(self, id: DatumId) -> None:
        found = self._forget(id)
        if found is None:
            return
        taker, given, late = found
        if not given.again:
            took = min(self._turn - given.turn, MOST_TURNS)
            self._deviation += DEVIATION_GAIN * (abs(took - self._takes) - self._deviation)
            self._takes += TAKES_GAIN * (took - self._takes)
        if taker.doubted and (late or given.since < taker.doubted_since):
            # It has probably arrived by another way.
            return
        taker.count(given.giver, good=1.0, bad=-1.0 if late else 0.0)
        if taker.doubted:
            taker.window *= 2
            taker.failed = 0
            taker.rests_until = 0
            if taker.window >= TRUSTED:
                taker.doubted = False
                taker.givers.clear()

    def _failed(self, id: DatumId) -> None:
        found = self._forget(id)
        if found is not None and not found[2]:
            self._judge(id, found[0], found[1])

    def _judge(self, id: DatumId, taker: Taker, given: Given) -> None:
        """A datum was not delivered."""
        if given.giver is not None and not self._arrives(id[:2]):
            # It may be junk, which no base ever confirms.
            return
        if given.again and not taker.doubted:
            # Another taker did not deliver it either: the cause may be the datum.
            return
        taker.count(given.giver, bad=1.0)
        if taker.doubted:
            if given.since >= taker.doubted_since and taker.clock >= taker.rests_until:
                taker.rests_until = taker.clock + (taker.clock - given.since << taker.failed)
                taker.failed = min(taker.failed + 1, MOST_DOUBLINGS)
            taker.window = 1
        elif taker.delivers < DOUBTED:
            taker.doubted = True
            taker.doubted_since = taker.clock
            taker.window = 1
            taker.failed = 0
            taker.rests_until = taker.clock + JUDGED_TURNS

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
        self.doubting = False
        for to, taker in self._takers.items():
            neighbour = neighbours.get(to)
            if neighbour is None:
                continue
            hops = neighbour.beacon.hops
            if ticks and hops != NO_ROUTE:
                taker.clock += 1
                before = taker.clock - self._wait(hops)
                while taker.open:
                    id, given = next(iter(taker.open.items()))
                    if given.since >= before:
                        break
                    taker.late[id] = taker.open.pop(id)
                    self._judge(id, taker, given)
            p = taker.delivers
            neighbour.doubted = taker.doubted
            self.doubting |= taker.doubted
            neighbour.odds = 1.0 if p > FINE and not taker.doubted else 1.0 / max(p, LEAST)

    def _wait(self, hops: int) -> float:
        """After how many turns a datum is overdue at a neighbour that is this far from a base."""
        usual = self._takes + DEVIATIONS * self._deviation
        return min(max(JUDGED_TURNS * (1 + min(hops, MOST_HOPS)), usual), MOST_TURNS)

    def _begin_again(self) -> None:
        for taker in self._takers.values():
            taker.open = {id: given._replace(since=taker.clock) for id, given in taker.open.items()}

    # -- who may have what ---------------------------------------------------------------------------------------------

    def has_failed(self, id: DatumId) -> bool:
        to = self._of.get(id)
        if to is None:
            return False
        taker = self._takers[to]
        given = taker.open.get(id)
        return taker.doubted and (given is None or given.since < taker.doubted_since)

    def allowance(self, neighbour: int) -> int | None:
        taker = self._takers.get(neighbour)
        if taker is None or not taker.doubted:
            return None
        return 0 if taker.clock < taker.rests_until else max(0, taker.window - len(taker.open))

    def probes(self, neighbours: Iterable[Neighbour]) -> Iterator[int]:
        for neighbour in neighbours:
            beacon = neighbour.beacon
            if neighbour.doubted and beacon.hops != NO_ROUTE and beacon.free and self.allowance(neighbour.id):
                yield neighbour.id

    def figures(self) -> dict[str, int]:
        return {"doubted": sum(taker.doubted for taker in self._takers.values())}

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        known = {id: to for to, taker in self._takers.items() for id in (*taker.open, *taker.late)}
        if known != self._of:
            return "the data are not those of the takers"
        if len(self._of) > MAX_GIVEN or len(self._takers) > MAX_TAKERS:
            return "too much is remembered"
        return "" if all(len(t.givers) <= MAX_GIVERS for t in self._takers.values()) else "too many givers"
