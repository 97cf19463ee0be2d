"""The content of one file on a disk, and the changes that are not durable yet."""

from __future__ import annotations

from itertools import pairwise
from random import Random

#: Bytes that are written completely or not at all.
SECTOR = 512


class Image:
    """The durable bytes of a file, and the changes since its last sync."""

    __slots__ = ("_changes", "durable", "exact")

    def __init__(self, content: bytes) -> None:
        self.durable = bytearray(content)
        """What is on the medium."""
        self.exact = True
        """False once changes have been lost: the file as programs see it then differs from the medium."""
        # Offset and data of a write, or the new length and None for a truncation.
        self._changes: list[tuple[int, bytes | None]] = []

    @property
    def settled(self) -> bool:
        """Whether the medium has the file as programs see it."""
        return self.exact and not self._changes

    def write(self, offset: int, data: bytes) -> None:
        """Record a write."""
        self._changes.append((offset, data))

    def truncate(self, length: int) -> None:
        """Record a truncation."""
        self._changes.append((length, None))

    def sync(self) -> None:
        """Make all changes durable."""
        for offset, data in self._changes:
            self._apply(offset, data)
        self._changes.clear()

    def lose(self, rng: Random) -> None:
        """Make durable the changes that the generator picks, tearing writes between sectors, and forget the rest."""
        if not self._changes:
            return
        self.exact = False
        # Drawn for each power cut, so that all and nothing are as likely as anything in between.
        kept = rng.choice((0.0, rng.random(), 1.0))
        torn = rng.choice((0.0, rng.random()))
        for offset, data in self._changes:
            if data is not None and rng.random() < torn:
                end = offset + len(data)
                bounds = [offset, *range((offset // SECTOR + 1) * SECTOR, end, SECTOR), end]
                for start, stop in pairwise(bounds):
                    if rng.random() < 0.5:
                        self._apply(start, data[start - offset : stop - offset])
            elif rng.random() < kept:
                self._apply(offset, data)
        self._changes.clear()

    def _apply(self, offset: int, data: bytes | None) -> None:
        durable = self.durable
        if data is None:
            del durable[offset:]
            return
        if offset > len(durable):
            durable.extend(bytes(offset - len(durable)))
        durable[offset : offset + len(data)] = data
