"""Receipts: a base's word that data have arrived, told on from neighbour to neighbour until all know.

Each node keeps what it knows of each (origin, epoch) (`arrivals`), and announces a digest of it all in its beacon. In
its turn, once in so many steps, it says one receipt frame at most:

- News: what has changed since it was said here. An entry that a neighbour has said in the same words meanwhile has been
  heard by most, so it is not said again. A neighbour that says less than is known here makes it news again.
- A round: while a neighbour announces another digest, all that is known goes round, most recently changed first, a few
  entries a frame. So a node that was away learns what it has missed.

It comes to an end. What is known only grows, towards what the bases know, so news dies out, and neighbours that hear
each other end with the same digest. If they cannot (one does not hear the other), each round without anything new
learned doubles the pause before the next, and after `MAX_ROUNDS` no more follow until something is learned or a new
neighbour appears. A node that had to forget for want of room would differ for ever: it announces digest 0, which means
"do not compare", it takes no part in rounds, and what it learns at the price of forgetting is no news.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable
from functools import reduce
from itertools import islice
from operator import xor
from zlib import crc32

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Receipt, ReceiptEntry, ReceiptSpan
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.arrivals import NOTHING, Known, canonical, has_arrived, is_told_lost, merged, one
from rass_mav.core.routes.neighbours import Neighbour

#: How many (origin, epoch) pairs a node knows of at most. A base's own are not counted.
MAX_ORIGINS = 1024
#: Bytes for entries in a receipt frame, and what an entry of each kind takes.
RECEIPT_BYTES = 120
ENTRY_BYTES = 12
SPAN_BYTES = 18
#: Bytes of a frame that news leaves to a round that is under way.
ROUND_BYTES = 18
#: Turns that a neighbour's digest must differ before a round begins: news is on its way, mostly.
PATIENCE = 2
#: Turns from one round to the next; doubled with each one while nothing is learned.
PAUSE = 16
#: So many rounds go without anything learned.
MAX_ROUNDS = 6

_PLAIN = NOTHING[1:]
#: The digest of no knowledge at all. 0 means "do not compare".
_EMPTY = 1

#: Entries in a frame at most.
_MOST = RECEIPT_BYTES // ENTRY_BYTES

#: Origin and epoch.
Pair = tuple[int, int]

_pack = struct.Struct("<HIIHHI").pack


def _mark(pair: Pair, known: Known) -> int:
    """32 bits that stand for an entry in the digest."""
    # The middle of the square of a CRC. Not the CRC itself: it is linear, so equal changes of two entries would cancel
    # each other.
    x = crc32(_pack(*pair, *known))
    return x * x >> 16 & 0xFFFFFFFF


class NoReceipts:
    """Of a node that neither says nor hears what has arrived."""

    __slots__ = ()

    told = False
    """Whether bases say what has arrived."""

    def __contains__(self, id: object) -> bool:
        """Whether a datum is known to have arrived at a base."""
        return False

    def told_lost(self, id: DatumId) -> bool:
        """Whether a base was told that a datum is lost, and no base is known to have got it."""
        return False

    def known(self) -> dict[Pair, Known]:
        """All that is known, by (origin, epoch)."""
        return {}

    @property
    def digest(self) -> int:
        """For the beacon: equal digests, equal knowledge. 0: there is no use in comparing."""
        return 0

    def arrived(self, id: DatumId) -> None:
        """At a base: a datum has arrived, the archive has it."""

    def lost(self, id: DatumId) -> None:
        """At a base: a datum was told lost, the archive knows."""

    def learn(self, receipt: Receipt) -> set[Pair]:
        """Take in what a neighbour says. Returns the pairs of which something new is known."""
        return set()

    def due(self, step: int) -> bool:
        """Whether this node has its turn in a step."""
        return False

    def turn(self, neighbours: Collection[Neighbour]) -> Receipt | None:
        """What to say, at most one frame's worth; None: nothing."""
        return None


class Receipts(NoReceipts):
    """What one node knows of arrivals, and what it has to say about them."""

    told = True
    __slots__ = (
        "_archive", "_digest", "_known", "_max_origins", "_met", "_news", "_pause", "_period", "_phase", "_round",
        "_rounds", "_source", "forgetful",
    )  # fmt: skip

    def __init__(
        self, source: Pair = (0, 0), *, archive: Archive | None = None, period: int = 1, phase: int = 0,
        max_origins: int = MAX_ORIGINS,
    ) -> None:  # fmt: skip
        """`source`: (node id, epoch) of a base. `archive`: what has arrived at this very base; None: not a base.

        A turn comes every `period` steps, when (step + phase) is a multiple of it.
        """
        self._source = source
        self._archive = archive
        self._known: dict[Pair, Known] = {}
        """Most recently changed last."""
        self._digest = _EMPTY
        self._max_origins = max_origins
        self._news: dict[Pair, None] = {}
        """What is to be said, the longest waiting first."""
        self._round: dict[Pair, None] = {}
        """What has yet to go round."""
        self._rounds = 0
        """Rounds since something was learned."""
        self._pause = PATIENCE
        """Turns before the next round."""
        self._met: frozenset[Pair] = frozenset()
        """Neighbours at the last turn."""
        self._period = period
        self._phase = phase
        self.forgetful = False
        """Whether anything was forgotten for want of room."""
        if archive is not None:
            for pair in archive:
                self._grow(pair, None, archive.known(pair))
            # Whether that is news to anybody, digests will tell.
            self._news.clear()

    # -- what is known -------------------------------------------------------------------------------------------------

    def __contains__(self, id: object) -> bool:
        if not isinstance(id, DatumId):
            return False
        known = self._known.get((id.origin, id.epoch))
        return known is not None and has_arrived(known, id.sequence)

    def told_lost(self, id: DatumId) -> bool:
        known = self._known.get((id.origin, id.epoch))
        return known is not None and is_told_lost(known, id.sequence)

    def __len__(self) -> int:
        return len(self._known)

    def known(self) -> dict[Pair, Known]:
        return dict(self._known)

    @property
    def digest(self) -> int:
        return 0 if self.forgetful else self._digest or _EMPTY

    def disagreement(self) -> str:
        """What is wrong with its own books, for tests; empty: nothing."""
        if reduce(xor, [_mark(*entry) for entry in self._known.items()], _EMPTY) != self._digest:
            return "the digest is not that of what is known"
        if not (self._news.keys() | self._round.keys()) <= self._known.keys():
            return "something is to be said that is not known"
        return "too much is known" if len(self._known) > self._bound() else ""

    # -- learning ------------------------------------------------------------------------------------------------------

    def arrived(self, id: DatumId) -> None:
        pair = (id.origin, id.epoch)
        held = self._known.get(pair)
        new = one(id.sequence)
        self._grow(pair, held, new if held is None else merged(held, new))

    def lost(self, id: DatumId) -> None:
        pair = (id.origin, id.epoch)
        held = self._known.get(pair)
        self._grow(pair, held, held or NOTHING)

    def learn(self, receipt: Receipt) -> set[Pair]:
        changed: set[Pair] = set()
        get, news, going = self._known.get, self._news, self._round
        for origin, epoch, closed, bitmap in receipt.entries:
            pair = (origin, epoch)
            held = get(pair)
            said = (closed, bitmap, 0, 0)
            if held == said:
                # Said by somebody: most have heard it.
                if pair in news:
                    del news[pair]
                if pair in going:
                    del going[pair]
            elif self._hear(pair, held, said):
                changed.add(pair)
        for origin, epoch, closed, bitmap, lost, floor in receipt.spans:
            pair = (origin, epoch)
            held = get(pair)
            if held == (closed, bitmap, lost, floor):
                if pair in news:
                    del news[pair]
                if pair in going:
                    del going[pair]
            elif self._hear(pair, held, canonical(closed, bitmap, lost, floor)):
                changed.add(pair)
        if changed and self._archive is None:
            self._source = (receipt.base, receipt.base_life)
        return changed

    def _hear(self, pair: Pair, held: Known | None, said: Known) -> bool:
        if held is not None and held[0] < said[0] and self._archive is None and held[1:] == said[1:] == _PLAIN:
            # The usual case: no holes on either side.
            self._put(pair, held, said)
            return True
        if self._grow(pair, held, said if held is None else merged(held, said)):
            return True
        if held is not None:
            # The neighbour is behind.
            self._news[pair] = None
        return False

    def _grow(self, pair: Pair, held: Known | None, known: Known) -> bool:
        """Know more of a pair; False if it is no more."""
        archive = self._archive
        if archive is not None:
            known = archive.completed(pair, known)
        if known == (held or NOTHING):
            return False
        self._put(pair, held, known)
        return True

    def _put(self, pair: Pair, held: Known | None, known: Known) -> None:
        if held is not None:
            self._digest ^= _mark(pair, held)
            del self._known[pair]
        self._digest ^= _mark(pair, known)
        self._known[pair] = known
        if held is None and len(self._known) > self._bound():
            self._forget()
        else:
            self._news[pair] = None
            self._rounds = 0
            if self._pause > PAUSE:
                self._pause = PAUSE

    def _bound(self) -> int:
        return self._max_origins + (0 if self._archive is None else len(self._archive))

    def _forget(self) -> None:
        """Make room: what has not changed for the longest time goes; at a base, of what others told."""
        archive = self._archive
        pair = next(pair for pair in self._known if archive is None or not archive.has(pair))
        self._digest ^= _mark(pair, self._known.pop(pair))
        self._news.pop(pair, None)
        self.forgetful = True
        self._round.clear()

    # -- telling -------------------------------------------------------------------------------------------------------

    def due(self, step: int) -> bool:
        return (step + self._phase) % self._period == 0

    def turn(self, neighbours: Collection[Neighbour]) -> Receipt | None:
        if not self._known:
            return None
        if not self.forgetful:
            self._compare(neighbours)
        news, going = self._news, self._round
        if not news and not going:
            return None
        entries: list[ReceiptEntry] = []
        spans: list[ReceiptSpan] = []
        kept = ROUND_BYTES if going else 0
        room = self._say(list(islice(news, _MOST)), RECEIPT_BYTES - kept, entries, spans)
        self._say(list(islice(reversed(going), _MOST)), room + kept, entries, spans)
        return Receipt(*self._source, tuple(entries), tuple(spans))

    def _say(self, pairs: Iterable[Pair], room: int, entries: list[ReceiptEntry], spans: list[ReceiptSpan]) -> int:
        """Add what fits into `room` bytes, and count it as said. Returns the room left."""
        for pair in pairs:
            known = self._known[pair]
            closed, bitmap, lost, floor = known
            if lost or floor:
                if room < SPAN_BYTES:
                    break
                room -= SPAN_BYTES
                spans.append(ReceiptSpan(*pair, *known))
            else:
                if room < ENTRY_BYTES:
                    break
                room -= ENTRY_BYTES
                entries.append(ReceiptEntry(*pair, closed, bitmap))
            self._news.pop(pair, None)
            self._round.pop(pair, None)
        return room

    def _compare(self, neighbours: Collection[Neighbour]) -> None:
        """Begin a round if a neighbour knows something else, or end it if none does."""
        met = frozenset([(n.id, n.beacon.life) for n in neighbours])
        if not met <= self._met:
            self._rounds = 0
            self._pause = min(self._pause, PATIENCE)
        self._met = met
        digest = self.digest
        if all(n.beacon.digest in (digest, 0) for n in neighbours):
            self._round.clear()
            self._rounds = 0
            self._pause = PATIENCE
        elif self._round:
            return
        elif self._pause:
            self._pause -= 1
        elif self._rounds < MAX_ROUNDS:
            self._pause = PAUSE << self._rounds
            self._rounds += 1
            self._round = dict.fromkeys(self._known)
