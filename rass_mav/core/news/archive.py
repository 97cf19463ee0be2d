"""A base's archive: what has arrived there, and what was reported lost to it. Its composer states that in receipts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from heapq import nlargest
from itertools import islice
from operator import itemgetter

from rass_mav.core.datum import STORE_FAULTS, DatumId, Fate
from rass_mav.core.messages import Receipt, ReceiptEntry
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.statements import RECEIPT_BITS, blocks, covers, entry_bytes, entry_of, make_receipt, ranges_of
from rass_mav.core.news.table import Pair, Source, Statements
from rass_mav.core.store import Store

#: How many losses a base accepts for one origin, and in all. Any radio can invent them, or with keys one drone's own,
#: so they are limited.
MAX_LOST_OF_ONE = 4096
MAX_REPORTED_LOST = 32768
#: Epochs of one origin, and pairs of origin and epoch in all, of which a base knows losses and nothing else.
MAX_EPOCHS = 64
MAX_PAIRS = 4096
#: How many reports of damaged stores and unknown numbers a base keeps.
MAX_STORE_FAULTS = 1024


class _Origin:
    """The data of one origin and epoch."""

    __slots__ = ("arrived", "lost")

    def __init__(self) -> None:
        self.arrived = Ranges()
        self.lost = Ranges()
        """Reported lost; some of them may have arrived since."""


class Archive:
    """What has become of all data, as far as one base knows. Its size grows with what has arrived, in ranges; losses
    are bounded."""

    __slots__ = ("_epochs", "_losses_only", "_origins", "_stated", "_told_of", "reported_lost", "store_faults")

    def __init__(self, ids: Iterable[DatumId] = (), losses: Iterable[tuple[DatumId, Fate]] = ()) -> None:
        """What the store holds, and its table of losses."""
        self._origins: dict[tuple[int, int], _Origin] = {}
        self._losses_only: set[tuple[int, int]] = set()
        """Pairs of which nothing has arrived."""
        self._epochs: dict[int, int] = {}
        """How many of these an origin has."""
        self._stated = 0
        """Data ever reported lost."""
        self._told_of: Counter[int] = Counter()
        """The same by origin."""
        self.reported_lost = 0
        """Data reported lost that have not arrived."""
        self.store_faults: dict[DatumId, Fate] = {}
        """Reports about no single datum: of damaged stores, and of numbers that no node knows of."""
        for id in ids:
            self.add(id)
        for id, fate in losses:
            self.lose(id, fate)

    def add(self, id: DatumId) -> bool:
        """A datum has arrived; if it was reported lost, it is lost no longer. False: it had arrived before."""
        key = (id.origin, id.epoch)
        origin = self._origins.get(key)
        if origin is None:
            origin = self._origins[key] = _Origin()
        elif key in self._losses_only:
            self._losses_only.remove(key)
            self._epochs[id.origin] -= 1
        if id.sequence in origin.arrived:
            return False
        origin.arrived.add(id.sequence, id.sequence + 1)
        if id.sequence in origin.lost:
            self.reported_lost -= 1
        return True

    def lose(self, id: DatumId, fate: Fate) -> bool:
        """A datum was reported lost, or a store damaged. False: that is known, or it has arrived, or there is no
        space."""
        if fate in STORE_FAULTS:
            if id in self.store_faults or len(self.store_faults) >= MAX_STORE_FAULTS:
                return False
            self.store_faults[id] = fate
            return True
        if self._stated >= MAX_REPORTED_LOST or self._told_of[id.origin] >= MAX_LOST_OF_ONE:
            return False
        key = (id.origin, id.epoch)
        origin = self._origins.get(key)
        if origin is None:
            epochs = self._epochs.get(id.origin, 0)
            if epochs >= MAX_EPOCHS or len(self._losses_only) >= MAX_PAIRS:
                return False
            self._epochs[id.origin] = epochs + 1
            self._losses_only.add(key)
            origin = self._origins[key] = _Origin()
        elif id.sequence in origin.lost or id.sequence in origin.arrived:
            return False
        origin.lost.add(id.sequence, id.sequence + 1)
        self._stated += 1
        self._told_of[id.origin] += 1
        self.reported_lost += 1
        return True

    def is_lost(self, id: DatumId) -> bool:
        """Whether a datum was reported lost, and has not arrived."""
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and id.sequence in origin.lost and id.sequence not in origin.arrived

    def __contains__(self, id: object) -> bool:
        """Whether a datum has arrived."""
        if not isinstance(id, DatumId):
            return False
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and id.sequence in origin.arrived

    def __len__(self) -> int:
        """How many (origin, epoch) pairs there are."""
        return len(self._origins)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """(origin, epoch) of all data."""
        return iter(self._origins)

    def has(self, key: tuple[int, int]) -> bool:
        """Whether anything is known of an (origin, epoch)."""
        return key in self._origins

    def end(self, key: tuple[int, int]) -> int:
        """One more than the highest number of an (origin, epoch) that has arrived; 0: none has."""
        origin = self._origins.get(key)
        return 0 if origin is None else origin.arrived.end

    def ranges(self, key: tuple[int, int], *, lost: bool) -> Ranges:
        """What has arrived of an (origin, epoch), or was reported lost; KeyError if nothing is known of it."""
        origin = self._origins[key]
        return origin.lost if lost else origin.arrived


#: Fact: Bytes for entries in a receipt frame.
RECEIPT_BYTES = 112
#: Fact: Entries in one of a busy base, by its size.
USUAL_ENTRIES = 10
# Tuned: python -m tools.sensitivity news.archive
#: Turns after a start in which a base only listens: what neighbours know from its earlier life need not be sent.
LISTEN_TURNS = 24
#: The content of a statement with at most this many live entries is restated in another statement, if there is space.
LIGHT = 5
#: Bound: At how many changes a statement looks at a time.
MOST_PLACES = 16
#: Bound: How many serials a base claims on disk at a time.
SERIALS_CLAIMED = 256

#: Origin and epoch, reported lost or not, block.
_Place = tuple[Pair, bool, int]


class Serials:
    """The serials of a base's statements: none is used twice, not even in another run."""

    __slots__ = ("_claimed", "_next", "_store")

    def __init__(self, store: Store) -> None:
        self._store = store
        self._next = self._claimed = store.get_meta("statement") or 0

    def draw(self) -> int:
        """The next one, 32 bits."""
        if self._next == self._claimed:
            self._claimed = self._next + SERIALS_CLAIMED & 0xFFFFFFFF
            self._store.set_meta("statement", self._claimed)
        serial = self._next
        self._next = serial + 1 & 0xFFFFFFFF
        return serial


class ReportComposer:
    """The base's own statements."""

    __slots__ = ("_archive", "_by_age", "_listening", "_serials", "_statements", "_unsaid", "_unsure", "source")

    def __init__(self, source: Source, archive: Archive, serials: Serials, statements: Statements) -> None:
        """`statements`: what is known in the swarm, including this base's own earlier statements."""
        self.source = source
        """The base: (node id, life)."""
        self._archive = archive
        self._serials = serials
        self._statements = statements
        self._unsaid: dict[_Place, int] = {}
        """How many changes have not been sent yet, the longest waiting first."""
        self._by_age = False
        """Whether the next statement is about what has waited longest; if not, about what has changed most. Junk and
        notes of invented nodes change little each, so they do not keep back the others."""
        self._unsure: dict[_Place, None] = {
            (pair, lost, block): None
            for pair in archive
            for lost in (False, True)
            for block in blocks(archive.ranges(pair, lost=lost))
        }
        """What was there at the start: it may or may not have been sent in an earlier run."""
        self._listening = LISTEN_TURNS

    def changed(self, id: DatumId, *, lost: bool) -> None:
        """A datum has arrived, or was reported lost; the archive knows."""
        place = ((id.origin, id.epoch), lost, id.sequence // RECEIPT_BITS)
        self._unsaid[place] = self._unsaid.get(place, 0) + 1

    def contradicts(self, receipt: Receipt) -> bool:
        """Whether a statement in this base's name covers a datum that has not arrived here."""
        return receipt[:2] == self.source and any(not self._has(e) for e in receipt.entries if not e.lost)

    def _has(self, entry: ReceiptEntry) -> bool:
        pair = (entry.origin, entry.epoch)
        if not self._archive.has(pair):
            return False
        arrived = self._archive.ranges(pair, lost=False)
        return all(arrived.holds(first, end) for first, end in ranges_of(entry))

    def denied(self, pair: Pair) -> None:
        """An origin, or another node in its name, denies what was stated about it: state again what is here."""
        if self._archive.has(pair):
            for lost in (False, True):
                for block in blocks(self._archive.ranges(pair, lost=lost)):
                    self._unsaid.setdefault((pair, lost, block), 1)

    def turn(self) -> None:
        """Once a turn."""
        if self._unsure:
            self._listening -= 1
            if not self._listening:
                self._unsaid.update(dict.fromkeys(self._unsure, 1))
                self._unsure = {}

    def statement(self) -> Receipt | None:
        """The statement to send next; None: nothing."""
        entries: list[ReceiptEntry] = []
        room = RECEIPT_BYTES
        self._by_age = not self._by_age
        while room and self._unsaid:
            for place in self._next():
                entry = self._entry(*place)
                if entry is not None and not self._statements.says(self.source, entry):
                    size = _growth(entries, entry)
                    if size > room:
                        return self._made(entries)
                    if size:
                        entries.append(entry)
                        room -= size
                del self._unsaid[place]
        if not entries:
            return None
        self._restate(entries, room)
        return self._made(entries)

    def _next(self) -> list[_Place]:
        """Some of what has not been sent; of what has changed as much, the latest."""
        if self._by_age:
            return list(islice(self._unsaid, MOST_PLACES))
        return [place for place, _ in nlargest(MOST_PLACES, reversed(self._unsaid.items()), key=itemgetter(1))]

    def _made(self, entries: list[ReceiptEntry]) -> Receipt:
        return make_receipt(*self.source, self._serials.draw(), entries)

    def _entry(self, pair: Pair, lost: bool, block: int) -> ReceiptEntry | None:
        return entry_of(*pair, self._archive.ranges(pair, lost=lost), block, lost=lost)

    def _restate(self, entries: list[ReceiptEntry], room: int) -> None:
        """Restate the content of statements with few live entries, so that they can be forgotten."""
        light = [kept for kept in self._statements.by(self.source) if len(kept.live) <= LIGHT]
        for kept in sorted(light, key=lambda kept: (len(kept.live), kept.receipt.serial)):
            more: list[ReceiptEntry] = []
            size = 0
            for old in kept.live:
                pair = (old.origin, old.epoch)
                new = None
                if self._archive.has(pair):
                    new = self._entry(pair, old.lost, (old.first + old.run - 1) // RECEIPT_BITS)
                if new is None or not covers(new, old):
                    # Not its own statement, or one from before a restart.
                    break
                size += (growth := _growth(entries + more, new))
                if growth:
                    more.append(new)
            else:
                if size > room:
                    return
                entries += more
                room -= size


def _growth(entries: list[ReceiptEntry], entry: ReceiptEntry) -> int:
    """Bytes that another entry takes; 0: the others cover it already."""
    for other in entries:
        if other[:2] == entry[:2] and other.lost == entry.lost and covers(other, entry):
            return 0
    return len(entry_bytes(entry))
