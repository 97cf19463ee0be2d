"""Opening a store file: which node owns it, whether it is sound, what it may have lost, and what to do then.

A file that is not a sound store of ours is never deleted or overwritten. What it still holds is salvaged into a new
store, and it is set aside as `node.db.damaged-1`.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rass_mav.errors import StoreDamagedError, StoreError

from .disk import Disk
from .drafts import connect, drafted, draw, finish, free_name
from .errors import Unsound, explained
from .files import LOG_ENDINGS, MARK, PAYLOADS, SCRATCH, beside, sync_directory, tighten
from .log import read_log
from .mark import Mark, read_mark
from .payloads import Payloads
from .quota import SECTOR_BYTES
from .repairs import OpenReport, Repairs, close_epochs, find_lost_payloads, find_unsound
from .schema import (
    APPLICATION_ID,
    EPOCH,
    LIFE,
    NEXT_SEQUENCE,
    SCHEMA_VERSION,
    TABLES,
    WRITTEN,
    OwnNumbers,
    count_rows,
    sound_numbers,
    take_own,
    write_own,
)  # fmt: skip

#: Files up to this size (the log included) are checked from end to end at every start: 0.4 s on a PC, and on a
#: small board the time to read the file from its card. In larger ones damage shows when it is read, and then the store
#: is opened as suspect.
CHECK_LIMIT = 32 << 20

_SQLITE_MAGIC = b"SQLite format 3\x00"


class Opening(NamedTuple):
    """How to open a store."""

    path: Path
    node_id: int
    draw_epoch: Callable[[], int]
    disk: Disk
    suspect: bool
    """Check all of it, whatever its size."""
    check_limit: int
    doubt: str = ""
    """Why a new epoch is due, whatever the store says; empty: if it is not sound."""

    def prepare(self) -> tuple[OpenReport, Repairs]:
        """Ensure that there is a store, and no damage that can be found beforehand except what the returned repairs
        fix.

        The caller holds the lock.
        """
        path = self.path
        with explained(path, "opening the store"):
            if path.exists() and not path.is_file():
                # Before anything is changed: /tmp keeps its rights.
                raise StoreError(f"{path}: not a file")
            finish(path)
            tighten(path)
            if path.exists():
                if not os.access(path, os.W_OK):
                    # SQLite would still open it, and fail at the first commit.
                    mounted_so = os.statvfs(path).f_flag & os.ST_RDONLY
                    code = errno.EROFS if mounted_so else errno.EACCES
                    raise OSError(code, os.strerror(code))
                damage, repairs = self._examine()
            else:
                damage, repairs = self._find_residue(), None
                if not damage:
                    epoch = draw(self.draw_epoch)
                    with drafted(path, draw(self.draw_epoch, epoch), epoch, self.disk.vfs):
                        pass
                    return OpenReport(created=True), Repairs()
        if damage or repairs is None:
            return self.begin_anew(damage), Repairs()
        return OpenReport(payloads=repairs.payloads), repairs

    def begin_anew(self, damage: str) -> OpenReport:
        """Create a new store from what a damaged one still holds, and set that aside. The caller has no connection."""
        from .salvage import salvage  # what only a damaged store needs

        path = self.path
        with explained(path, "setting a damaged store aside"):
            mark = read_mark(beside(path, MARK))
            aside = free_name(path)
            epoch = draw(self.draw_epoch)
            life = draw(self.draw_epoch, epoch)
            with drafted(path, life, epoch, self.disk.vfs, aside) as connection:
                found = salvage(path, mark, self.node_id, connection, beside(path, SCRATCH))
                epochs = found.epochs
                taken = (epoch, *epochs, *(() if mark is None else (mark.life, mark.epoch)))
                life = draw(lambda: life, *taken)
                if epoch in epochs:
                    epoch = draw(lambda: epoch, life, *taken)
                own = OwnNumbers(life, epoch, 0, 0, 0)
                own = close_epochs(connection, own, self.node_id, epochs, found.lost)
                write_own(connection, own._replace(written=count_rows(connection)))
        return OpenReport(
            created=True, set_aside=aside, reason=damage, closed=tuple(epochs.items()), salvaged=found.data,
            lost=found.lost,
        )  # fmt: skip

    def _find_residue(self) -> str:
        """What is left of a store whose database is missing; empty: nothing that matters."""
        if any(beside(self.path, ending).exists() for ending in LOG_ENDINGS):
            # It must go: SQLite would replay it into the new database.
            return "a write-ahead log without its database"
        if beside(self.path, PAYLOADS).exists():
            return "payloads without their database"
        mark = read_mark(beside(self.path, MARK))
        return "the database is missing" if mark is not None and (mark.assigned or mark.rows) else ""

    def _examine(self) -> tuple[str, Repairs | None]:
        """What is wrong with the file; if nothing is, the repairs."""
        path = self.path
        with path.open("rb") as file:
            header = file.read(100)
        # Check before SQLite sees it: in another program's database, even opening could change something.
        if len(header) < 100 or not header.startswith(_SQLITE_MAGIC):
            return "not a database", None
        if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
            return "another program's database", None
        if header[18:20] != b"\x02\x02":
            # SQLite would then ignore the log, or refuse to write.
            return "not in write-ahead mode", None
        size = sum(file.stat().st_size for file in (path, beside(path, LOG_ENDINGS[0])) if file.exists())
        thorough = self.suspect or size <= self.check_limit
        try:
            with explained(path, "checking the store"):
                # Read-only: closing an ordinary connection would move the log into a database that may be beyond
                # repair.
                connection = connect(path, "ro", vfs=self.disk.vfs)
                try:
                    check_version(connection, path)
                    if thorough:
                        check_structure(connection)
                    tables = dict(connection.execute("SELECT name, sql FROM sqlite_master").fetchall())
                    if any(tables.get(name) != statement for name, statement in TABLES.items()):
                        return "its tables are not those of rass-mav", None
                    repairs = Repairs()
                    find_unsound(connection, repairs, rows=thorough)
                    meta = sound_numbers(connection, "meta")[0]
                    self._look_at_payloads(connection, meta.get(LIFE, -1), repairs, thorough)
                    self._compare(meta, repairs)
                    return "", repairs
                finally:
                    connection.close()
        except StoreDamagedError as error:
            return str(error.__cause__), None

    def _look_at_payloads(self, connection: sqlite3.Connection, life: int, repairs: Repairs, thorough: bool) -> None:
        """Note rows whose payloads are gone. If the file beside the database is another store's, set it aside."""
        payloads = Payloads(self.path, self.disk, writable=False)
        try:
            # Cut off while it was created, it has no head and no payload.
            foreign = payloads.life != life and payloads.size > SECTOR_BYTES
            if not (foreign or thorough):
                return
            lost, found = find_lost_payloads(connection, payloads, repairs, everything=foreign)
            name = payloads.path.name
            if lost:
                what = "is damaged or truncated" if payloads.size else "is missing"
                repairs.payloads = f"{name} {what}: {lost} data are lost"
            if not foreign or found:
                return
        finally:
            payloads.close()
        aside = beside(free_name(self.path), PAYLOADS)
        payloads.path.rename(aside)
        sync_directory(self.path)
        repairs.payloads = f"{name} belongs to another store and was set aside ({aside.name}): {lost} data are lost"

    def _compare(self, meta: dict[str, int], repairs: Repairs) -> None:
        """Compare the store with its mark. If it is not in the state that the mark records, a new epoch is due."""
        path = self.path
        mark = read_mark(beside(path, MARK))
        sound = {name: meta[name] for name in (LIFE, EPOCH, NEXT_SEQUENCE, WRITTEN) if meta.get(name, -1) >= 0}
        own = take_own(meta)
        if own is None:
            repairs.reason = "a number in table meta is damaged or missing"
        else:
            repairs.reason = _disagreement(path, own, mark) or self.doubt
        if not repairs.reason:
            return
        life = sound.get(LIFE, -1 if mark is None else mark.life)
        if not 0 <= life < 1 << 32:
            life = draw(self.draw_epoch)
        closed = {}
        if 0 <= sound.get(EPOCH, -1) < 1 << 32:
            closed[sound[EPOCH]] = min(sound.get(NEXT_SEQUENCE, 0), 1 << 32)
        written = sound.get(WRITTEN, 0)
        from .salvage import salvage_log

        repairs.log, repairs.missing = salvage_log(path)
        if mark is not None:
            closed[mark.epoch] = max(mark.assigned, closed.get(mark.epoch, 0))
            if mark.life != life:
                repairs.missing += mark.rows
            elif WRITTEN not in sound:
                written = mark.written
            elif mark.exact:
                repairs.missing, repairs.held = max(mark.written - written, 0), mark.rows
            else:
                repairs.missing += max(mark.written - written, 0)
        taken = (life, *closed, *(() if mark is None else (mark.life,)))
        written = max(written, 0 if mark is None or mark.life != life else mark.written)
        repairs.own = OwnNumbers(life, draw(self.draw_epoch, *taken), 0, written, 0 if own is None else own.lost)
        repairs.closed = closed


def check_version(connection: sqlite3.Connection, path: Path) -> None:
    """`StoreError`: a later or an earlier version of this program created the store; `Unsound`: no version did."""
    version = int(connection.execute("PRAGMA user_version").fetchall()[0][0])
    if version > SCHEMA_VERSION:
        # Not damage: a person who went back to an older program wants these data, so we refuse to start without them.
        raise StoreError(f"{path}: created by a newer version (schema {version}, this one supports {SCHEMA_VERSION})")
    if version < 1:
        raise Unsound(f"schema version {version}")
    if version < SCHEMA_VERSION:
        raise StoreError(f"{path}: created by an older version (schema {version}, this one supports {SCHEMA_VERSION})")


def check_structure(connection: sqlite3.Connection) -> None:
    """Check the structure of the whole database, and its indexes. Takes time in proportion to its size."""
    # It ends at the first fault, and a value that violates CHECK or NOT NULL is one: those are repaired.
    for (verdict,) in connection.execute("PRAGMA integrity_check(1000)").fetchall():
        verdict = str(verdict)
        if "unable to get the page" in verdict or "failed to get page" in verdict:
            # It treats a page that the disk does not return as damaged.
            raise OSError(errno.EIO, verdict)
        if verdict != "ok" and not verdict.startswith(("CHECK constraint failed", "NULL value in")):
            raise Unsound(verdict)


def _disagreement(path: Path, own: OwnNumbers, mark: Mark | None) -> str:
    """Why numbers may have been assigned, or data accepted, that the database does not know; empty: none have."""
    if mark is None:
        return "no high-water mark, or a damaged one"
    if (mark.life, mark.epoch) != (own.life, own.epoch):
        return "the high-water mark belongs to another store"
    if own.assigned < mark.assigned or own.written < mark.written:
        return "the database is older than its high-water mark"
    if not mark.exact and not read_log(beside(path, LOG_ENDINGS[0])).intact:
        return "the write-ahead log is damaged"
    return ""
