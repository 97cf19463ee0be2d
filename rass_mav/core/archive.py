"""Which data have arrived: a base's archive index, and what other nodes learn of it from receipts."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable

from .datum import DatumId
from .messages import Receipt, ReceiptEntry

#: Origins in one receipt (what fits a frame).
RECEIPT_ENTRIES = 10
#: Sequence numbers beyond the closed ones that a receipt can name.
RECEIPT_BITS = 16
#: How many (origin, epoch) pairs a node that is no base remembers receipts of.
MAX_ORIGINS = 1024


class SequenceSet:
    """A set of sequence numbers that mostly grows without holes: all below `closed`, and some beyond."""

    __slots__ = ("beyond", "closed")

    def __init__(self) -> None:
        self.closed = 0
        self.beyond: set[int] = set()

    def add(self, sequence: int) -> bool:
        """False if it was there already."""
        if sequence in self:
            return False
        self.beyond.add(sequence)
        while self.closed in self.beyond:
            self.beyond.remove(self.closed)
            self.closed += 1
        return True

    def close(self, below: int) -> None:
        """Add everything below a number."""
        if below > self.closed:
            self.closed = below
            self.beyond = {s for s in self.beyond if s >= below}
            while self.closed in self.beyond:
                self.beyond.remove(self.closed)
                self.closed += 1

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.closed or sequence in self.beyond


class Archive:
    """The data that have arrived at a base. At the base it is complete; elsewhere it holds what receipts said."""

    def __init__(self, ids: Iterable[DatumId] = (), *, max_origins: int | None = None) -> None:
        """`max_origins`: bound of (origin, epoch) pairs, the longest unchanged are forgotten first; None: no bound."""
        self._sets: OrderedDict[tuple[int, int], SequenceSet] = OrderedDict()
        self._max_origins = max_origins
        self._changed: OrderedDict[tuple[int, int], None] = OrderedDict()
        for id in ids:
            self.add(id)

    def add(self, id: DatumId) -> bool:
        """A datum has arrived. False: it had arrived before."""
        key = (id.origin, id.epoch)
        self._changed[key] = None
        return self._set(key).add(id.sequence)

    def _set(self, key: tuple[int, int]) -> SequenceSet:
        known = self._sets.get(key)
        if known is None:
            if self._max_origins is not None and len(self._sets) >= self._max_origins:
                self._sets.popitem(last=False)
            known = self._sets[key] = SequenceSet()
        return known

    def __contains__(self, id: DatumId) -> bool:
        known = self._sets.get((id.origin, id.epoch))
        return known is not None and id.sequence in known

    def __bool__(self) -> bool:
        return bool(self._sets)

    def receipt(self, base: int, base_epoch: int) -> Receipt | None:
        """A receipt for origins of which data have arrived since the last one, at most one frame's worth."""
        entries: list[ReceiptEntry] = []
        while self._changed and len(entries) < RECEIPT_ENTRIES:
            (origin, epoch), _ = self._changed.popitem(last=False)
            known = self._sets[origin, epoch]
            bitmap = 0
            for bit in range(RECEIPT_BITS):
                if known.closed + 1 + bit in known.beyond:
                    bitmap |= 1 << bit
            if known.closed or bitmap:
                entries.append(ReceiptEntry(origin, epoch, known.closed, bitmap))
        return Receipt(base, base_epoch, tuple(entries)) if entries else None

    def learn(self, receipt: Receipt) -> None:
        """Take in a base's receipt."""
        for entry in receipt.entries:
            key = (entry.origin, entry.epoch)
            known = self._set(key)
            self._sets.move_to_end(key)
            known.close(entry.closed)
            for bit in range(RECEIPT_BITS):
                if entry.bitmap >> bit & 1:
                    known.add(entry.closed + 1 + bit)
            if self._max_origins is not None and len(known.beyond) > 4 * RECEIPT_BITS:
                # Bounded: what is far beyond a hole is forgotten, and learned again when the hole is closed.
                known.beyond = set(sorted(known.beyond)[: 4 * RECEIPT_BITS])
