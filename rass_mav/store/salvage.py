"""What a damaged store still holds: every datum and every loss whose checksum matches, wherever it is.

Every page is read as the log has it last. If the list of free pages is damaged, these are read too. So data that were
passed on long ago may come back: custody is at-least-once. docs/reference/store.md says what this saves beyond SQLite
alone.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

from rass_mav.core.datum import Datum

from .disk import HOST, BlockFile
from .files import LOG_ENDINGS, SCRATCH, beside
from .log import is_page_size, read_log
from .mark import Mark
from .pages import FoundLoss, FoundNumber, PageReader, found_in, free_pages
from .payloads import Payloads
from .schema import (
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


class _Residue:
    """The pages of a damaged store: their size, the latest state of each, the rows on them, and the large payloads
    beside them. A context manager."""

    def __init__(self, path: Path, scratch: Path) -> None:
        """`path`: of the database. `scratch`: of a file in which pages are read. `OSError` and the errors of SQLite."""
        with ExitStack() as files:
            log_path = beside(path, LOG_ENDINGS[0])
            self._database, self._log = [
                files.enter_context(closing(HOST.open_file(file, writable=False))) if file.exists() else None
                for file in (path, log_path)
            ]
            self.payloads = files.enter_context(closing(Payloads(path, HOST, writable=False)))
            database_bytes = 0 if self._database is None else self._database.size
            self.size = database_bytes + (0 if self._log is None else self._log.size)
            self.log = read_log(log_path)
            self.page_bytes = self.log.page_bytes or self._stated_page_bytes() or PAGE_BYTES
            frames = self.log.frames[: self.log.committed] if self.log.intact else self.log.frames
            self._newest = {frame.page: frame.at for frame in frames if frame.sound}
            self._last = max(database_bytes // self.page_bytes, *self._newest, 1, 1)
            self._reader = files.enter_context(PageReader(scratch, self.page_bytes, self._last))
            for number, page in self.newest():
                self._reader.put(number, page)
            self._files = files.pop_all()

    def fetch(self, number: int) -> bytes | None:
        """The latest state of a page; None: there is none."""
        at = self._newest.get(number)
        if at is not None:
            return self._read(self._log, at)
        return self._read(self._database, (number - 1) * self.page_bytes)

    def newest(self) -> Iterator[tuple[int, bytes]]:
        """The latest state of each page but the first, which has no rows of ours."""
        for number in range(2, self._last + 1):
            page = self.fetch(number)
            if page is not None:
                yield number, page

    def rows(self, page: bytes) -> Iterator[tuple[int, Datum | FoundLoss | FoundNumber]]:
        """The sound rows of a page, each with its number."""
        for columns in self._reader.rows(page):
            found = found_in(columns, self.payloads)
            if found is not None:
                yield columns[0], found

    def unused(self) -> Iterator[Datum]:
        """The data on pages in that part of the log that SQLite does not use."""
        for frame in self.log.frames[self.log.committed :]:
            page = self._read(self._log, frame.at)
            for _, found in () if page is None else self.rows(page):
                if isinstance(found, Datum):
                    yield found

    def __enter__(self) -> _Residue:
        return self

    def __exit__(self, *raised: object) -> None:
        self._files.close()

    def _stated_page_bytes(self) -> int | None:
        """What the head of the database says; None: it cannot be true."""
        size = 0 if self._database is None else int.from_bytes(self._database.read(16, 2), "big")
        return size if is_page_size(size) else None

    def _read(self, file: BlockFile | None, at: int) -> bytes | None:
        page = b"" if file is None or at < 0 else file.read(at, self.page_bytes)
        return page if len(page) == self.page_bytes else None


class _Finds:
    """Collects the rows that are sound, each once."""

    def __init__(self, into: sqlite3.Connection) -> None:
        self.into = into
        self.data = 0
        self.losses = 0
        self.numbers: dict[bytes, int] = {}
        """From the table `meta`: the first value seen for each name is the latest."""
        self.last: dict[tuple[int, int], int] = {}
        """(origin, epoch) -> highest sequence number seen."""

    def take(self, rowid: int, found: Datum | FoundLoss | FoundNumber) -> None:
        if isinstance(found, Datum):
            self._put(rowid, found)
        elif isinstance(found, FoundLoss):
            self.losses += self.into.execute(INSERT_LOSS, loss_row(*found)).rowcount
        else:
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


def salvage(path: Path, mark: Mark | None, node_id: int, into: sqlite3.Connection, scratch: Path) -> Salvaged:
    """Salvage what the damaged store at `path` holds. `into`: a new store, in a transaction. All payloads go into its
    rows. `scratch`: of a file that is needed meanwhile. `OSError` and the errors of SQLite."""
    with _Residue(path, scratch) as source:
        finds = _Finds(into)
        first = source.fetch(1)
        free = None if first is None else free_pages(first, source.fetch)
        for number, page in source.newest():
            if free is None or number not in free:
                for rowid, found in source.rows(page):
                    finds.take(rowid, found)
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


def salvage_log(path: Path) -> tuple[list[Datum], int]:
    """The data in the part of the log that SQLite no longer uses, and how many rows it can have had at most.
    `OSError` and the errors of SQLite."""
    with _Residue(path, beside(path, SCRATCH)) as source:
        data = {(datum.id, datum.crc): datum for datum in source.unused()}
        log = source.log
        if log.intact:
            return list(data.values()), 0
        unused = beside(path, LOG_ENDINGS[0]).stat().st_size
        if log.page_bytes is not None:
            unused = max(len(log.frames) - log.committed, 1) * log.page_bytes
        return list(data.values()), max(unused // MIN_ROW_BYTES, 1)


def _epochs(finds: _Finds, mark: Mark | None, node_id: int) -> dict[int, int]:
    epochs: dict[int, int] = {}
    numbers = finds.numbers
    if (epoch := numbers.get(EPOCH.encode())) is not None and 0 <= epoch < 1 << 32:
        epochs[epoch] = numbers.get(NEXT_SEQUENCE.encode(), 0)
    if mark is not None:
        epochs[mark.epoch] = max(mark.assigned, epochs.get(mark.epoch, 0))
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
