"""What a damaged store still holds: every datum and every loss whose checksum matches, wherever it is.

Pages in use come first, each as the log has it last. If rows are then missing, older states of pages and free pages are
searched too. So data that were passed on long ago may come back: custody is at-least-once.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId

from .disk import HOST
from .files import LOG_ENDINGS, beside
from .log import Log, LogFrame, read_log
from .mark import Mark
from .pages import free_pages, rows_on
from .payloads import Payloads
from .schema import (
    EPOCH,
    INSERT_APART,
    INSERT_LOSS,
    LIFE,
    NEXT_SEQUENCE,
    OWN_PREFIX,
    WRITTEN,
    datum_row,
    loss_row,
    sound_loss,
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


class _Source:
    """The pages of a damaged store."""

    def __init__(self, path: Path, log: Log) -> None:
        self._files = [_opened(path), _opened(beside(path, LOG_ENDINGS[0]))]
        self.log = log
        self.payloads = Payloads(path, HOST, writable=False)
        database, _ = self._files
        header = b"" if database is None else os.pread(database, 20, 0)
        named = int.from_bytes(header[16:18], "big")
        named = 65536 if named == 1 else named
        # An invalid page size is damaged itself.
        self.page_bytes = log.page_bytes or (named if named in [1 << bits for bits in range(9, 17)] else 4096)
        self.size = sum(os.fstat(file).st_size for file in self._files if file is not None)
        self.pages = 0 if database is None else os.fstat(database).st_size // self.page_bytes
        frames = log.frames[: log.committed] if log.intact else log.frames
        self._newest = {frame.page: frame.at for frame in frames if frame.sound}

    def fetch(self, number: int) -> bytes | None:
        """The latest state of a page; None: there is none."""
        at = self._newest.get(number)
        return self._read(0, (number - 1) * self.page_bytes) if at is None else self._read(1, at)

    def state(self, frame: LogFrame) -> bytes | None:
        """A page as a frame of the log contains it."""
        return self._read(1, frame.at)

    def newest(self) -> Iterator[tuple[int, bytes]]:
        """The latest state of each page."""
        for number in sorted(self._newest.keys() | set(range(1, self.pages + 1))):
            page = self.fetch(number)
            if page is not None:
                yield number, page

    def all(self) -> Iterator[tuple[int, bytes]]:
        """Every existing state of every page, the broken frames of the log too, the latest first."""
        for frame in reversed(self.log.frames):
            page = self.state(frame)
            if page is not None:
                yield frame.page, page
        for number in range(1, self.pages + 1):
            page = self._read(0, (number - 1) * self.page_bytes)
            if page is not None:
                yield number, page

    def _read(self, which: int, at: int) -> bytes | None:
        file = self._files[which]
        if file is None or at < 0:
            return None
        page = os.pread(file, self.page_bytes, at)
        return page if len(page) == self.page_bytes else None

    def close(self) -> None:
        for file in self._files:
            if file is not None:
                os.close(file)
        self.payloads.close()


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
        if len(columns) in (10, 11) and (datum := as_datum(columns, self.payloads)) is not None:
            self._put(rowid, datum)
        elif len(columns) == 5 and (fate := sound_loss(columns[:3], columns[3], columns[4])) is not None:
            id = DatumId(*columns[:3])
            self.losses += self.into.execute(INSERT_LOSS, loss_row(id, fate)).rowcount
        elif len(columns) == 3:
            name, value, inverse = columns
            if type(name) is bytes and type(value) is int and inverse == ~value:
                self.numbers.setdefault(name, value)

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


def as_datum(columns: tuple[Any, ...], payloads: Payloads) -> Datum | None:
    """A row of data, as this version or an earlier one wrote it; None: it is not one, or its checksum does not
    match."""
    # The first version had no at_least.
    _, origin, epoch, sequence, kind, created, hops, crc, size, *at_least, payload = columns
    if type(payload) is int and type(size) is int:
        payload = payloads.read(payload, size)
    numbers = (origin, epoch, sequence, kind, hops, crc, size, *at_least)
    if any(type(number) is not int or number < 0 for number in numbers) or type(payload) is not bytes:
        return None
    # SQLite stores a real number without a fraction as an integer.
    if type(created) not in (float, int) or len(payload) != size:
        return None
    if (
        max(epoch, sequence, crc) >= 1 << 32
        or origin >= 1 << 16
        or max(kind, hops) > 255
        or max(at_least, default=0) > 1
    ):
        return None
    datum = Datum(DatumId(origin, epoch, sequence), kind, float(created), hops, crc, payload, bool(*at_least))
    return datum if datum.intact else None


def salvage(path: Path, mark: Mark | None, node_id: int, into: sqlite3.Connection) -> Salvaged:
    """Salvage what the damaged store at `path` holds. `into`: a new store, in a transaction. All payloads go into its
    rows. `OSError`."""
    log = read_log(beside(path, LOG_ENDINGS[0]))
    source = _Source(path, log)
    try:
        finds = _Finds(into, source.payloads)
        first = source.fetch(1)
        free = None if first is None else free_pages(first, source.fetch)
        for number, page in source.newest():
            if free is None or number not in free:
                for rowid, columns in rows_on(page, number, source.fetch):
                    finds.take(rowid, columns)
        # Known to be the latest state; older rows cannot be distinguished from rows that are missing otherwise.
        live = finds.data + finds.losses
        written = finds.numbers.get(WRITTEN.encode())
        if mark is not None and finds.numbers.get(LIFE.encode(), mark.life) != mark.life:
            mark = None
        if mark is not None and written is not None and log.intact and written >= mark.written:
            held = mark.rows + written - mark.written
            lost = held if free is None else held - live
        elif mark is not None and mark.exact:
            lost = mark.rows
        else:
            lost = source.size // MIN_ROW_BYTES - live
        if lost > 0:
            for number, page in source.all():
                for rowid, columns in rows_on(page, number, source.fetch):
                    finds.take(rowid, columns)
        return Salvaged(finds.data, _epochs(finds, mark, node_id), max(lost, 0), _noted(finds.numbers))
    finally:
        source.close()


def salvage_log(path: Path) -> list[Datum]:
    """The data in the part of the log that SQLite no longer uses. `OSError`."""
    log = read_log(beside(path, LOG_ENDINGS[0]))
    source = _Source(path, log)
    try:
        data = {}
        for frame in log.frames[log.committed :]:
            page = source.state(frame)
            for _, columns in () if page is None else rows_on(page, frame.page, source.fetch):
                if len(columns) in (10, 11) and (datum := as_datum(columns, source.payloads)) is not None:
                    data[datum.id, datum.crc] = datum
        return list(data.values())
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
