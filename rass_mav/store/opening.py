"""Opening a store file: whose it is, whether it is sound, and what to do if it is not.

A store is four files: `node.db`, the write-ahead log `node.db-wal` and its index `node.db-shm` while it is open, and
`node.db.lock`, which stays. A file that is no sound store of ours is never deleted or overwritten: it is set aside as
`node.db.damaged-1`, and the node goes on with a new, empty store.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from rass_mav.errors import StoreDamagedError, StoreError

from .errors import Unsound, explained
from .schema import APPLICATION_ID, SCHEMA_VERSION, TABLES, check_all, create_tables

#: Files up to this size (the log included) are checked from end to end at every start: 0.15 s on a desktop, and on a
#: small board the time to read the file from its card. In larger ones damage shows when it is read, and then the store
#: is opened as suspect.
CHECK_LIMIT = 32 << 20

_LOG_ENDINGS = ("-wal", "-shm")
_MAGIC = b"SQLite format 3\x00"


class OpenReport(NamedTuple):
    """What opening a store found."""

    created: bool
    """A new store was made, with a new epoch."""
    set_aside: Path | None
    """Where the damaged file lies that was found in its place."""
    reason: str
    """What was wrong with it; empty if nothing was."""


class Lock:
    """The right to use a store: one process at a time, given back by the system however the process ends."""

    def __init__(self, path: Path) -> None:
        """Raises `StoreError` if another process, or another store in this one, has the lock."""
        lock = _beside(path, ".lock")
        with explained(lock, "locking the store"):
            self._file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            with explained(lock, "locking the store"):
                try:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    holder = os.read(self._file, 32).decode("ascii", "replace").strip() or "unknown"
                    raise StoreError(f"{path}: in use by another node (process {holder})") from None
                os.ftruncate(self._file, 0)
                os.pwrite(self._file, b"%d\n" % os.getpid(), 0)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Give the lock back. The file stays: deleting it could take it from under somebody who just opened it."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def prepare(
    path: Path, draw_epoch: Callable[[], int], *, suspect: bool, check_limit: int, vfs: str | None
) -> OpenReport:
    """See to it that there is a store at `path`, and no damage that can be found beforehand.

    The caller holds the `Lock`. What `suspect`, `check_limit` and `vfs` mean: see `SqliteStore.open`.
    """
    with explained(path, "opening the store"):
        if path.exists():
            if not path.is_file():
                raise StoreError(f"{path}: not a file")
            if not os.access(path, os.W_OK):
                # SQLite would open it all the same, and fail at the first commit.
                raise StoreError(f"{path}: no permission to write")
            damage = _find_damage(path, suspect, check_limit, vfs)
            if not damage:
                return OpenReport(False, None, "")
        elif any(_beside(path, ending).exists() for ending in _LOG_ENDINGS):
            # Must go: SQLite would play it into the new database.
            damage = "a write-ahead log without its database"
        else:
            _create(path, draw_epoch(), vfs)
            return OpenReport(True, None, "")
    return begin_anew(path, draw_epoch, damage, vfs)


def begin_anew(path: Path, draw_epoch: Callable[[], int], damage: str, vfs: str | None) -> OpenReport:
    """Set a damaged store aside and make a new one. The caller holds the `Lock`, and no connection."""
    with explained(path, "setting a damaged store aside"):
        aside = _set_aside(path)
        _create(path, draw_epoch(), vfs)
        return OpenReport(True, aside, damage)


def connect(
    path: Path, mode: Literal["ro", "rw", "rwc"] = "rw", *, vfs: str | None = None, busy_timeout: float = 5.0
) -> sqlite3.Connection:
    """A connection to a database, in which transactions are begun by hand.

    It may be used on any thread, by one at a time. `mode`: "ro" does not change the database, not even by moving the
    log into it when the connection is closed; "rwc" makes one if there is none.
    """
    options = f"mode={mode}"
    if vfs is not None:
        options += f"&vfs={vfs}"
    if mode == "ro" and not os.access(path.absolute().parent, os.W_OK) and not _beside(path, "-wal").exists():
        # A card mounted read-only, or another user's store at rest: SQLite could not make the index of a log there, and
        # without a log it needs none.
        options += "&immutable=1"
    name = f"{path.absolute().as_uri()}?{options}"
    return sqlite3.connect(name, uri=True, isolation_level=None, check_same_thread=False, timeout=busy_timeout)


def check_version(connection: sqlite3.Connection, path: Path) -> None:
    """Raise `StoreError` for a store that a later version of this program made, `Unsound` for no version at all."""
    version = connection.execute("PRAGMA user_version").fetchall()[0][0]
    if version > SCHEMA_VERSION:
        # Not damage: whoever went back to an older program wants these data, so we refuse to start without them.
        raise StoreError(f"{path}: made by a newer version (schema {version}, this one knows {SCHEMA_VERSION})")
    if version != SCHEMA_VERSION:
        raise Unsound(f"schema version {version}")


def _find_damage(path: Path, suspect: bool, check_limit: int, vfs: str | None) -> str:
    """What is wrong with the file; empty: nothing was found. Changes nothing."""
    with path.open("rb") as file:
        header = file.read(100)
    # Looked at before SQLite sees it: in another program's database, even opening could change something.
    if len(header) < 100 or not header.startswith(_MAGIC):
        return "not a database"
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        return "another program's database"
    if header[18:20] != b"\x02\x02":
        # SQLite would ignore the log then, or refuse to write.
        return "not in write-ahead mode"
    size = sum(file.stat().st_size for file in (path, _beside(path, "-wal")) if file.exists())
    try:
        with explained(path, "checking the store"):
            # Read-only: closing an ordinary connection would move the log into a database that may be beyond repair.
            connection = connect(path, "ro", vfs=vfs)
            try:
                check_version(connection, path)
                tables = dict(connection.execute("SELECT name, sql FROM sqlite_master").fetchall())
                if any(tables.get(name) != statement for name, statement in TABLES.items()):
                    return "its tables are not ours"
                if suspect or size <= check_limit:
                    check_all(connection)
            finally:
                connection.close()
    except StoreDamagedError as error:
        return str(error.__cause__)
    return ""


def _set_aside(path: Path) -> Path:
    """Rename the files of a damaged store, without overwriting those of an earlier one."""
    number = 1
    while any(_beside(path, f".damaged-{number}{ending}").exists() for ending in ("", *_LOG_ENDINGS)):
        number += 1
    aside = _beside(path, f".damaged-{number}")
    # The database goes first: after a crash in between, a log alone is found and set aside, whereas a database without
    # its log might pass for sound with its latest data missing.
    for ending in ("", *_LOG_ENDINGS):
        if _beside(path, ending).exists():
            _beside(path, ending).rename(_beside(aside, ending))
    _sync_directory(path)
    return aside


def _create(path: Path, epoch: int, vfs: str | None) -> None:
    """Make an empty store. It appears under its name complete or not at all."""
    if not 0 <= epoch < 1 << 32:
        raise ValueError(f"an epoch has 32 bits, got {epoch}")
    draft = _beside(path, ".new")
    for ending in ("", "-journal", *_LOG_ENDINGS):
        _beside(draft, ending).unlink(missing_ok=True)
    connection = connect(draft, "rwc", vfs=vfs)
    try:
        connection.execute("PRAGMA synchronous = FULL")
        create_tables(connection, epoch)
        # Last: closing does not tell if moving a log into the database fails. Fetched to the end, where the change is
        # committed; where the mode is not to be had, the answer is the old one.
        if connection.execute("PRAGMA journal_mode = WAL").fetchall() != [("wal",)]:
            raise OSError(errno.ENOTSUP, "no write-ahead mode here")
    finally:
        connection.close()
    draft.rename(path)
    _sync_directory(path)


def _sync_directory(path: Path) -> None:
    """Make a rename durable."""
    directory = os.open(path.absolute().parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)
