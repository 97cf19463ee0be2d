"""What a damaged store still holds: every datum and every loss whose checksum matches, wherever it is.

Every page is read as the log has it last. If the list of free pages is damaged, these are read too. So data that were
passed on long ago may come back: custody is at-least-once. docs/store.md says what this saves beyond SQLite alone.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum

from .disk import HOST
from .files import LOG_ENDINGS, beside
from .log import LogFrame, is_page_size, log_page_bytes, read_log
from .mark import Mark
from .pages import FoundLoss, found_in, free_pages, rows_on
from .payloads import Payloads
from .schema import (
    EARLIER_PAGE_BYTES,
    EPOCH,
    INSERT_APART,
    INSERT_LOSS,
    LIFE,
    NEXT_SEQUENCE,
    OWN_PREFIX,
    PAGE_BYTES,
    WRITTEN,
    datum_row,
    loss_row,
)  # fmt: skip

#: No row takes less space, bytes: this bounds how many there can have been.
MIN_ROW_BYTES = 32
#: So much of the database is read at a time to find its page size, bytes: whole pages of every size.
_PIECE_BYTES = 65536
#: The page size is the one that has found the most when one has found so many rows and frames.
_ENOUGH = 100
_INSERT_AS_IT_CAME = (
    "INSERT INTO datum (arrival, origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
)


class Salvaged(NamedTuple):
    """What was salvaged, and what is known of the rest."""

    data: int
    """Data and second contents that are in the new store now."""
    epochs: dict[int, int]
    """Own epochs that may be incomplete, with the numbers of each that are known to be assigned."""
    lost: int
    """The most data and losses that may be gone."""
    numbers: dict[str, int]
    """What its node noted, without the store's own numbers."""


class _Remains:
    """The pages of a damaged store: their size, the latest state of each, and the large payloads beside them."""

    def __init__(self, path: Path) -> None:
        """`path`: of the database. `OSError`."""
        log = beside(path, LOG_ENDINGS[0])
        self._files = [_opened(path), _opened(log)]
        self.payloads = Payloads(path, HOST, writable=False)
        database, _ = self._files
        self._database_bytes = 0 if database is None else os.fstat(database).st_size
        self.size = sum(os.fstat(file).st_size for file in self._files if file is not None)
        self.page_bytes = log_page_bytes(log) or self._likeliest_page_bytes(log)
        self.log = read_log(log, self.page_bytes)
        frames = self.log.frames[: self.log.committed] if self.log.intact else self.log.frames
        self._newest = {frame.page: frame.at for frame in frames if frame.sound}

    def fetch(self, number: int) -> bytes | None:
        """The latest state of a page; None: there is none."""
        at = self._newest.get(number)
        return self._stored(self.page_bytes, number) if at is None else self._read(1, at, self.page_bytes)

    def state(self, frame: LogFrame) -> bytes | None:
        """A page as a frame of the log contains it."""
        return self._read(1, frame.at, self.page_bytes)

    def newest(self) -> Iterator[tuple[int, bytes]]:
        """The latest state of each page."""
        for number in sorted(self._newest.keys() | set(range(1, self._database_bytes // self.page_bytes + 1))):
            page = self.fetch(number)
            if page is not None:
                yield number, page

    def close(self) -> None:
        """Release the files."""
        for file in self._files:
            if file is not None:
                os.close(file)
        self.payloads.close()

    def _likeliest_page_bytes(self, log: Path) -> int:
        """The page size with which the most rows and frames match their checksums."""
        header = self._read(0, 0, 20) or bytes(20)
        named = int.from_bytes(header[16:18], "big")
        named = 65536 if named == 1 else named
        sizes = [*([named] if is_page_size(named) else []), PAGE_BYTES, EARLIER_PAGE_BYTES]
        found = Counter({size: sum(frame.sound for frame in read_log(log, size).frames) for size in sizes})
        for start in range(0, self._database_bytes, _PIECE_BYTES):
            if max(found.values()) >= _ENOUGH:
                break
            for size in found:
                found[size] += self._count_rows(start, size)
        # Of equals the first.
        return max(found, key=found.__getitem__)

    def _count_rows(self, start: int, page_bytes: int) -> int:
        """How many sound rows a piece of the database has, if its pages have this size."""
        fetch = partial(self._stored, page_bytes)
        first = start // page_bytes + 1
        pages = ((number, fetch(number)) for number in range(first, first + _PIECE_BYTES // page_bytes))
        rows = (row for number, page in pages if page is not None for row in rows_on(page, number, fetch))
        return sum(found_in(columns, self.payloads) is not None for _, columns in rows)

    def _stored(self, page_bytes: int, number: int) -> bytes | None:
        """A page as the database has it."""
        return self._read(0, (number - 1) * page_bytes, page_bytes)

    def _read(self, which: int, at: int, size: int) -> bytes | None:
        file = self._files[which]
        if file is None or at < 0:
            return None
        page = os.pread(file, size, at)
        return page if len(page) == size else None


class _Finds:
    """Collects the rows that are sound, each once."""

    def __init__(self, into: sqlite3.Connection, payloads: Payloads) -> None:
        self.into = into
        self.payloads = payloads
        self.data = 0
        self.losses = 0
        self.numbers: dict[bytes, int] = {}
        """From the table `meta`: the first value seen for each name is the latest."""
        self.last: dict[tuple[int, int], int] = {}
        """(origin, epoch) -> highest sequence number seen."""

    def take(self, rowid: int, columns: tuple[Any, ...]) -> None:
        found = found_in(columns, self.payloads)
        if isinstance(found, Datum):
            self._put(rowid, found)
        elif isinstance(found, FoundLoss):
            self.losses += self.into.execute(INSERT_LOSS, loss_row(*found)).rowcount
        elif found is not None:
            self.numbers.setdefault(*found)

    def _put(self, rowid: int, datum: Datum) -> None:
        origin, epoch, sequence = datum.id
        self.last[origin, epoch] = max(sequence, self.last.get((origin, epoch), 0))
        row = datum_row(datum)
        found = self.into.execute(
            "SELECT crc FROM datum WHERE origin = ? AND epoch = ? AND sequence = ?", datum.id
        ).fetchall()
        if not found:
            taken = self.into.execute("SELECT 1 FROM datum WHERE arrival = ?", (rowid,)).fetchall()
            self.into.execute(_INSERT_AS_IT_CAME, (None if taken or rowid < 1 else rowid, *row))
            self.data += 1
        elif found[0][0] != datum.crc:
            self.data += self.into.execute(INSERT_APART, row).rowcount


def salvage(path: Path, mark: Mark | None, node_id: int, into: sqlite3.Connection) -> Salvaged:
    """Salvage what the damaged store at `path` holds. `into`: a new store, in a transaction. All payloads go into its
    rows. `OSError`."""
    source = _Remains(path)
    try:
        finds = _Finds(into, source.payloads)
        first = source.fetch(1)
        free = None if first is None else free_pages(first, source.fetch)
        for number, page in source.newest():
            if free is None or number not in free:
                for rowid, columns in rows_on(page, number, source.fetch):
                    finds.take(rowid, columns)
        live = finds.data + finds.losses
        written = finds.numbers.get(WRITTEN.encode())
        if mark is not None and finds.numbers.get(LIFE.encode(), mark.life) != mark.life:
            mark = None
        if mark is not None and written is not None and source.log.intact and written >= mark.written:
            held = mark.rows + written - mark.written
            lost = held if free is None else held - live
        elif mark is not None and mark.exact:
            lost = mark.rows
        else:
            lost = source.size // MIN_ROW_BYTES - live
        return Salvaged(finds.data, _epochs(finds, mark, node_id), max(lost, 0), _noted(finds.numbers))
    finally:
        source.close()


def salvage_log(path: Path) -> tuple[list[Datum], int]:
    """The data in the part of the log that SQLite no longer uses, and how many rows it can have had at most.
    `OSError`."""
    source = _Remains(path)
    try:
        data = {}
        log = source.log
        unused = log.frames[log.committed :]
        for frame in unused:
            page = source.state(frame)
            for _, columns in () if page is None else rows_on(page, frame.page, source.fetch):
                if isinstance(datum := found_in(columns, source.payloads), Datum):
                    data[datum.id, datum.crc] = datum
        rows = 0 if log.intact else max(len(unused), 1) * source.page_bytes // MIN_ROW_BYTES
        return list(data.values()), rows
    finally:
        source.close()


def _epochs(finds: _Finds, mark: Mark | None, node_id: int) -> dict[int, int]:
    epochs: dict[int, int] = {}
    numbers = finds.numbers
    if (epoch := numbers.get(EPOCH.encode())) is not None and 0 <= epoch < 1 << 32:
        epochs[epoch] = numbers.get(NEXT_SEQUENCE.encode(), 0)
    if mark is not None:
        epochs[mark.epoch] = max(mark.given, epochs.get(mark.epoch, 0))
    own = [(epoch, last + 1) for (origin, epoch), last in finds.last.items() if origin == node_id]
    if not epochs and own:
        epochs[max(own)[0]] = 0
    for epoch, given in own:
        if epoch in epochs:
            epochs[epoch] = max(given, epochs[epoch])
    return epochs


def _noted(numbers: dict[bytes, int]) -> dict[str, int]:
    names = {name.decode("ascii", "replace"): value for name, value in numbers.items()}
    return {name: value for name, value in names.items() if not name.startswith(OWN_PREFIX)}


def _opened(path: Path) -> int | None:
    try:
        return os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return None
