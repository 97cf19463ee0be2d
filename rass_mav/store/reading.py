"""A store where nothing can be written: it is only read."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

from rass_mav.errors import StoreDamagedError, StoreError, StoreFullError

from .drafts import connect, drafted, draw
from .errors import Unsound, explained
from .files import LOG_ENDINGS, MARK, SCRATCH, beside
from .mark import read_mark
from .opening import check_version
from .schema import APPLICATION_ID, create_tables, read_infos, read_losses, read_numbers, read_own, write_numbers

_UNWRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT)
#: With less free space than this, bytes, a disk error means lack of space: SQLite needs as much for the log's index.
_NO_ROOM = 64 << 10


def why_unwritable(error: StoreError, path: Path) -> str:
    """Why nothing can be written, if an error of opening means that; else empty."""
    cause = error.__cause__
    if isinstance(error, StoreFullError):
        return "disk full"
    if isinstance(cause, OSError) and cause.errno in _UNWRITABLE:
        return "disk full" if cause.errno in (errno.ENOSPC, errno.EDQUOT) else os.strerror(cause.errno).lower()
    if isinstance(cause, sqlite3.Error):
        # An existing database cannot be opened: SQLite cannot create a log beside it.
        if "readonly" in str(cause) or ("unable to open" in str(cause) and path.exists()):
            return "read-only"
        if not isinstance(error, StoreDamagedError) and _room(path) < _NO_ROOM:
            return "disk full"
    return ""


def open_to_read(path: Path, draw_epoch: Callable[[], int], vfs: str | None) -> sqlite3.Connection:
    """A connection that changes nothing, to the store at `path`; to an empty one in memory if there is none.

    `StoreError`: it is of another version.
    """
    if path.exists():
        try:
            return _opened(path, vfs)
        except StoreDamagedError:
            pass  # it stays where it is; without space it cannot be salvaged
    connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    epoch = draw(draw_epoch)
    create_tables(connection, draw(draw_epoch, epoch), epoch)
    return connection


def connect_alone(path: Path, vfs: str | None = None) -> sqlite3.Connection:
    """A connection that changes nothing, where no process can write beside the store."""
    # Without a log nothing is missing; with one, SQLite creates its index beside it, or else in memory.
    log = beside(path, LOG_ENDINGS[0])
    if not log.exists() or not log.stat().st_size:
        return connect(path, "ro", vfs=vfs, immutable=True)
    connection = connect(path, "ro", vfs=vfs)
    try:
        connection.execute("PRAGMA schema_version").fetchall()
    except sqlite3.OperationalError:
        connection.close()
        if vfs is not None:
            raise
        # No other process can write either, so no locks are needed.
        connection = connect(path, "ro", vfs="unix-none")
        connection.execute("PRAGMA locking_mode = EXCLUSIVE").fetchall()
    return connection


def salvaged_copy(path: Path, copy: Path) -> int:
    """Write what a damaged store still holds to a new store; the old one stays as it is. Returns how many data that
    are. `StoreError`."""
    from .salvage import salvage  # what only a damaged store needs

    with explained(path, "salvaging the data"), drafted(copy, 0, 1, None) as connection:
        found = salvage(path, read_mark(beside(path, MARK)), 0, connection, beside(copy, SCRATCH))
        write_numbers(connection, "meta", found.numbers)
    return found.data


def _opened(path: Path, vfs: str | None) -> sqlite3.Connection:
    with explained(path, "opening the store to read"):
        return _checked(path, connect_alone(path, vfs))


def _checked(path: Path, connection: sqlite3.Connection) -> sqlite3.Connection:
    """The connection, if everything that is read at the start can be read; otherwise it is closed."""
    try:
        if connection.execute("PRAGMA application_id").fetchall()[0][0] != APPLICATION_ID:
            raise Unsound("another program's database")
        check_version(connection, path)
        for table in ("datum", "apart"):
            for _ in read_infos(connection, table):
                pass
        read_losses(connection)
        read_numbers(connection, "counter")
        read_own(read_numbers(connection, "meta"))
    except BaseException:
        connection.close()
        raise
    return connection


def _room(path: Path) -> int:
    try:
        disk = os.statvfs(path.absolute().parent)
    except OSError:
        return _NO_ROOM
    return disk.f_bavail * disk.f_frsize
