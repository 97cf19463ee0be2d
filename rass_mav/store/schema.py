"""The tables of a store on disk, and how their rows are read.

Radiation flips bits on the way to the disk and back. SQLite notices a broken structure, not a changed value. So the
payloads have their CRC, the numbers in `meta` and `counter` are stored with their bitwise complement (a sequence number
that fell back would be used twice), and every column of a row is checked for its type when it is read. What does not
fit raises `Unsound`, which `explained` turns into `StoreDamagedError`.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.store import StoredInfo

from .errors import Unsound

#: `PRAGMA application_id`: "RASS" in ASCII. Tells our files from other programs' databases.
APPLICATION_ID = 0x52415353
#: `PRAGMA user_version`: the version of the tables below.
SCHEMA_VERSION = 1

# Names in `meta` that belong to the store itself.
OWN_PREFIX = "store."
EPOCH = "store.epoch"
NEXT_SEQUENCE = "store.next_sequence"

_NUMBERS = "CREATE TABLE {} (name TEXT PRIMARY KEY, value INTEGER NOT NULL, inverse INTEGER NOT NULL) WITHOUT ROWID"

_SOUND_ROW = (
    "typeof(origin) = 'integer' AND typeof(epoch) = 'integer' AND typeof(sequence) = 'integer' "
    "AND typeof(kind) = 'integer' AND typeof(created) = 'real' AND typeof(hops) = 'integer' "
    "AND typeof(crc) = 'integer' AND typeof(payload) = 'blob' AND length(payload) = size"
)

#: Name -> the statement that makes the table; SQLite keeps the text as it is, so that it can be compared.
#: In `datum` the payload stands last, so that the rest can be read without the pages that it overflows into.
TABLES = {
    "meta": _NUMBERS.format("meta"),
    "counter": _NUMBERS.format("counter"),
    "datum": (
        "CREATE TABLE datum (arrival INTEGER PRIMARY KEY, origin INTEGER NOT NULL, epoch INTEGER NOT NULL, "
        "sequence INTEGER NOT NULL, kind INTEGER NOT NULL, created REAL NOT NULL, hops INTEGER NOT NULL, "
        "crc INTEGER NOT NULL, size INTEGER NOT NULL, payload BLOB NOT NULL, UNIQUE (origin, epoch, sequence), "
        f"CHECK ({_SOUND_ROW}))"
    ),
    "loss": (
        "CREATE TABLE loss (origin INTEGER NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, "
        "fate TEXT NOT NULL, PRIMARY KEY (origin, epoch, sequence)) WITHOUT ROWID"
    ),
}

INSERT_DATUM = (
    "INSERT OR REPLACE INTO datum (origin, epoch, sequence, kind, created, hops, crc, size, payload) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
)
DELETE_DATUM = "DELETE FROM datum WHERE origin = ? AND epoch = ? AND sequence = ?"
DELETE_LOSS = "DELETE FROM loss WHERE origin = ? AND epoch = ? AND sequence = ?"
INSERT_LOSS = "INSERT OR IGNORE INTO loss (origin, epoch, sequence, fate) VALUES (?, ?, ?, ?)"
_SELECT_DATUM = "SELECT kind, created, hops, crc, payload FROM datum WHERE origin = ? AND epoch = ? AND sequence = ?"
_SELECT_INFOS = (
    "SELECT arrival, origin, epoch, sequence, kind, created, hops, crc, size FROM datum "
    "WHERE arrival > ? ORDER BY arrival LIMIT 512"
)
# Of the columns that these two select.
_DATUM_TYPES = (int, float, int, int, bytes)
_INFO_TYPES = (int, int, int, int, int, float, int, int, int)


def create_tables(connection: sqlite3.Connection, epoch: int) -> None:
    """Make the tables of a new store, in one transaction."""
    connection.execute("BEGIN IMMEDIATE")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    for statement in TABLES.values():
        connection.execute(statement)
    write_numbers(connection, "meta", {EPOCH: epoch, NEXT_SEQUENCE: 0})
    connection.execute("COMMIT")


def write_numbers(connection: sqlite3.Connection, table: str, numbers: dict[str, int]) -> None:
    """Set numbers in `meta` or `counter`, each with its complement."""
    connection.executemany(
        f"INSERT OR REPLACE INTO {table} (name, value, inverse) VALUES (?, ?, ?)",
        [(name, value, ~value) for name, value in numbers.items()],
    )


def read_numbers(connection: sqlite3.Connection, table: str) -> dict[str, int]:
    """All numbers in `meta` or `counter`, the store's own included."""
    numbers = {}
    for name, value, inverse in connection.execute(f"SELECT name, value, inverse FROM {table}").fetchall():
        if type(name) is not str or type(value) is not int or type(inverse) is not int or value != ~inverse:
            raise Unsound(f"the number {name!r} in table {table} does not fit its complement")
        numbers[name] = value
    return numbers


def read_own(meta: dict[str, int]) -> tuple[int, int]:
    """Take the store's own numbers, epoch and next sequence, out of `meta`."""
    try:
        epoch, sequence = meta.pop(EPOCH), meta.pop(NEXT_SEQUENCE)
    except KeyError as error:
        raise Unsound(f"the number {error} is missing in table meta") from error
    if not 0 <= epoch < 1 << 32 or not 0 <= sequence <= 1 << 32:
        raise Unsound(f"epoch {epoch} or next sequence number {sequence} is out of range")
    return epoch, sequence


def check_all(connection: sqlite3.Connection) -> None:
    """Check the whole database: its structure, its indexes and every row. Takes time in proportion to its size."""
    verdict = str(connection.execute("PRAGMA integrity_check(1)").fetchall()[0][0])
    if "unable to get the page" in verdict or "failed to get page" in verdict:
        # It takes a page that the disk does not give for a damaged one.
        raise OSError(errno.EIO, verdict)
    if verdict != "ok":
        raise Unsound(verdict)
    # On a read-only connection integrity_check does not look at CHECK constraints.
    rows = connection.execute(f"SELECT arrival FROM datum WHERE ({_SOUND_ROW}) IS NOT 1 LIMIT 1").fetchall()
    if rows:
        raise Unsound(f"row {rows[0][0]} of table datum does not hold what it should")
    read_losses(connection)


def read_datum(connection: sqlite3.Connection, id: DatumId) -> Datum | None:
    """One datum by its id."""
    # fetchall, not fetchone: a statement that is not run to its end keeps a read transaction open.
    rows = connection.execute(_SELECT_DATUM, id).fetchall()
    if not rows:
        return None
    if tuple(map(type, rows[0])) != _DATUM_TYPES:
        raise Unsound(f"the row of datum {id} holds values of a wrong type")
    return Datum(id, *rows[0])


def read_infos(connection: sqlite3.Connection) -> Iterator[StoredInfo]:
    """All data without their payloads, in the order of arrival.

    Reads page by page, so that no read transaction stays open between two of them: a row that is written or deleted
    meanwhile may be seen or not.
    """
    after = -1
    while True:
        rows = connection.execute(_SELECT_INFOS, (after,)).fetchall()
        for row in rows:
            if tuple(map(type, row)) != _INFO_TYPES:
                raise Unsound(f"row {row[0]} of table datum holds values of a wrong type")
            yield StoredInfo(DatumId(*row[1:4]), *row[4:])
        if not rows:
            return
        if rows[-1][0] <= after:
            raise Unsound("the rows of table datum are out of order")
        after = rows[-1][0]


def read_losses(connection: sqlite3.Connection) -> dict[DatumId, Fate]:
    """The table of losses."""
    losses = {}
    rows = connection.execute("SELECT origin, epoch, sequence, fate FROM loss").fetchall()
    for origin, epoch, sequence, fate in rows:
        if type(origin) is not int or type(epoch) is not int or type(sequence) is not int or fate not in _FATES:
            raise Unsound(f"table loss: {fate!r} is not a fate, or an id is not a number")
        losses[DatumId(origin, epoch, sequence)] = _FATES[fate]
    return losses


_FATES: dict[object, Fate] = {fate.value: fate for fate in Fate}
