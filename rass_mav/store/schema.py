"""The tables of a store on disk, and how their rows are read.

Radiation flips bits on the way to the disk and back. SQLite detects a broken structure, but not a changed value. So
payloads and losses have a CRC. The numbers in `meta` and `counter` are stored with their bitwise complement (a sequence
number that fell back would be used twice), and every column of a row is checked for its type when it is read. Wrong
content raises `Unsound`, which `explained` turns into `StoreDamagedError`.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple
from zlib import crc32

from rass_mav.core.datum import PARTS, TERMS, TERMS_SIZE, Datum, DatumId, Fate, terms_of
from rass_mav.core.store import Loss, StoredInfo

from .errors import Unsound
from .payloads import Payloads

#: `PRAGMA application_id`: "RASS" in ASCII. Distinguishes our files from other programs' databases.
APPLICATION_ID = 0x52415353
#: `PRAGMA user_version`: the version of the tables below.
SCHEMA_VERSION = 3

#: How large the pages of a new store are, bytes. A commit changes three to five pages, however little is stored, and
#: SQLite logs whole ones: 1024 would still be too much for a part of 16 KiB with a commit of its own
#: (docs/evaluation/performance.md).
PAGE_BYTES = 512

# Names in `meta` that belong to the store itself.
OWN_PREFIX = "store."
LIFE = "store.life"
EPOCH = "store.epoch"
NEXT_SEQUENCE = "store.next_sequence"
WRITTEN = "store.written"
LOST = "store.lost"

_NUMBERS = "CREATE TABLE {} (name TEXT PRIMARY KEY, value INTEGER NOT NULL, inverse INTEGER NOT NULL) WITHOUT ROWID"

_SOUND = (
    "typeof(origin) = 'integer' AND typeof(epoch) = 'integer' AND typeof(sequence) = 'integer' "
    "AND typeof(kind) = 'integer' AND typeof(created) = 'real' AND typeof(hops) = 'integer' "
    "AND typeof(crc) = 'integer' AND at_least IN (0, 1) AND (typeof(payload) = 'blob' AND length(payload) = size "
    "OR typeof(payload) = 'integer' AND payload > 0 AND typeof(size) = 'integer' AND size > 0)"
)
_DATA = (
    "CREATE TABLE {} (arrival INTEGER PRIMARY KEY, origin INTEGER NOT NULL, epoch INTEGER NOT NULL, "
    "sequence INTEGER NOT NULL, kind INTEGER NOT NULL, created REAL NOT NULL, hops INTEGER NOT NULL, "
    "crc INTEGER NOT NULL, size INTEGER NOT NULL, at_least INTEGER NOT NULL, payload BLOB NOT NULL, "
    "UNIQUE ({}), CHECK ({}))"
)
_KEYS = {"datum": "origin, epoch, sequence", "apart": "origin, epoch, sequence, crc"}

#: Name -> the statement that creates the table; SQLite keeps the text unchanged, so that it can be compared. The
#: payload of a datum comes last, so that the rest can be read without its overflow pages. A number in its place is the
#: sector of `Payloads` at which it begins.
TABLES = {
    "meta": _NUMBERS.format("meta"),
    "counter": _NUMBERS.format("counter"),
    **{name: _DATA.format(name, key, _SOUND) for name, key in _KEYS.items()},
    "loss": (
        "CREATE TABLE loss (origin INTEGER NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL, "
        "fate TEXT NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (origin, epoch, sequence)) WITHOUT ROWID"
    ),
}

#: An arrival from here on tells when it was: this plus milliseconds on the node's timeline. Smaller ones only count.
ARRIVAL_0_MS = 1 << 40
_COLUMNS = "origin, epoch, sequence, kind, created, hops, crc, size, at_least, payload"
_INSERT_DATUM = (
    f"INSERT OR REPLACE INTO datum (arrival, {_COLUMNS}) "
    "VALUES (max(?, (SELECT coalesce(max(arrival), 0) + 1 FROM datum)), ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
)
#: What `payload` holds: a number, or the first bytes.
_HEAD = "CASE typeof(payload) WHEN 'integer' THEN payload ELSE substr(payload, 1, ?) END"
INSERT_APART = f"INSERT OR IGNORE INTO apart ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
#: As long as the row was, so that it is overwritten in place.
MARK_AT_LEAST = tuple(f"UPDATE {table} SET at_least = 1 WHERE at_least = 0" for table in ("datum", "apart"))
AMEND_DATUM = "UPDATE datum SET created = ?, at_least = 0 WHERE origin = ? AND epoch = ? AND sequence = ?"
DELETE_DATUM = "DELETE FROM datum WHERE origin = ? AND epoch = ? AND sequence = ?"
DELETE_LOSS = "DELETE FROM loss WHERE origin = ? AND epoch = ? AND sequence = ?"
INSERT_LOSS = "INSERT OR IGNORE INTO loss (origin, epoch, sequence, fate, crc) VALUES (?, ?, ?, ?, ?)"
_SELECT_DATUM = (
    "SELECT kind, created, hops, crc, size, payload, at_least FROM datum "
    "WHERE origin = ? AND epoch = ? AND sequence = ?"
)
_SELECT_APART = (
    "SELECT kind, created, hops, crc, size, payload, at_least FROM apart "
    "WHERE origin = ? AND epoch = ? AND sequence = ? AND crc = ?"
)
_SELECT_INFOS = (
    "SELECT arrival, origin, epoch, sequence, kind, created, hops, crc, size, at_least, "
    f"CASE WHEN NOT kind & {TERMS} OR size = 0 THEN x'' ELSE {_HEAD} END FROM {{}} "
    "WHERE arrival > ? ORDER BY arrival LIMIT 512"
)
# The kind without the bits that say more about the payload.
_PART = f"kind & 63 IN ({', '.join(str(int(kind)) for kind in PARTS)})"
_WHICH = {None: "", True: f" AND {_PART}", False: f" AND NOT {_PART}"}
_SELECT_ROWS = (
    f"SELECT arrival, origin, epoch, sequence, kind, created, hops, crc, size, at_least, {_HEAD} FROM {{}} "
    "WHERE arrival > ?{} ORDER BY arrival LIMIT 512"
)
_SELECT_POSITION = (
    "SELECT payload, size FROM datum WHERE origin = ? AND epoch = ? AND sequence = ? AND typeof(payload) = 'integer'"
)
# The columns that these select.
_DATUM_TYPES = (int, float, int, int, int, bytes, int)
_INFO_TYPES = (int, int, int, int, int, float, int, int, int, int)


class Source(NamedTuple):
    """Where data are read."""

    rows: sqlite3.Connection
    payloads: Payloads
    """The payloads that are not in their rows."""


class OwnNumbers(NamedTuple):
    """The store's own numbers, all in `meta`."""

    life: int
    """32 bits."""
    epoch: int
    """32 bits, not equal to the life."""
    assigned: int
    """Numbers assigned in this epoch, 0 to 2^32."""
    written: int
    """Rows ever written in this life."""
    lost: int
    """The most data that may have been lost in this life with a damaged store."""


def create_tables(connection: sqlite3.Connection, life: int, epoch: int) -> None:
    """Create the tables of a new store, in one transaction."""
    connection.execute("BEGIN IMMEDIATE")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    for statement in TABLES.values():
        connection.execute(statement)
    write_own(connection, OwnNumbers(life, epoch, 0, 0, 0))
    connection.execute("COMMIT")


def write_own(connection: sqlite3.Connection, own: OwnNumbers) -> None:
    """Set the store's own numbers."""
    write_numbers(connection, "meta", dict(zip((LIFE, EPOCH, NEXT_SEQUENCE, WRITTEN, LOST), own, strict=True)))


def write_numbers(connection: sqlite3.Connection, table: str, numbers: dict[str, int]) -> None:
    """Set numbers in `meta` or `counter`, each with its complement."""
    connection.executemany(
        f"INSERT OR REPLACE INTO {table} (name, value, inverse) VALUES (?, ?, ?)",
        [(name, value, ~value) for name, value in numbers.items()],
    )


def read_numbers(connection: sqlite3.Connection, table: str) -> dict[str, int]:
    """All numbers in `meta` or `counter`, the store's own included."""
    numbers, unsound = sound_numbers(connection, table)
    if unsound:
        raise Unsound(f"the number {unsound[0]!r} in table {table} does not match its complement, or is not a number")
    return numbers


def sound_numbers(connection: sqlite3.Connection, table: str) -> tuple[dict[str, int], list[bytes]]:
    """The numbers in `meta` or `counter` that match their complement, and the raw names of the others. `Unsound`: one
    has no name."""
    numbers, unsound = {}, []
    rows = connection.execute(f"SELECT CAST(name AS BLOB), value, inverse FROM {table}").fetchall()
    for raw, value, inverse in rows:
        if raw is None:
            # SQLite cannot find such a row, so that it cannot be left out.
            raise Unsound(f"a number in table {table} has no name")
        try:
            if type(value) is not int or type(inverse) is not int or value != ~inverse:
                raise ValueError
            numbers[raw.decode()] = value
        except ValueError:
            unsound.append(raw)
    return numbers, unsound


def read_own(meta: dict[str, int]) -> OwnNumbers:
    """Take the store's own numbers out of `meta`."""
    own = take_own(meta)
    if own is None:
        raise Unsound("a number in table meta is missing or out of range")
    return own


def take_own(meta: dict[str, int]) -> OwnNumbers | None:
    """The store's own numbers, taken out of `meta`; None: they cannot be trusted."""
    numbers = [meta.pop(name, -1) for name in (LIFE, EPOCH, NEXT_SEQUENCE, WRITTEN, LOST)]
    own = OwnNumbers(*numbers)
    in_range = own.life < 1 << 32 and own.epoch < 1 << 32 and own.assigned <= 1 << 32
    return own if in_range and min(own) >= 0 else None


def insert_data(connection: sqlite3.Connection, rows: Iterable[tuple[Any, ...]], now_ms: int | None = None) -> None:
    """Insert rows of data, each as the latest. `now_ms`: when they arrived, milliseconds on the node's timeline; None:
    nobody knows."""
    least = 0 if now_ms is None else ARRIVAL_0_MS + now_ms
    connection.executemany(_INSERT_DATUM, ((least, *row) for row in rows))


def datum_row(datum: Datum, sector: int | None = None) -> tuple[Any, ...]:
    """The columns of a table of data, without the arrival. `sector`: where the payload begins in `Payloads`; None: it
    is in the row."""
    id, kind, created, hops, crc, payload, at_least = datum
    return (*id, kind, created, hops, crc, len(payload), int(at_least), payload if sector is None else sector)


def loss_row(id: DatumId, fate: Fate, proof: bytes = b"") -> tuple[Any, ...]:
    """The columns of `INSERT_LOSS`. A proof follows the fate, in hexadecimal digits."""
    text = f"{fate.value} {proof.hex()}" if proof else fate.value
    return (*id, text, loss_crc(id, text.encode()))


def loss_crc(id: Iterable[int], fate: bytes) -> int:
    """The checksum of a row of the table of losses."""
    return crc32(fate, crc32(struct.pack("<3q", *id)))


def unsound_rows(connection: sqlite3.Connection, table: str = "datum") -> list[tuple[Any, ...]]:
    """The rows of data with wrong content: arrival, and the three parts of the id."""
    # On a read-only connection integrity_check does not look at CHECK constraints.
    return connection.execute(
        f"SELECT arrival, origin, epoch, sequence FROM {table} WHERE ({_SOUND}) IS NOT 1"
    ).fetchall()


def read_datum(source: Source, id: DatumId, apart_crc: int | None = None) -> Datum | None:
    """One datum by its id; or a second content, by its CRC too. Of a payload that is missing there is as much as is
    left."""
    # fetchall, not fetchone: a statement that is not run to its end keeps a read transaction open.
    if apart_crc is None:
        rows = source.rows.execute(_SELECT_DATUM, id).fetchall()
    else:
        rows = source.rows.execute(_SELECT_APART, (*id, apart_crc)).fetchall()
    if not rows:
        return None
    kind, created, hops, crc, size, payload, at_least = rows[0]
    if type(payload) is int and type(size) is int:
        payload = source.payloads.read(payload, size)
    if tuple(map(type, (*rows[0][:5], payload, at_least))) != _DATUM_TYPES:
        raise Unsound(f"the row of datum {id} has values of a wrong type")
    return Datum(id, kind, created, hops, crc, payload, bool(at_least))


def read_infos(
    connection: sqlite3.Connection, table: str = "datum", payloads: Payloads | None = None
) -> Iterator[StoredInfo]:
    """All data (or all second contents, `apart`) without their payloads, in the order of arrival. `payloads`: None: the
    terms of those whose payloads are beside the database are not read.

    Reads page by page, so that no read transaction stays open between two pages: a row that is written or deleted
    meanwhile may be seen or not.
    """
    after = -1
    # Equal numbers are one object: a base keeps the ids of all its data.
    one: dict[int, int] = {}
    while True:
        rows = connection.execute(_SELECT_INFOS.format(table), (TERMS_SIZE, after)).fetchall()
        for row in rows:
            _, origin, epoch, sequence, kind, created, hops, crc, size, at_least, head = row
            if type(head) is int:
                head = b"" if payloads is None else payloads.read(head, TERMS_SIZE)
            if tuple(map(type, (*row[:-1], head))) != (*_INFO_TYPES, bytes):
                raise Unsound(f"row {row[0]} of table {table} has values of a wrong type")
            id = DatumId(origin, one.setdefault(epoch, epoch), one.setdefault(sequence, sequence))
            yield StoredInfo(id, kind, created, hops, crc, size, bool(at_least), terms_of(kind, head))
        if not rows:
            return
        if rows[-1][0] <= after:
            raise Unsound(f"the rows of table {table} are out of order")
        after = rows[-1][0]


def read_positions(connection: sqlite3.Connection, table: str) -> list[tuple[Any, int, Any]]:
    """Arrival, sector and size of the rows of a table whose payloads are beside the database, without order. In a
    damaged row the arrival and the size may be anything."""
    rows = connection.execute(f"SELECT arrival, payload, size FROM {table} WHERE typeof(payload) = 'integer'")
    return rows.fetchall()


def read_position(connection: sqlite3.Connection, id: DatumId) -> tuple[int, int] | None:
    """The sector and size of a datum whose payload is beside the database; None: there is none."""
    for sector, size in connection.execute(_SELECT_POSITION, id).fetchall():
        if type(sector) is int and type(size) is int:
            return sector, size
    return None


class Row(NamedTuple):
    """A row of data, as it is on the disk."""

    arrival: int
    """Rises with each row that is stored; a replaced one gets a new number. See `ARRIVAL_0_MS`."""
    info: StoredInfo
    head: bytes
    """The beginning of the payload."""


def read_rows(
    source: Source, table: str, head_bytes: int, after: int = -1, parts: bool | None = None
) -> Iterator[Row | None]:
    """The rows of a table with the beginning of their payloads, in the order of arrival. None: a row is not sound.
    `parts`: only parts of files, or only other data; None: all."""
    while rows := source.rows.execute(_SELECT_ROWS.format(table, _WHICH[parts]), (head_bytes, after)).fetchall():
        for row in rows:
            arrival, origin, epoch, sequence, kind, created, hops, crc, size, at_least, head = row
            if type(head) is int and type(size) is int:
                head = source.payloads.read(head, min(size, head_bytes))
            if tuple(map(type, (*row[:-1], head))) != (*_INFO_TYPES, bytes):
                yield None
                continue
            id = DatumId(origin, epoch, sequence)
            yield Row(arrival, StoredInfo(id, kind, created, hops, crc, size, bool(at_least)), head)
        if type(rows[-1][0]) is not int or rows[-1][0] <= after:
            raise Unsound(f"the rows of table {table} are out of order")
        after = rows[-1][0]


def read_losses(connection: sqlite3.Connection) -> dict[DatumId, Loss]:
    """The table of losses."""
    losses, unsound = sound_losses(connection)
    if unsound:
        raise Unsound(f"{len(unsound)} rows of table loss do not match their checksum")
    return losses


def sound_losses(connection: sqlite3.Connection) -> tuple[dict[DatumId, Loss], list[tuple[Any, ...]]]:
    """The losses that match their checksum, and the ids of the other rows, whatever they contain."""
    losses: dict[DatumId, Loss] = {}
    unsound = []
    # As a blob, because it may no longer be UTF-8.
    rows = connection.execute("SELECT origin, epoch, sequence, CAST(fate AS BLOB), crc FROM loss").fetchall()
    for origin, epoch, sequence, fate, crc in rows:
        id = (origin, epoch, sequence)
        if (found := sound_loss(id, fate, crc)) is None:
            unsound.append(id)
        else:
            losses[DatumId(*id)] = found
    return losses, unsound


def sound_loss(id: tuple[Any, ...], fate: Any, crc: Any) -> Loss | None:
    """A row of the table of losses, with the text as bytes; None: the row is not sound."""
    if type(fate) is not bytes or any(type(part) is not int for part in id):
        return None
    if any(not -(1 << 63) <= part < 1 << 63 for part in id):
        return None
    name, _, proof = fate.partition(b" ")
    found = _FATES.get(name)
    if found is None or loss_crc(id, fate) != crc:
        return None
    try:
        return Loss(found, bytes.fromhex(proof.decode("ascii")))
    except ValueError:
        return None


def count_rows(connection: sqlite3.Connection) -> int:
    """Rows held: data, second contents, losses."""
    return int(
        connection.execute(
            "SELECT (SELECT count(*) FROM datum) + (SELECT count(*) FROM apart) + (SELECT count(*) FROM loss)"
        ).fetchall()[0][0]
    )


_FATES = {fate.value.encode(): fate for fate in Fate}
