"""What opening a store found: the report, and the repairs where its structure is sound: of single damaged rows, and of
an end that lost something."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate, datum_crc

from .payloads import Payloads
from .quota import SECTOR_BYTES
from .schema import (
    INSERT_APART,
    INSERT_LOSS,
    OwnNumbers,
    datum_row,
    insert_data,
    loss_row,
    read_positions,
    sound_losses,
    sound_numbers,
    unsound_rows,
    write_own,
)  # fmt: skip

_U32 = (1 << 32) - 1


class OpenReport(NamedTuple):
    """What opening a store found."""

    created: bool = False
    """A new store was created, with a new life and a new epoch."""
    set_aside: Path | None = None
    """Where the damaged file is that was found in its place."""
    reason: str = ""
    """What was wrong with it, or why the epoch is new; empty if nothing was wrong."""
    closed: tuple[tuple[int, int], ...] = ()
    """Epochs that ended, each with how many of its numbers are known to be assigned; more may have been."""
    salvaged: int = 0
    """Data that were found in the damaged file, and are in the store now."""
    lost: int = 0
    """The most data that may be lost."""
    dropped: tuple[str, ...] = ()
    """Single rows that were damaged and are left out."""
    payloads: str = ""
    """What was wrong with the file of large payloads: data in it are left out. Empty: nothing."""
    unwritable: str = ""
    """Why nothing can be written here: the store is only read. Empty: it can be written."""

    @property
    def remarks(self) -> list[str]:
        """What people should know, one short line each."""
        lines = []
        if self.unwritable:
            lines.append(f"store cannot be written ({self.unwritable}): relaying only, no data accepted")
        if self.set_aside is not None:
            lines.append(
                f"damaged store set aside ({self.set_aside.name}), {self.salvaged} data salvaged, new store created"
            )
        elif self.salvaged:
            lines.append(f"{self.salvaged} data salvaged from a damaged log")
        if self.lost:
            lines.append(f"up to {self.lost} data may be lost: the store was damaged")
        if self.payloads:
            lines.append(self.payloads)
        if self.dropped:
            lines.append(f"{len(self.dropped)} damaged rows skipped, the first: {self.dropped[0]}")
        if self.closed and not self.created:
            lines.append("sequence numbers may be lost: a new epoch begins")
        return lines


@dataclass
class Repairs:
    """What opening found, to be repaired in one transaction before the store is used."""

    rows: list[tuple[str, tuple[Any, ...]]] = field(default_factory=list)
    """Table, and arrival and id of a row of data with wrong content."""
    numbers: list[tuple[str, bytes]] = field(default_factory=list)
    """Table, and name of a number that does not match its complement."""
    losses: list[tuple[Any, ...]] = field(default_factory=list)
    """Ids of losses that do not match their checksum."""
    own: OwnNumbers | None = None
    """The store's own numbers, if they change."""
    closed: dict[int, int] = field(default_factory=dict)
    """Epochs that end, each with the numbers known to be assigned."""
    log: list[Datum] = field(default_factory=list)
    """Data from a part of the log that SQLite did not use."""
    missing: int = 0
    """The most rows that were written and are missing, before those of the `log` are found."""
    held: int | None = None
    """The most rows that were held in the end. No more can be lost, because data that were passed on are not lost.
    None: unknown."""
    reason: str = ""
    payloads: str = ""
    """What is wrong with the file of payloads."""

    def __bool__(self) -> bool:
        return bool(self.rows or self.numbers or self.losses or self.own)


def find_unsound(connection: sqlite3.Connection, repairs: Repairs, *, rows: bool) -> None:
    """Note rows and numbers with wrong content. `rows`: check every row of data, which takes time."""
    for table in ("meta", "counter"):
        repairs.numbers += [(table, name) for name in sound_numbers(connection, table)[1]]
    repairs.losses = sound_losses(connection)[1]
    if rows:
        for table in ("datum", "apart"):
            repairs.rows += [(table, row) for row in unsound_rows(connection, table)]


def find_lost_payloads(
    connection: sqlite3.Connection, payloads: Payloads, repairs: Repairs, *, everything: bool
) -> tuple[int, int]:
    """Note rows whose payload is not in the file. Returns how many those are, and how many others there are.

    Reads only where two payloads overlap, or one lies outside; `everything`: all of them.
    """
    positions = []
    # By table and arrival.
    lost: list[tuple[str, int]] = []
    doubtful: set[tuple[str, int]] = set()
    size_of_file = payloads.size
    for table in ("datum", "apart"):
        for arrival, sector, size in read_positions(connection, table):
            if type(size) is int and size > 0 < sector:
                positions.append((sector * SECTOR_BYTES, sector * SECTOR_BYTES + size, table, arrival))
            else:
                lost.append((table, arrival))
    positions.sort()
    end, last = 0, ("", 0)
    for first, behind, table, arrival in positions:
        if everything or behind > size_of_file:
            doubtful.add((table, arrival))
        if first < end:
            doubtful |= {last, (table, arrival)}
        if behind > end:
            end, last = behind, (table, arrival)
    lost += [row for row in sorted(doubtful) if not _there(connection, payloads, *row)]
    for table, arrival in lost:
        ids = f"SELECT arrival, origin, epoch, sequence FROM {table} WHERE arrival = ?"
        row = table, connection.execute(ids, (arrival,)).fetchall()[0]
        if row not in repairs.rows:
            repairs.rows.append(row)
    return len(lost), len(positions) - len(doubtful) + sum(row not in lost for row in doubtful)


def _there(connection: sqlite3.Connection, payloads: Payloads, table: str, arrival: int) -> bool:
    columns = "origin, epoch, sequence, kind, crc, payload, size"
    rows = connection.execute(f"SELECT {columns} FROM {table} WHERE arrival = ?", (arrival,)).fetchall()
    origin, epoch, sequence, kind, crc, sector, size = rows[0]
    if any(type(number) is not int or not 0 <= number <= _U32 for number in (origin, epoch, sequence, kind)):
        return False
    if kind > 255 or origin >= 1 << 16:
        return False
    payload = payloads.read(sector, size)
    return bool(len(payload) == size and datum_crc(DatumId(origin, epoch, sequence), kind, payload) == crc)


def apply(connection: sqlite3.Connection, repairs: Repairs, own: OwnNumbers, node_id: int) -> OpenReport:
    """Carry out the repairs. `own`: the store's own numbers, the former or the new ones."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        report = _apply(connection, repairs, own, node_id)
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise
    return report


def _apply(connection: sqlite3.Connection, repairs: Repairs, own: OwnNumbers, node_id: int) -> OpenReport:
    dropped = []
    losses: list[tuple[DatumId, Fate]] = []
    lost = 0
    for table, (arrival, *parts) in repairs.rows:
        connection.execute(f"DELETE FROM {table} WHERE arrival = ?", (arrival,))
        dropped.append(f"row {arrival} of table {table}")
        if table == "datum" and all(type(part) is int and 0 <= part <= _U32 for part in parts):
            losses.append((DatumId(*parts), Fate.CORRUPTED))
        else:
            lost += 1
    for table, name in repairs.numbers:
        connection.execute(f"DELETE FROM {table} WHERE CAST(name AS BLOB) = ?", (name,))
        dropped.append(f"the number {name.decode(errors='replace')}")
    for id in repairs.losses:
        connection.execute("DELETE FROM loss WHERE origin IS ? AND epoch IS ? AND sequence IS ?", id)
        dropped.append("a loss")
        lost += 1
    salvaged = 0
    for datum in repairs.log:
        salvaged += _add(connection, datum)
    missing = max(repairs.missing - salvaged, 0)
    lost += missing if repairs.held is None else min(missing, repairs.held)
    own = close_epochs(connection, own, node_id, repairs.closed, lost, losses)
    own = own._replace(written=own.written + salvaged)
    write_own(connection, own)
    return OpenReport(
        reason=repairs.reason,
        closed=tuple(repairs.closed.items()),
        salvaged=salvaged,
        lost=lost,
        dropped=tuple(dropped),
        payloads=repairs.payloads,
    )


def close_epochs(
    connection: sqlite3.Connection, own: OwnNumbers, node_id: int, closed: dict[int, int], lost: int,
    losses: list[tuple[DatumId, Fate]] | None = None,
) -> OwnNumbers:  # fmt: skip
    """Record losses: what ended uncleanly, and how many data were lost in this life. Returns the resulting numbers."""
    losses = losses or []
    losses += [(DatumId(node_id, epoch, min(assigned, _U32)), Fate.UNKNOWN) for epoch, assigned in closed.items()]
    if lost:
        # The sum for this life, so that each report includes the earlier ones.
        own = own._replace(lost=own.lost + lost)
        losses.append((DatumId(node_id, own.life, min(own.lost, _U32)), Fate.DAMAGED))
    connection.executemany(INSERT_LOSS, [loss_row(id, fate) for id, fate in losses])
    return own._replace(written=own.written + len(losses))


def _add(connection: sqlite3.Connection, datum: Datum) -> int:
    """Store a datum that was found; 1: it was not there."""
    found = connection.execute("SELECT crc FROM datum WHERE origin = ? AND epoch = ? AND sequence = ?", datum.id)
    crcs = found.fetchall()
    if not crcs:
        insert_data(connection, [datum_row(datum)])
        return 1
    if crcs[0][0] == datum.crc:
        return 0
    return connection.execute(INSERT_APART, datum_row(datum)).rowcount
