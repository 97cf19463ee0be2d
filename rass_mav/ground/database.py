"""The data of a mission in a database, to which several bases write. Read like a node's store."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from math import isfinite
from pathlib import Path
from typing import Any

import psycopg

from rass_mav.app.payloads import parse_name
from rass_mav.core.datum import PARTS, Datum, DatumId, Fate
from rass_mav.core.store import StoredInfo
from rass_mav.errors import ConfigError, StoreError

from .archive import HEAD_BYTES, content
from .entry import Data, Entry, Opens
from .tables import check_version, connect, explained, shown, split_url

#: Rows that are fetched at a time.
_ROWS = 500
_COLUMNS = (
    "d.number, d.origin, d.epoch, d.sequence, d.crc, d.kind, octet_length(d.payload), d.hops, d.utc, d.error_s, "
    "d.at_least, d.age_s, d.apart, (SELECT min(a.utc) FROM rass.arrival a WHERE a.datum = d.number), "
    f"substr(d.payload, 1, {HEAD_BYTES})"
)
_FATES = {fate.value: fate for fate in Fate}


class Database(Data):
    """The data of one mission. Changes nothing.

    What is read is of one moment, that of the first read since `renew`, however the database changes meanwhile.
    """

    def __init__(self, url: str, now: Callable[[], float] = time.time, *, opens: Opens | None = None) -> None:
        """`url`: as libpq takes it; `mission=NAME` among its options chooses one, where there are several. `now`: the
        date, seconds since 1970. `opens`: opens sealed data; None: they stay sealed. Raises `ConfigError`,
        `StoreError`."""
        plain, mission = split_url(url)
        super().__init__(now, opens)
        self._url = url
        self._cursors = count()
        with explained(self._url):
            self._connection = connect(plain)
        try:
            with explained(self._url):
                check_version(self._connection)
                self._connection.read_only = True
                self._connection.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
                self._connection.autocommit = False
                self._mission = self._chosen(mission)
        except BaseException:
            self._connection.close()
            raise
        self.path = Path(self._mission.replace("/", "_"))
        """A name for files."""
        self.title = self._mission

    def _chosen(self, mission: str | None) -> str:
        rows = self._connection.execute("SELECT DISTINCT mission FROM rass.progress ORDER BY mission").fetchall()
        found = [row[0] for row in rows]
        if mission in found or (mission is None and len(found) == 1):
            return mission or str(found[0])
        if not found:
            raise StoreError(f"{shown(self._url)}: no base has written to it yet")
        raise ConfigError(
            f"{shown(self._url)}: expected ?mission= and one of {', '.join(found)} behind the database's name"
        )

    def renew(self) -> None:
        """Read from now on what is there now."""
        with explained(self._url):
            self._connection.rollback()

    def rest(self) -> None:
        """Read nothing until `renew`."""
        self.renew()

    @property
    def lineage(self) -> tuple[int, int]:
        """The number of the table: another one if it was created again, for example from a backup."""
        with explained(self._url):
            row = self._connection.execute("SELECT 'rass.datum'::regclass::oid").fetchone()
        assert row is not None
        return int(row[0]), 0

    def count(self, *, after: int = -1) -> int:
        """How many data `entries` reads. `after`: only data that came later, without second contents."""
        with explained(self._url):
            row = self._connection.execute(
                "SELECT count(*) FROM rass.datum WHERE mission = %s AND number > %s AND (%s < 0 OR NOT apart)",
                (self._mission, after, after),
            ).fetchone()
        assert row is not None
        return int(row[0])

    def arrivals(self, after: int, *, apart: bool = False, parts: bool | None = None) -> Iterator[Entry]:
        """What came later than this `Entry.arrival`, which is here the number of its row."""
        # A cursor of the server: the memory needed here does not depend on the number of data.
        with explained(self._url), self._connection.cursor(f"entries{next(self._cursors)}") as cursor:
            cursor.itersize = _ROWS
            cursor.execute(
                f"SELECT {_COLUMNS} FROM rass.datum d "
                "WHERE d.mission = %s AND d.number > %s AND d.apart = %s "
                "AND (%s::boolean IS NULL OR (d.kind & 63 = ANY(%s)) = %s) ORDER BY d.number",
                (self._mission, after, apart, parts, list(map(int, PARTS)), parts),
            )
            for row in cursor:
                yield self._entry(row)

    def _entry(self, row: tuple[Any, ...]) -> Entry:
        number, origin, epoch, sequence, crc, kind, size, hops, utc, error_s, at_least, age_s, apart, arrived, head = (
            row
        )
        # What can be written there by others than our bases need not be a time.
        utc, error_s = (utc, _finite(error_s)) if isfinite(utc) else (0.0, None)
        age_s, arrived = _finite(age_s) or 0.0, _finite(arrived)
        info = StoredInfo(DatumId(origin, epoch, sequence), kind, utc, hops, crc, size, at_least)
        entry = Entry(
            number, info.id, crc, kind, size, hops, utc, error_s, at_least, age_s, arrived=arrived, apart=apart
        )  # fmt: skip
        # Where the date was not known, nobody knows how old it is now.
        age_s = max(0.0, self._now() - utc) if entry.dated else age_s
        known = content(info, bytes(head), lambda: self._stored(number), self._opens)
        return entry._replace(age_s=age_s, **known)

    def _stored(self, number: int) -> bytes:
        row = self._connection.execute("SELECT payload FROM rass.datum WHERE number = %s", (number,)).fetchone()
        return b"" if row is None else bytes(row[0])

    def datum(self, name: str) -> Datum:
        """A datum by its name, as it is stored. Raises `DatumError`: not a name; `StoreError`: there is none."""
        *id, kind, utc, hops, crc, payload, at_least = self._row(
            name, "d.origin, d.epoch, d.sequence, d.kind, d.utc, d.hops, d.crc, d.payload, d.at_least"
        )
        datum = Datum(DatumId(*id), kind, utc, hops, crc, bytes(payload), at_least)
        if not datum.intact:
            raise StoreError(f"{name}: corrupt, its checksum does not match")
        return datum

    def entry(self, name: str) -> Entry:
        """The same as an entry."""
        return self._entry(self._row(name, _COLUMNS))

    def _row(self, name: str, columns: str) -> tuple[Any, ...]:
        id, crc = parse_name(name)
        with explained(self._url):
            row = self._connection.execute(
                f"SELECT {columns} FROM rass.datum d WHERE d.mission = %s AND d.origin = %s AND d.epoch = %s "
                "AND d.sequence = %s AND CASE WHEN %s::bigint IS NULL THEN NOT d.apart ELSE d.crc = %s END",
                (self._mission, *id, crc, crc),
            ).fetchone()
        if row is None:
            raise StoreError(f"{name}: not in {shown(self._url)}")
        return row

    def losses(self) -> list[tuple[DatumId, Fate]]:
        """What some base knows to be lost."""
        with explained(self._url):
            rows = self._connection.execute(
                "SELECT origin, epoch, sequence, fate FROM rass.loss WHERE mission = %s "
                "ORDER BY origin, epoch, sequence",
                (self._mission,),
            ).fetchall()
        return [(DatumId(*row[:3]), _FATES[row[3]]) for row in rows if row[3] in _FATES]

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def _finite(seconds: float | None) -> float | None:
    """A time; None: there is none."""
    return seconds if seconds is not None and isfinite(seconds) else None
