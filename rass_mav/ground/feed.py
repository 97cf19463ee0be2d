"""What arrives, in order: the one way to follow a store or a database (docs/integrate/outputs.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from .entry import Data, Entry

#: Seconds between two looks, where there was nothing new.
LOOK_S = 0.5


class Cursor(NamedTuple):
    """A position in what has arrived: it can be kept, and reading goes on behind it."""

    life: int
    epoch: int
    """Of the store, `Data.lineage`. With another one, arrivals may have other numbers."""
    arrival: int = 0
    """The `Entry.arrival` of the last datum; 0: none."""
    apart: int = 0
    """The same of the last second content; 0: none, or they are not of interest."""


class Look(NamedTuple):
    """The data at one moment, and the position from which somebody reads on."""

    data: Data
    start: Cursor
    """The cursor that was given; the beginning if there was none, or if the store has a new life or a new epoch."""
    restarted: bool
    """Whether it has: then what follows may have been seen before, and what was seen may be gone."""

    def arrivals(self, *, second_contents: bool = True) -> Iterator[tuple[Entry, Cursor]]:
        """What has arrived behind `start`: data, and then second contents of ids. Each with the cursor behind it:
        whoever is done with it keeps that, and asks again with it."""
        cursor = self.start
        for entry in self.data.arrivals(cursor.arrival):
            cursor = cursor._replace(arrival=entry.arrival)
            yield entry, cursor
        if second_contents:
            for entry in self.data.arrivals(cursor.apart, apart=True):
                cursor = cursor._replace(apart=entry.arrival)
                yield entry, cursor

    def behind(self, cursor: Cursor) -> int:
        """How many data have arrived behind a cursor, without second contents."""
        return self.data.count(after=cursor.arrival)


class Feed:
    """Follows a store or a database.

    It has no position of its own: where somebody is, only the cursor says that is given and kept. So after whatever
    end, of the node that writes or of the program that reads, reading goes on behind the last cursor that was kept.
    """

    def __init__(self, open: Callable[[], Data], *, keep: bool = False) -> None:
        """`open`: opens the store or the database. `keep`: it stays open between two looks. That saves work where no
        node writes, but a node that ends meanwhile cannot put its files in order."""
        self._open = open
        self._keep = keep
        self._data: Data | None = None

    @contextmanager
    def look(self, cursor: Cursor | None) -> Iterator[Look]:
        """What is there now. `cursor`: None: from the beginning. Be quick: a node that writes cannot shorten its log
        meanwhile. Raises what `open` raises, and `StoreError`; the next look opens it again."""
        try:
            if self._data is None:
                self._data = self._open()
            else:
                self._data.renew()
            begin = Cursor(*self._data.lineage)
            known = cursor is not None and cursor[:2] == begin[:2]
            yield Look(self._data, cursor if cursor is not None and known else begin, cursor is not None and not known)
            if self._keep:
                self._data.rest()
        except BaseException:
            self.close()
            raise
        if not self._keep:
            self.close()

    def close(self) -> None:
        """Release the files or the connection."""
        if self._data is not None:
            self._data.close()
            self._data = None
