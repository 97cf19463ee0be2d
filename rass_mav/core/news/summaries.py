"""Summaries: what has arrived at each base lately, in a few bits a datum, so that replicas end soon.

Receipts prove arrivals, but they name origins, and many origins take long to name. So a base also sends summaries: each
covers the data that have arrived since the one before. Nodes relay them, and end the replicas that they match. A
summary matches other data too, seldom, and nobody can contradict it. So it ends only replicas that no custodian counts
on, never custody, and it is no proof for anybody. A summary that is lost is not repeated: receipts follow.

Nodes relay the summaries of the bases that they and their neighbours have routes to: copies of what arrives at a base
are along the routes to it. What a node keeps is bounded for each base, and in all. In its turn a node sends the summary
that it has heard the fewest times. One that it has heard `ENOUGH` times is not repeated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Container, Iterable

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Summary
from rass_mav.core.news.archive import Serials
from rass_mav.core.news.statements import MAX_MARKS, bits_for, make_summary, marks_of
from rass_mav.core.news.table import Identity, Source
from rass_mav.core.routes.neighbours import Neighbour

#: Bases whose summaries a node relays, and the summaries that it recognises of each, at most.
MAX_BASES = 16
MAX_SEEN = 64
#: Summaries that wait to be relayed, and the turns for which one waits, at most.
MAX_WAITING = 16
WAITING_TURNS = 10
#: A summary heard so many times is not relayed: most nodes have heard it.
ENOUGH = 3
#: Arrivals that wait at a base for a summary, at most.
MAX_FRESH = 1024
#: With so many arrivals a summary is well filled, and its marks still have twelve bits. It has more only while more
#: wait than one can hold.
WELL_FILLED = 50


def matched(summary: Summary, ids: Iterable[DatumId]) -> list[DatumId]:
    """Which of these data a summary matches: all that it was made of, and others by accident."""
    ids = list(ids)
    if not ids:
        return []
    marks = set(summary.marks)
    own = marks_of(ids, summary.base, summary.base_life, summary.serial, len(summary.marks) << summary.bits)
    return [id for id, mark in zip(ids, own, strict=True) if mark in marks]


class NoSummaries:
    """For a node that neither sends nor hears summaries."""

    __slots__ = ()

    def arrived(self, id: DatumId) -> None:
        """At a base: a datum has arrived."""

    def is_forged(self, summary: Summary) -> bool:
        """At a base: whether a summary in its name is not its own."""
        return False

    def hear(self, summary: Summary) -> bool:
        """A neighbour sends a summary. Returns whether it may be new."""
        return False

    def turn(self, step: int, neighbours: Collection[Neighbour]) -> Summary | None:
        """Once a step: what to send; None: nothing."""
        return None


class Fresh:
    """The summaries of one base."""

    __slots__ = ("_ids", "_period", "_sent", "_serials", "_since", "source")

    def __init__(self, source: Source, serials: Serials, period: int) -> None:
        """`source`: the base's node id and life. `period`: a few arrivals wait for so many steps."""
        self.source = source
        self._serials = serials
        self._period = period
        self._ids: deque[DatumId] = deque(maxlen=MAX_FRESH)
        """What has arrived since the last summary, the oldest first."""
        self._since = 0
        """Steps since then."""
        self._sent: deque[tuple[int, int]] = deque(maxlen=MAX_SEEN)
        """Serial and checksum of the last summaries."""

    def arrived(self, id: DatumId) -> None:
        """A datum has arrived for the first time."""
        self._ids.append(id)

    def is_forged(self, summary: Summary) -> bool:
        """Whether a summary in this base's name and life is not one of its last ones, nor an older one."""
        oldest = self._sent[0][0] if self._sent else self._serials.next
        older = (summary.serial - oldest & 0xFFFFFFFF) >= 1 << 31
        return not older and (summary.serial, summary.crc) not in self._sent

    def turn(self) -> Summary | None:
        """Once a step: the next summary, if it is due. The more has arrived, the sooner it is."""
        self._since += 1
        count = len(self._ids)
        full, filled = count >= MAX_MARKS, count >= WELL_FILLED
        wait = self._period // 3 if full else self._period // 2 if filled else self._period
        if not count or self._since < wait:
            return None
        self._since = 0
        ids = [self._ids.popleft() for _ in range(MAX_MARKS if full else min(count, WELL_FILLED))]
        serial, bits = self._serials.draw(), bits_for(len(ids))
        summary = make_summary(*self.source, serial, bits, marks_of(ids, *self.source, serial, len(ids) << bits))
        self._sent.append((serial, summary.crc))
        return summary


class _Waiting:
    __slots__ = ("_check", "heard", "summary", "until")

    def __init__(self, summary: Summary, until: int) -> None:
        self.summary = summary
        self._check = hash(summary)
        self.heard = 1
        self.until = until
        """The turn in which it is too late to relay it."""

    @property
    def sound(self) -> bool:
        """Whether the summary is unchanged since it was heard (as `table.Kept`)."""
        return hash(self.summary) == self._check


class Summaries(NoSummaries):
    """What one node relays, and at a base also what it has to send itself."""

    __slots__ = ("_fresh", "_named", "_period", "_phase", "_turns", "seen", "waiting")

    def __init__(self, fresh: Fresh | None = None, *, period: int = 1, phase: int = 0) -> None:
        """`fresh`: the summaries of this node, a base; None: it is none.

        A node relays a summary at most once in `period` steps, when (step + phase) is a multiple of it.
        """
        self._fresh = fresh
        self._period = period
        self._phase = phase
        self._turns = 0
        self._named: Container[Source] = ()
        """The bases whose summaries are relayed here."""
        self.seen: dict[Source, dict[Identity, None]] = {}
        """Summaries heard, by base, the oldest first."""
        self.waiting: dict[Identity, _Waiting] = {}
        """Those to relay, the oldest first."""

    def arrived(self, id: DatumId) -> None:
        if self._fresh is not None:
            self._fresh.arrived(id)

    def is_forged(self, summary: Summary) -> bool:
        return self._fresh is not None and summary[:2] == self._fresh.source and self._fresh.is_forged(summary)

    def hear(self, summary: Summary) -> bool:
        identity: Identity = summary[:4]
        waiting = self.waiting.get(identity)
        if waiting is not None:
            waiting.heard += 1
            if waiting.heard >= ENOUGH:
                del self.waiting[identity]
            return False
        source: Source = summary[:2]
        if source not in self._named or (self._fresh is not None and source == self._fresh.source):
            return True
        seen = self.seen.get(source)
        if seen is None:
            if len(self.seen) >= MAX_BASES:
                return True
            seen = self.seen[source] = {}
        elif identity in seen:
            return False
        seen[identity] = None
        if len(seen) > MAX_SEEN:
            del seen[next(iter(seen))]
        self.waiting[identity] = _Waiting(summary, self._turns + WAITING_TURNS)
        if len(self.waiting) > MAX_WAITING:
            del self.waiting[max(self.waiting, key=lambda other: self.waiting[other].heard)]
        return True

    def turn(self, step: int, neighbours: Collection[Neighbour]) -> Summary | None:
        if self._fresh is not None and (own := self._fresh.turn()) is not None:
            return own
        if (step + self._phase) % self._period:
            return None
        self._turns += 1
        self._look_round(neighbours)
        waiting = self.waiting
        for identity in [identity for identity, one in waiting.items() if one.until <= self._turns]:
            del waiting[identity]
        while waiting:
            identity = min(waiting, key=lambda other: waiting[other].heard)
            one = waiting.pop(identity)
            if one.sound:
                return one.summary
        return None

    def _look_round(self, neighbours: Collection[Neighbour]) -> None:
        """Note which bases the neighbours have routes to; this node's own route is one of theirs."""
        named = {(n.beacon.base, n.beacon.base_life) for n in neighbours if n.beacon.hops != NO_ROUTE}
        if named:
            self._named = named
            for source in [source for source in self.seen if source not in named]:
                del self.seen[source]
