"""Summaries: what has arrived at each base lately, in a few bits a datum, so that replicas end soon.

Receipts prove arrivals, but they name origins, and many origins take long to name. So a base also sends summaries: each
covers the data that have arrived since the one before. Nodes relay them, and end the replicas that they match. A
summary matches other data too, seldom, and nobody can contradict it. So it ends only replicas that no custodian counts
on, never custody, and it is no proof for anybody. A summary that is lost is not repeated: receipts follow.

Summaries are items of gossip (`rass_mav.core.gossip`) without a hash. Nodes relay those of the bases that they and
their neighbours have routes to: copies of what arrives at a base are along the routes to it.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterable

from rass_mav.core.datum import DatumId
from rass_mav.core.gossip import Gossip
from rass_mav.core.messages import Summary
from rass_mav.core.news.archive import Serials
from rass_mav.core.news.statements import MAX_MARKS, bits_for, make_summary, marks_of
from rass_mav.core.news.table import Identity, Source, Statements

#: Bases whose summaries a node relays, and the summaries that it recognises of each, at most.
MAX_BASES = 16
MAX_SEEN = 64
#: Summaries that wait to be relayed, and the periods for which one waits, at most.
MAX_WAITING = 16
WAITING_PERIODS = 10
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

    def turn(self, turn: int) -> Summary | None:
        """Once a turn of the node: what to send; None: nothing."""
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


class _Heard:
    """A summary that waits to be relayed."""

    __slots__ = ("_check", "summary")

    def __init__(self, summary: Summary) -> None:
        self.summary = summary
        self._check = hash(summary)

    @property
    def sound(self) -> bool:
        """Whether the summary is unchanged since it was heard (as `table.Statement`)."""
        return hash(self.summary) == self._check


class Summaries(NoSummaries):
    """What one node relays, and at a base also what it has to send itself."""

    __slots__ = ("_fresh", "_statements", "_turn", "gossip", "seen")

    def __init__(
        self, rng: random.Random, statements: Statements, fresh: Fresh | None = None, *, period: int = 1
    ) -> None:
        """`statements`: they know which bases neighbours' beacons name. `fresh`: the summaries of this node, a base;
        None: it is none. In each `period` turns at most one summary of others leaves."""
        self._fresh = fresh
        self._statements = statements
        self._turn = 0
        self.seen: dict[Source, dict[Identity, None]] = {}
        """Summaries heard, by base, the oldest first."""
        self.gossip: Gossip[Identity, _Heard] = Gossip(
            rng, period=period, lasts=WAITING_PERIODS * period, most=MAX_WAITING
        )
        """Those to relay."""

    def arrived(self, id: DatumId) -> None:
        if self._fresh is not None:
            self._fresh.arrived(id)

    def is_forged(self, summary: Summary) -> bool:
        return self._fresh is not None and summary[:2] == self._fresh.source and self._fresh.is_forged(summary)

    def hear(self, summary: Summary) -> bool:
        identity: Identity = summary[:4]
        source: Source = summary[:2]
        if source not in self._statements.named or (self._fresh is not None and source == self._fresh.source):
            return True
        seen = self.seen.get(source)
        if seen is None:
            if len(self.seen) >= MAX_BASES and not self._forget_unnamed():
                return True
            seen = self.seen[source] = {}
        elif identity in seen:
            self.gossip.hear(identity)
            return False
        seen[identity] = None
        if len(seen) > MAX_SEEN:
            del seen[next(iter(seen))]
        self.gossip.add(identity, _Heard(summary), source, self._turn)
        return True

    def _forget_unnamed(self) -> bool:
        """Forget the summaries of bases that no beacon names. Returns whether there is space now."""
        self.seen = {source: seen for source, seen in self.seen.items() if source in self._statements.named}
        return len(self.seen) < MAX_BASES

    def turn(self, turn: int) -> Summary | None:
        self._turn = turn
        if self._fresh is not None and (own := self._fresh.turn()) is not None:
            return own
        while (left := self.gossip.leave(turn)) is not None:
            if left[1].sound:
                return left[1].summary
        return None
