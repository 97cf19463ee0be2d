"""The rows on single pages of a damaged database, read by SQLite.

SQLite finds rows through the pages above them, so that one page that is beyond repair takes many others with it. Here
each page becomes the only page of a table in a database of its own. What is read may be anything: only its checksum
makes it a row, which `found_in` checks.
"""

from __future__ import annotations

import math
import os
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate

from .drafts import connect
from .payloads import Payloads
from .schema import sound_loss

# The kinds of pages, in their first byte (sqlite.org/fileformat2.html, section 1.6).
_TABLE_LEAF = 0x0D
_INDEX_LEAF = 0x0A
_INDEX_INTERIOR = 0x02
#: `datum` and `apart` are read as the one table, `loss`, `meta` and `counter` as the other.
_TABLES = (
    "CREATE TABLE datum (arrival INTEGER PRIMARY KEY, origin, epoch, sequence, kind, created, hops, crc, size, "
    "at_least, payload)",
    "CREATE TABLE entry (a, b, c, d, e, PRIMARY KEY (a, b, c)) WITHOUT ROWID",
)
_DATA = ("SELECT * FROM datum", "SELECT * FROM datum ORDER BY arrival DESC")
_ENTRIES = ("SELECT * FROM entry", "SELECT * FROM entry ORDER BY a DESC, b DESC, c DESC")
#: Where a database counts its changes: with a new number SQLite reads its pages again. With one that it has not written
#: itself it also ignores how many pages the database says it has.
_CHANGES_AT = 24
_FIRST_CHANGE = 1 << 16


class FoundLoss(NamedTuple):
    """A row of the table of losses."""

    id: DatumId
    fate: Fate
    proof: bytes


class FoundNumber(NamedTuple):
    """A row of `meta` or `counter`."""

    name: bytes
    value: int


class PageReader:
    """Reads pages of a database that has `last` pages of `page_bytes`. A context manager."""

    def __init__(self, path: Path, page_bytes: int, last: int) -> None:
        """`path`: of a file for it, which is deleted at the end. `OSError` and the errors of SQLite."""
        self._path = path
        self._page_bytes = page_bytes
        self._last = last
        self._changes = _FIRST_CHANGE
        path.unlink(missing_ok=True)
        with closing(connect(path, "rwc")) as connection:
            connection.execute("PRAGMA journal_mode = MEMORY").fetchall()
            connection.execute("PRAGMA synchronous = OFF")
            connection.execute(f"PRAGMA page_size = {page_bytes}")
            for statement in _TABLES:
                connection.execute(statement)
            # Behind all the pages that a row can continue on.
            connection.execute("PRAGMA writable_schema = ON")
            connection.execute("UPDATE sqlite_master SET rootpage = rootpage + ?", (last - 1,))
        self._file = os.open(path, os.O_RDWR)
        os.truncate(self._file, (last + 2) * page_bytes)
        self._connection = connect(path, "ro")
        self._connection.text_factory = bytes

    def put(self, number: int, page: bytes) -> None:
        """A page of the database, to be there if a row of another page continues on it."""
        # It begins with the number of the next page, which is smaller than 1 << 24.
        if not page[0] and 1 < number <= self._last:
            os.pwrite(self._file, page, (number - 1) * self._page_bytes)

    def rows(self, page: bytes) -> list[tuple[Any, ...]]:
        """The rows of one page, texts as bytes, as far as they can be read: eleven columns of data, or five of
        others."""
        if page[0] == _INDEX_INTERIOR:
            page = _as_leaf(page)
        number, statements = {_TABLE_LEAF: (1, _DATA), _INDEX_LEAF: (2, _ENTRIES)}.get(page[0], (0, ()))
        if number:
            os.pwrite(self._file, page, (self._last + number - 1) * self._page_bytes)
            self._changes += 1
            os.pwrite(self._file, self._changes.to_bytes(4, "big"), _CHANGES_AT)
        rows: list[tuple[Any, ...]] = []
        for statement in statements:
            # Up to the first row that cannot be read; then the others, from the end.
            try:
                for row in self._connection.execute(statement):
                    rows.append(row)
                break
            except sqlite3.DatabaseError:
                continue
        return rows

    def __enter__(self) -> PageReader:
        return self

    def __exit__(self, *raised: object) -> None:
        self._connection.close()
        os.close(self._file)
        self._path.unlink()


def _as_leaf(page: bytes) -> bytes:
    """An inner page of an index without the pages below it: its own rows are in it too."""
    count = min(int.from_bytes(page[3:5], "big"), (len(page) - 12) // 2)
    # A row is behind the number of a page.
    pointers = [min(pointer + 4, 0xFFFF) for pointer in struct.unpack_from(f">{count}H", page, 12)]
    head = bytes([_INDEX_LEAF]) + page[1:8] + struct.pack(f">{count}H", *pointers)
    return head + page[len(head) :]


def free_pages(first: bytes, fetch: Callable[[int], bytes | None]) -> set[int] | None:
    """The numbers of the unused pages; None: they cannot be determined. `first`: page 1."""
    trunk, count = struct.unpack_from(">II", first, 32)
    free: set[int] = set()
    while trunk:
        page = fetch(trunk)
        if page is None or trunk in free:
            return None
        free.add(trunk)
        following, leaves = struct.unpack_from(">II", page, 0)
        if leaves > len(page) // 4 - 2:
            return None
        free.update(struct.unpack_from(f">{leaves}I", page, 8))
        trunk = following
    return free if len(free) == count else None


def found_in(columns: tuple[Any, ...], payloads: Payloads) -> Datum | FoundLoss | FoundNumber | None:
    """What a row says; None: it is not ours, or not sound. `OSError`."""
    if len(columns) == 11:
        return _datum(columns, payloads)
    if (loss := sound_loss(columns[:3], columns[3], columns[4])) is not None:
        return FoundLoss(DatumId(*columns[:3]), *loss)
    name, value, inverse = columns[:3]
    if type(name) is bytes and type(value) is int and inverse == ~value:
        return FoundNumber(name, value)
    return None


def _datum(columns: tuple[Any, ...], payloads: Payloads) -> Datum | None:
    _, origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload = columns
    if type(payload) is int and type(size) is int:
        payload = payloads.read(payload, size)
    numbers = (origin, epoch, sequence, kind, hops, crc, size, at_least)
    if any(type(number) is not int or number < 0 for number in numbers) or type(payload) is not bytes:
        return None
    # SQLite stores a real number without a fraction as an integer, and has NULL for what is no number.
    if type(created) not in (float, int) or math.isnan(created) or len(payload) != size:
        return None
    if max(epoch, sequence, crc) >= 1 << 32 or origin >= 1 << 16 or max(kind, hops) > 255 or at_least > 1:
        return None
    datum = Datum(DatumId(origin, epoch, sequence), kind, float(created), hops, crc, payload, bool(at_least))
    return datum if datum.intact else None
