"""Reading a store from outside: for people, exports and tests, also while a node is using it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.store import StoredInfo

from . import schema
from .disk import HOST
from .drafts import connect
from .errors import Unsound, explained
from .files import LOG_ENDINGS, beside, checked_path
from .opening import check_version
from .payloads import Payloads
from .reading import connect_alone


class SqliteReader:
    """What was durable in a store at the moment of opening, however it changes meanwhile.

    Needs no lock, and changes no data. While it is open the node cannot shorten its write-ahead log, nor use the
    space of large payloads that it removes. So close it soon, or let it `rest`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """`StoreError`: there is no store at `path` that can be read; `StoreDamagedError`: there is a damaged
        one."""
        self._path = checked_path(path)
        with explained(self._path, "opening the store to read"):
            # A card that is mounted read-only, or another user's store.
            alone = not os.access(self._path.absolute().parent, os.W_OK)
            self._log = beside(self._path, LOG_ENDINGS[0])
            self._closed = not alone and not self._log.exists()
            """Whether no node used the store when it was opened. SQLite then creates the files of a log to read it."""
            self._payloads = Payloads(self._path, HOST, writable=False)
            try:
                self._connection = connect_alone(self._path) if alone else connect(self._path, "ro")
            except BaseException:
                self._payloads.close()
                raise
            self._source = schema.Source(self._connection, self._payloads)
            try:
                # Before the moment of which all is read.
                self._payloads.watch(True)
                self._connection.execute("BEGIN")
                # The first read fixes the moment for all other reads.
                if self._connection.execute("PRAGMA application_id").fetchall()[0][0] != schema.APPLICATION_ID:
                    raise Unsound("another program's database")
                check_version(self._connection, self._path)
                self._read_own()
                self._payloads.expect(self.life)
            except BaseException:
                self.close()
                raise

    def about_payloads(self) -> str:
        """The file of large payloads, and what is wrong with it as a whole, for people."""
        payloads = self._payloads
        what = "belongs to another store" if payloads.foreign else "is truncated" if payloads.size else "is missing"
        return f"{payloads.path} {what}"

    def renew(self) -> None:
        """Read from now on what is durable now."""
        with explained(self._path, "reading the store"):
            self.rest()
            self._payloads.watch(True)
            self._connection.execute("BEGIN")
            self._read_own()

    def _read_own(self) -> None:
        self._meta = schema.read_numbers(self._connection, "meta")
        own = schema.read_own(self._meta)
        self.life, self.epoch, self.assigned = own.life, own.epoch, own.assigned
        """32 bits each: the store's life and the epoch of its data; and the sequence number of its next own datum."""

    def rest(self) -> None:
        """Let the node shorten its log, and use the space of what it has removed, until `renew`."""
        if self._connection.in_transaction:
            self._connection.execute("ROLLBACK")
        self._payloads.watch(False)

    def meta(self) -> dict[str, int]:
        """The numbers that the node keeps, without the store's own."""
        return dict(self._meta)

    def ids(self) -> list[DatumId]:
        """The ids of what is stored, in the order of arrival."""
        return [info.id for info in self.held()]

    def held(self) -> Iterator[StoredInfo]:
        """What is stored, least recently stored first."""
        with explained(self._path, "listing the data"):
            yield from schema.read_infos(self._connection)

    def rows(
        self, head_bytes: int, *, after: int = -1, apart: bool = False, parts: bool | None = None
    ) -> Iterator[schema.Row | None]:
        """What is stored, in the order of arrival, from behind the arrival `after` on, with the first bytes of the
        payloads. None: a damaged row. `apart`: the second contents of ids instead. `parts`: only parts of files, or
        only other data; None: all."""
        with explained(self._path, "listing the data"):
            table = "apart" if apart else "datum"
            yield from schema.read_rows(self._source, table, head_bytes, after, parts)

    def count(self, after: int = -1) -> int:
        """How many rows of data are stored, damaged ones and second contents included. `after`: only what arrived
        later, and no second contents."""
        with explained(self._path, "counting the data"):
            if after >= 0:
                rows = self._connection.execute("SELECT count(*) FROM datum WHERE arrival > ?", (after,)).fetchall()
                return int(rows[0][0])
            tables = "SELECT (SELECT count(*) FROM datum) + (SELECT count(*) FROM apart)"
            return int(self._connection.execute(tables).fetchall()[0][0])

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        """One second content, or None."""
        with explained(self._path, "reading a datum"):
            return schema.read_datum(self._source, id, crc)

    def get(self, id: DatumId) -> Datum | None:
        """A datum as its bytes are (its checksum is not verified here), or None."""
        with explained(self._path, "reading a datum"):
            return schema.read_datum(self._source, id)

    def apart(self) -> list[Datum]:
        """Second contents of ids, in the order of arrival."""
        with explained(self._path, "reading a datum"):
            infos = list(schema.read_infos(self._connection, "apart"))
            data = [schema.read_datum(self._source, info.id, info.crc) for info in infos]
        return [datum for datum in data if datum is not None]

    def losses(self) -> list[tuple[DatumId, Fate]]:
        """The table of losses."""
        with explained(self._path, "reading the losses"):
            return [(id, loss.fate) for id, loss in schema.read_losses(self._connection).items()]

    def counters(self) -> dict[str, int]:
        """All named counters."""
        with explained(self._path, "reading the counters"):
            return schema.read_numbers(self._connection, "counter")

    def close(self) -> None:
        """Release the files."""
        self._connection.close()
        self._payloads.close()
        if self._closed:
            self._tidy()

    def _tidy(self) -> None:
        """Leave no files of an empty log behind.

        The last connection that may write removes them when it is closed. SQLite sees to it that this is the last one.
        """
        with suppress(OSError, sqlite3.Error):
            if self._log.stat().st_size == 0:
                with closing(connect(self._path, busy_timeout=0.0)) as connection:
                    connection.execute("PRAGMA application_id").fetchall()

    def __enter__(self) -> SqliteReader:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
