"""Writes what has arrived at a base into a database that several bases share."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from threading import Event
from typing import Any

import psycopg

from rass_mav.app.outlets import PostgresSection
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry, Opens, iso
from rass_mav.ground.feed import LOOK_S, Cursor, Feed, Look
from rass_mav.ground.tables import WRITERS_LOCK, connect, explained, prepare

from .task import AGAIN_S, Task

Connection = psycopg.Connection[tuple[Any, ...]]

#: What is written in one transaction: data, and bytes of contents and one datum more.
MOST_ENTRIES = 256
MOST_BYTES = 1 << 22
#: Seconds between two looks at the table of losses.
LOSSES_S = 5.0
#: When the node stops, what has arrived until then is written for at most so many seconds more.
LAST_S = 5.0

_DATUM = """
    INSERT INTO rass.datum (
        mission, origin, epoch, sequence, crc, apart, kind, hops, utc, created, error_s, at_least, age_s,
        place, altitude, reading, unit, risk, payload
    ) SELECT
        %(mission)s, %(origin)s, %(epoch)s, %(sequence)s, %(crc)s,
        EXISTS (
            SELECT FROM rass.datum WHERE mission = %(mission)s AND origin = %(origin)s AND epoch = %(epoch)s
            AND sequence = %(sequence)s
        ),
        %(kind)s, %(hops)s, %(utc)s, %(created)s::timestamptz, %(error_s)s, %(at_least)s, %(age_s)s,
        ST_SetSRID(ST_MakePoint(%(longitude)s::double precision, %(latitude)s::double precision), 4326)::geography,
        %(altitude)s, %(reading)s, %(unit)s, %(risk)s, %(payload)s
    ON CONFLICT DO NOTHING
"""
_ARRIVAL = """
    INSERT INTO rass.arrival (datum, base, utc, arrived)
    SELECT number, %(base)s, %(arrived)s, %(arrived_at)s::timestamptz FROM rass.datum
    WHERE mission = %(mission)s AND origin = %(origin)s AND epoch = %(epoch)s AND sequence = %(sequence)s
    AND crc = %(crc)s
    ON CONFLICT DO NOTHING
"""
_LOSS = "INSERT INTO rass.loss VALUES (%s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"
_PROGRESS = """
    INSERT INTO rass.progress VALUES (%s, %s, %s, %s, %s, %s) ON CONFLICT (mission, base)
    DO UPDATE SET (life, epoch, arrival, apart) = (excluded.life, excluded.epoch, excluded.arrival, excluded.apart)
"""


class DatabaseWriter(Task):
    """The base's store is the outbox.

    How far it is written is kept in the database, in the same transaction as the data. So nothing is lost or written
    twice, whatever fails at whatever moment, and a database that is restored from a backup gets again what it lacks.
    """

    name = "postgres"
    last_s = 2 * LAST_S

    def __init__(self, section: PostgresSection, store: Path, base: int, opens: Opens | None = None) -> None:
        """`base`: the node's id. `opens`: opens sealed data; None: they stay sealed."""
        super().__init__()
        self._section = section
        # A damaged store is repaired by its node.
        self._feed = Feed(lambda: Archive(store, salvage=False, opens=opens))
        self._base = base
        self._cursor: Cursor | None = None
        """As the database has it; None: it has none, or was not asked yet."""
        self._written = self._behind = 0
        self._losses: set[tuple[DatumId, Fate]] = set()
        self._losses_due = 0.0
        self._connected = False

    def report(self) -> dict[str, Any]:
        """For `status`, since the process was started."""
        return {
            "connected": self._connected,
            "posted": self._written,
            "behind": self._behind,
            "trouble": self.trouble or None,
        }

    def wait(self, stopping: Event, wait_s: float) -> None:
        """Meanwhile the number of data that wait stays up to date."""
        until = time.monotonic() + wait_s
        while not stopping.is_set() and (left_s := until - time.monotonic()) > 0:
            with contextlib.suppress(StoreError), self._feed.look(self._cursor) as look:
                self._behind = look.behind(look.start)
            stopping.wait(min(left_s, AGAIN_S))

    def work(self, stopping: Event) -> None:
        """Until the event is set, and a little longer if there is something left to write. Raises `StoreError`: the
        database cannot be used."""
        try:
            with explained(self._section.dsn), connect(self._section.dsn) as connection:
                prepare(connection)
                self._connected = True
                self.works()
                self._losses, self._losses_due = set(), 0.0
                self._cursor = self._progress(connection)
                self._write_all(connection, stopping)
        finally:
            self._connected = False

    def _write_all(self, connection: Connection, stopping: Event) -> None:
        last = None
        while last is None or time.monotonic() < last:
            ends = stopping.is_set()
            found, losses = None, set[tuple[DatumId, Fate]]()
            try:
                with self._feed.look(self._cursor) as look:
                    found = self._read(look)
                    if found is None and (ends or time.monotonic() >= self._losses_due):
                        losses = set(look.data.losses()) - self._losses
                        self._losses_due = time.monotonic() + LOSSES_S
                self.works()
            except StoreError as error:
                # The node itself finds out, and repairs it.
                self.complain(str(error))
            if losses:
                self._write_losses(connection, losses)
            if found is not None:
                self._write(connection, *found)
            elif ends:
                return
            else:
                stopping.wait(LOOK_S)
            if last is None and stopping.is_set():
                last = time.monotonic() + LAST_S

    def _progress(self, connection: Connection) -> Cursor | None:
        row = connection.execute(
            "SELECT life, epoch, arrival, apart FROM rass.progress WHERE mission = %s AND base = %s",
            (self._section.mission, self._base),
        ).fetchone()
        return None if row is None else Cursor(*row)

    def _read(self, look: Look) -> tuple[list[dict[str, Any]], Cursor, int] | None:
        """The next data as rows, the cursor behind them, and how many data are behind that; None: there are none.

        Without those whose copy is damaged: a sound one arrives as a new datum. Raises `StoreError`.
        """
        rows: list[dict[str, Any]] = []
        end, size = look.start, 0
        for entry, cursor in look.arrivals():
            if len(rows) == MOST_ENTRIES or size >= MOST_BYTES:
                break
            end = cursor
            try:
                rows.append(self._row(entry, look.data.datum(entry.name)))
            except StoreDamagedError:
                raise
            except StoreError:
                continue
            size += entry.size
        return None if end == self._cursor else (rows, end, look.behind(end))

    def _write(self, connection: Connection, rows: list[dict[str, Any]], end: Cursor, behind: int) -> None:
        with connection.transaction(), connection.cursor() as cursor:
            cursor.execute("SELECT pg_advisory_xact_lock(%s)", (WRITERS_LOCK,))
            cursor.executemany(_DATUM, rows)
            cursor.executemany(_ARRIVAL, rows)
            cursor.execute(_PROGRESS, (self._section.mission, self._base, *end))
        self._written += len(rows)
        self._cursor, self._behind = end, behind

    def _write_losses(self, connection: Connection, new: set[tuple[DatumId, Fate]]) -> None:
        with connection.transaction(), connection.cursor() as cursor:
            # In one order everywhere: two bases that write the same losses do not wait for each other in a circle.
            cursor.executemany(_LOSS, [(self._section.mission, *id, fate.value) for id, fate in sorted(new)])
        self._losses |= new

    def _row(self, entry: Entry, datum: Datum) -> dict[str, Any]:
        """The columns of a datum."""
        m = entry.measurement
        latitude, longitude = entry.place or (None, None)
        return {
            "mission": self._section.mission, "base": self._base,
            "origin": entry.id.origin, "epoch": entry.id.epoch, "sequence": entry.id.sequence, "crc": entry.crc,
            "kind": datum.kind, "hops": entry.hops,
            "utc": entry.utc, "created": iso(entry.utc) if entry.dated else None,
            "error_s": entry.error_s, "at_least": entry.at_least, "age_s": entry.age_s,
            "arrived": entry.arrived, "arrived_at": iso(entry.arrived) if entry.arrived and entry.dated else None,
            "latitude": latitude, "longitude": longitude,
            "altitude": entry.altitude, "reading": entry.reading,
            "unit": None if m is None else m.unit, "risk": None if m is None else m.risk,
            "payload": datum.payload,
        }  # fmt: skip
