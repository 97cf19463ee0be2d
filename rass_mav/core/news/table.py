"""The statements of bases that one node keeps, and what they cover together.

A statement is kept as its base sent it, to be relayed unchanged. One of its entries is dead when another entry of the
same base life about the same data contains it; if two cover the same, the one with the higher serial lives. A statement
without a live entry is forgotten. What lives depends only on which statements were heard, not on their order, and a
hash over it shows whether two nodes know the same.

For the node's own use the live entries of all bases are merged. Because a copy may be deleted on the result, it has a
check word, and is computed again from the statements when that does not match. Statements have check words too: one
flipped bit in memory is found before anything is deleted or relayed because of it.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from zlib import crc32

from rass_mav.core.messages import Receipt, ReceiptEntry, SequenceMark
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.statements import covers, last_of, ranges_of

#: How many statements a node keeps, and of how many base lives.
MAX_STATEMENTS = 4096
MAX_BASES = 16
#: How many entries a node remembers that their origin has denied.
MAX_DENIED = 256
#: Fact: The hash of no knowledge at all. 0 means "do not compare".
EMPTY = 1

#: Origin and epoch.
Pair = tuple[int, int]
#: Node id and life of a base.
Source = tuple[int, int]
#: Base, its life, origin, epoch, and whether it reports losses.
_Place = tuple[int, int, int, int, bool]
#: What identifies a statement: base, its life, serial, checksum.
Identity = tuple[int, int, int, int]

_pack_identity = struct.Struct("<HIII").pack


def mark(identity: Identity) -> int:
    """32 bits that represent a statement in the hash."""
    # The middle of the square of a CRC. Not the CRC itself: it is linear, so marks could cancel each other.
    x = crc32(_pack_identity(*identity))
    return x * x >> 16 & 0xFFFFFFFF


class Statement:
    """A statement, and what still lives of it."""

    __slots__ = ("_check", "identity", "live", "places", "receipt")

    def __init__(self, receipt: Receipt) -> None:
        """`receipt`: sound, as it has just been decoded or made."""
        self.receipt = receipt
        self._check = hash(receipt)
        self.identity: Identity = receipt[:4]
        self.live: set[ReceiptEntry] = set()
        self.places: list[_Place] = []
        """Where entries of it have been live: a flipped bit in an entry does not change this."""

    @property
    def sound(self) -> bool:
        """Whether the statement is unchanged since it is kept."""
        # A tuple's hash changes with any one of its numbers, and a number's with any one of its bits.
        return hash(self.receipt) == self._check


class Sum:
    """What all bases together state about an origin and epoch."""

    __slots__ = ("arrived", "check", "lost")

    def __init__(self) -> None:
        self.arrived = Ranges()
        self.lost = Ranges()
        """Reported lost; some of it may have arrived."""
        self.check = crc32(self.arrived.bounds)
        """CRC-32 of the arrivals."""

    def add(self, entry: ReceiptEntry) -> None:
        """Merge an entry into a sound sum."""
        into = self.lost if entry.lost else self.arrived
        for first, end in ranges_of(entry):
            into.add(first, end)
        self.check = crc32(self.arrived.bounds)


#: Of an origin and epoch about which nothing is stated.
_NOTHING = Sum()


class Statements:
    """What one node knows, statement by statement. Bounded; a base's own archive is separate."""

    __slots__ = (
        "_denied",
        "_live",
        "_max_statements",
        "_sources",
        "_sums",
        "forgetful",
        "gone",
        "named",
        "of",
        "statements_hash",
    )  # fmt: skip

    def __init__(self, max_statements: int = MAX_STATEMENTS) -> None:
        self._max_statements = max_statements
        self.of: dict[Identity, Statement] = {}
        """All of them, the latest heard last."""
        self._sources: dict[Source, dict[Identity, Statement]] = {}
        """The same by base life."""
        self._live: dict[_Place, dict[ReceiptEntry, Statement]] = {}
        """Live entries."""
        self._sums: dict[Pair, Sum] = {}
        """Computed on request."""
        self._denied: dict[tuple[Identity, Pair], SequenceMark] = {}
        """Entries that their origin has denied, the oldest first."""
        self.statements_hash = EMPTY
        self.forgetful = False
        """Whether anything was forgotten or not accepted for lack of space."""
        self.named: Collection[Source] = ()
        """Bases that neighbours' beacons name: statements of other bases do not replace theirs."""
        self.gone: list[Identity] = []
        """Statements forgotten since this list was last cleared."""

    # -- knowledge -----------------------------------------------------------------------------------------------------

    def sum(self, pair: Pair) -> Sum:
        """What all bases together state about an origin and epoch; sound."""
        found = self._sums.get(pair)
        if found is not None and crc32(found.arrived.bounds) == found.check:
            return found
        live = self.live_of(pair)
        return self._make_sum(pair, live) if found is not None or live else _NOTHING

    def _make_sum(self, pair: Pair, live: list[tuple[ReceiptEntry, Statement]]) -> Sum:
        made = Sum()
        damaged: list[Statement] = []
        any_live = False
        for entry, statement in live:
            if entry in statement.receipt.entries and statement.sound:
                made.add(entry)
                any_live = True
            else:
                damaged.append(statement)
        for statement in damaged:
            self.forget(statement)
        self._sums.pop(pair, None)
        if any_live:
            self._sums[pair] = made
        return made

    def live_of(self, pair: Pair) -> list[tuple[ReceiptEntry, Statement]]:
        """The live entries about an origin and epoch."""
        found: list[tuple[ReceiptEntry, Statement]] = []
        for source in self._sources:
            for lost in (False, True):
                live = self._live.get((*source, *pair, lost))
                if live:
                    found += live.items()
        return found

    def pairs(self) -> set[Pair]:
        """All origins and epochs about which anything is stated."""
        return {(entry.origin, entry.epoch) for statement in self.of.values() for entry in statement.live}

    @property
    def bases(self) -> int:
        """How many bases, or lives of theirs, state anything."""
        return len(self._sources)

    @property
    def reported(self) -> int:
        """About how many origins and epochs anything is stated, counted once for each base."""
        return len(self._live)

    def by(self, source: Source) -> Collection[Statement]:
        """The statements of one base life."""
        return self._sources.get(source, {}).values()

    def says(self, source: Source, entry: ReceiptEntry) -> bool:
        """Whether a base is known to have stated all that an entry covers."""
        live = self._live.get((*source, entry.origin, entry.epoch, entry.lost), ())
        return any(covers(other, entry) for other in live)

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        statements_hash = EMPTY
        for identity in self.of:
            statements_hash ^= mark(identity)
        if statements_hash != self.statements_hash:
            return "the hash does not match the statements"
        if any(
            not statement.live or not statement.live <= set(statement.receipt.entries) for statement in self.of.values()
        ):
            return "a statement without a live entry is kept"
        live = [(entry, statement) for entries in self._live.values() for entry, statement in entries.items()]
        if sum(len(statement.live) for statement in self.of.values()) != len(live):
            return "the live entries are not those of the statements"
        if any(
            entry not in statement.live or self.of.get(statement.identity) is not statement for entry, statement in live
        ):
            return "an entry of a statement that is not kept is live"
        if any(self.sum(pair) is not found for pair, found in list(self._sums.items())):
            return "a sum is not sound"
        if len(self._denied) > MAX_DENIED:
            return "too much is denied"
        return "too many statements" if len(self.of) > self._max_statements or len(self._sources) > MAX_BASES else ""

    # -- adding statements ---------------------------------------------------------------------------------------------

    def add(self, receipt: Receipt) -> tuple[set[Pair], bool, list[Statement]]:
        """Add a sound statement that is not kept. Returns the pairs about which something new is known; whether it is
        news to relay; and, if no entry of it lives, the statements that cover it."""
        statement, killed = Statement(receipt), False
        changed: set[Pair] = set()
        better: list[Statement] = []
        identity = statement.identity
        base, life = source = receipt[:2]
        if not self._admits(source):
            return changed, False, better
        for entry in receipt.entries:
            origin, epoch, _, _, _, lost = entry
            pair = (origin, epoch)
            if self._denied and (identity, pair) in self._denied:
                continue
            place = (base, life, origin, epoch, lost)
            above, below = self._beside(statement, entry, place)
            if above is not None:
                better.append(above)
                continue
            self._enter(statement, entry, place, below)
            killed = killed or bool(below)
            changed.add(pair)
        if not statement.live:
            return changed, False, better
        self.of[identity] = self._sources.setdefault(source, {})[identity] = statement
        self.statements_hash ^= mark(identity)
        full = len(self.of) > self._max_statements
        if full:
            self.forgetful = True
            most = max(self._sources.values(), key=len)
            self.forget(most[min(most, key=lambda identity: identity[2:])])
        return changed, identity in self.of and (killed or not full), []

    def _beside(
        self, statement: Statement, entry: ReceiptEntry, place: _Place
    ) -> tuple[Statement | None, list[ReceiptEntry]]:
        """The statement because of which an entry is dead from the beginning; and the entries that die because of it,
        if there is none."""
        below: list[ReceiptEntry] = []
        for other, owner in list(self._live.get(place, {}).items()):
            if covers(other, entry) and (other != entry or owner.identity >= statement.identity):
                if owner is statement or owner.sound:
                    return owner, below
                self.forget(owner)
            elif covers(entry, other):
                below.append(other)
        return None, below

    def _enter(self, statement: Statement, entry: ReceiptEntry, place: _Place, below: list[ReceiptEntry]) -> None:
        """Add a live entry, because of which those below die."""
        live = self._live.setdefault(place, {})
        statement.live.add(entry)
        statement.places.append(place)
        for other in below:
            if other in live:
                self._end(live.pop(other), other)
        live[entry] = statement
        pair = place[2:4]
        found = self._sums.get(pair)
        if found is not None:
            if crc32(found.arrived.bounds) == found.check:
                found.add(entry)
            else:
                del self._sums[pair]

    def _end(self, statement: Statement, entry: ReceiptEntry) -> None:
        statement.live.discard(entry)
        if not statement.live and statement.identity in self.of:
            self._leave(statement)

    def _admits(self, source: Source) -> bool:
        """Whether there is space for another base life. One that beacons name replaces one that none does."""
        if source in self._sources or len(self._sources) < MAX_BASES:
            return True
        self.forgetful = True
        others = [other for other in self._sources if other not in self.named]
        if source not in self.named or not others:
            return False
        for statement in list(self._sources[others[0]].values()):
            self.forget(statement)
        return True

    def forget(self, statement: Statement) -> None:
        """Drop a statement, even if some of it lives."""
        # By identity: nothing else in a damaged statement can be relied on.
        for key in statement.places:
            live = self._live.get(key, {})
            for entry in [entry for entry, other in live.items() if other is statement]:
                del live[entry]
            if not live:
                self._live.pop(key, None)
            self._sums.pop(key[2:4], None)
        statement.live.clear()
        if statement.identity in self.of:
            self._leave(statement)

    def _leave(self, statement: Statement) -> None:
        identity = statement.identity
        del self.of[identity]
        source = self._sources[identity[:2]]
        del source[identity]
        if not source:
            del self._sources[identity[:2]]
        self.statements_hash ^= mark(identity)
        self.gone.append(identity)

    # -- denials -------------------------------------------------------------------------------------------------------

    def deny(self, sequence_mark: SequenceMark, since: int = 0) -> bool:
        """An origin states how many numbers it has assigned: entries that name others are dead. Returns whether there
        are any.

        `since`: how many more it may have assigned since then.
        """
        pair = (sequence_mark.origin, sequence_mark.epoch)
        false = [
            (entry, statement)
            for entry, statement in self.live_of(pair)
            if last_of(entry) >= sequence_mark.assigned + since
        ]
        for entry, statement in false:
            self._denied[statement.identity, pair] = sequence_mark
            if len(self._denied) > MAX_DENIED:
                del self._denied[next(iter(self._denied))]
            key = (*statement.identity[:2], *pair, entry.lost)
            del self._live[key][entry]
            if not self._live[key]:
                del self._live[key]
            self._end(statement, entry)
        if false:
            self._sums.pop(pair, None)
        return bool(false)

    def is_disputed(self, pair: Pair) -> bool:
        """Whether an origin has denied what bases state about its numbers."""
        return any(denied == pair for _, denied in self._denied)

    def denials(self, receipt: Receipt) -> Iterator[SequenceMark]:
        """What origins have denied of a statement."""
        if self._denied:
            identity: Identity = receipt[:4]
            for pair in {(entry.origin, entry.epoch) for entry in receipt.entries}:
                sequence_mark = self._denied.get((identity, pair))
                if sequence_mark is not None:
                    yield sequence_mark
