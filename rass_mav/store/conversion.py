"""Conversion of stores of earlier versions.

Schema 1 had no life, no `at_least`, and no second contents: such a store is copied. Schema 2 had all payloads in their
rows, which this version allows too: only the statements that describe its tables change.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from rass_mav.core.datum import DatumId, Fate

from .drafts import connect, drafted, draw
from .repairs import close_epochs
from .report import OpenReport
from .schema import (
    LAST_TABLES,
    SCHEMA_VERSION,
    TABLES,
    OwnNumbers,
    count_rows,
    loss_row,
    read_numbers,
    write_numbers,
    write_own,
)  # fmt: skip

_COPY = (
    "INSERT INTO datum (arrival, origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, 0, ?)"
)
_FATES = {fate.value: fate for fate in Fate}


def upgrade(connection: sqlite3.Connection) -> None:
    """Make a sound store of the last version one of this version, in one transaction."""
    # sqlite.org/lang_altertable.html, section 7: how to change a CHECK constraint.
    connection.execute("BEGIN IMMEDIATE")
    try:
        connection.execute("PRAGMA writable_schema = ON")
        for name, statement in TABLES.items():
            if statement != LAST_TABLES[name]:
                connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", (statement, name))
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        cookie = connection.execute("PRAGMA schema_version").fetchall()[0][0]
        connection.execute(f"PRAGMA schema_version = {cookie + 1}")
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        # It reads the new statements.
        connection.execute("PRAGMA writable_schema = RESET")


def convert(path: Path, aside: Path, draw_epoch: Callable[[], int], node_id: int, vfs: str | None) -> OpenReport:
    """Convert the store at `path` to this version; the old one is moved to `aside`, unchanged.

    Its life is its former epoch. It kept no mark, so its last numbers may be missing: the epoch is a new one.
    `StoreError` and the errors of SQLite; then nothing has changed.
    """
    with closing(connect(path, "ro", vfs=vfs)) as old:
        old.execute("BEGIN")
        meta = read_numbers(old, "meta")
        life, given = meta.pop("store.epoch"), meta.pop("store.next_sequence")
        epoch = draw(draw_epoch, life)
        with drafted(path, life, epoch, vfs, aside) as new:
            new.executemany(_COPY, old.execute("SELECT * FROM datum ORDER BY arrival"))
            rows = old.execute("SELECT origin, epoch, sequence, fate FROM loss").fetchall()
            for *id, fate in rows:
                new.execute(
                    "INSERT INTO loss (origin, epoch, sequence, fate, crc) VALUES (?, ?, ?, ?, ?)",
                    loss_row(DatumId(*id), _FATES[fate]),
                )
            write_numbers(new, "counter", read_numbers(old, "counter"))
            write_numbers(new, "meta", meta)
            own = close_epochs(new, OwnNumbers(life, epoch, 0, 0, 0), node_id, {life: given}, 0)
            write_own(new, own._replace(written=count_rows(new)))
    return OpenReport(converted=aside, closed=((life, given),), reason="created by the first version")


def check_old(connection: sqlite3.Connection) -> str:
    """What is wrong with the rows of a store of the first version; empty: nothing."""
    bad = connection.execute(
        "SELECT arrival FROM datum WHERE (typeof(origin) = 'integer' AND typeof(epoch) = 'integer' "
        "AND typeof(sequence) = 'integer' AND typeof(kind) = 'integer' AND typeof(created) = 'real' "
        "AND typeof(hops) = 'integer' AND typeof(crc) = 'integer' AND typeof(payload) = 'blob' "
        "AND length(payload) = size) IS NOT 1 LIMIT 1"
    ).fetchall()
    if bad:
        return f"row {bad[0][0]} of table datum has values of a wrong type"
    numbers = read_numbers(connection, "meta")
    read_numbers(connection, "counter")
    if not 0 <= numbers.get("store.epoch", -1) < 1 << 32 or not 0 <= numbers.get("store.next_sequence", -1) <= 1 << 32:
        return "a number of the store's own in table meta is missing, or out of range"
    fates = {row[0] for row in connection.execute("SELECT fate FROM loss").fetchall()}
    if not fates <= _FATES.keys():
        return "table loss has an invalid fate"
    return ""
