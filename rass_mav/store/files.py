"""The files of a store: their names, their permissions, durable renames, and the right to use them.

A store is `node.db`, its large payloads `node.db.payloads`, what is there of those that have not come whole
`node.db.partials`, its high-water mark `node.db.mark`, the write-ahead log `node.db-wal` and its index `node.db-shm`
while it is open, and `node.db.lock`, which stays. Files that are set aside or under construction have endings of their
own.
"""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from pathlib import Path

from rass_mav.errors import StoreError

from .errors import explained

#: For all files of a store, whatever the umask: they belong to the node, and its group may read them.
MODE = 0o640
LOG_ENDINGS = ("-wal", "-shm")
MARK = ".mark"
PAYLOADS = ".payloads"
PARTIALS = ".partials"
#: Pages of a damaged store are read in it; deleted afterwards.
SCRATCH = ".pages"


def beside(path: Path, ending: str) -> Path:
    """A file that belongs to `path`."""
    return path.with_name(path.name + ending)


def checked_path(path: str | os.PathLike[str]) -> Path:
    """The path, if a file can have this name. Raises `StoreError`."""
    try:
        encoded = os.fsencode(path)
    except UnicodeEncodeError:
        raise StoreError(f"{os.fspath(path)!r}: not a path: it cannot be encoded") from None
    if b"\0" in encoded or not Path(path).name:
        raise StoreError(f"{os.fspath(path)!r}: not a file path")
    return Path(path)


def make_file(path: Path, flags: int = os.O_CREAT | os.O_RDWR) -> int:
    """Open a file, and create it with `MODE` if it does not exist. Returns the descriptor."""
    descriptor = os.open(path, flags, MODE)
    try:
        mode = os.fstat(descriptor).st_mode & 0o777
        # The umask may have removed rights that we need; an older version may have granted rights that nobody needs.
        if mode & ~MODE or not mode & 0o400:
            os.fchmod(descriptor, mode & MODE | 0o600)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EROFS):
            os.close(descriptor)
            raise
    return descriptor


def tighten(path: Path) -> None:
    """Remove rights beyond `MODE` from the files of a store. SQLite gives the log those of the database."""
    for ending in ("", MARK, PAYLOADS, PARTIALS, *LOG_ENDINGS):
        with suppress(FileNotFoundError, PermissionError):
            file = beside(path, ending)
            mode = file.stat().st_mode & 0o777
            if mode & ~MODE:
                file.chmod(mode & MODE)


def taken(path: Path) -> int:
    """The bytes that the files of a store take: the database, its log and the large payloads."""
    files = (path, beside(path, LOG_ENDINGS[0]), beside(path, PAYLOADS))
    return sum(file.stat().st_size for file in files if file.exists())


def sync_directory(path: Path) -> None:
    """Make a rename in the directory of `path` durable."""
    directory = os.open(path.absolute().parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


class Lock:
    """The right to use a store: one process at a time. The system releases it however the process ends."""

    def __init__(self, path: Path, *, readable_only: bool = False) -> None:
        """Raises `StoreError` if another process, or another store in this one, has the lock.

        `readable_only`: nothing can be written here; if there is no lock file, no process needs to be kept out.
        """
        self._file = -1
        lock = beside(path, ".lock")
        with explained(lock, "locking the store"):
            if not readable_only:
                self._file = make_file(lock)
            elif lock.exists():
                self._file = os.open(lock, os.O_RDONLY)
            else:
                return
        try:
            with explained(lock, "locking the store"):
                try:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    holder = os.read(self._file, 32).decode("ascii", "replace").strip() or "unknown"
                    raise StoreError(f"{path}: in use by another node (process {holder})") from None
                if not readable_only:
                    os.ftruncate(self._file, 0)
                    os.pwrite(self._file, b"%d\n" % os.getpid(), 0)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Release the lock. The file stays: deleting it could take it from a process that has just opened it."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
