"""What a store needs of a disk: SQLite's layer under the database, and plain files beside it.

`HOST` is the real disk. `rass_mav.lab.disk.Disk` is a simulated one.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import NamedTuple, Protocol

from .files import make_file, taken

#: What a store leaves free of a disk: this many bytes, for the log and what else writes there,
RESERVE_BYTES = 64 << 20
#: or one part in this many of a small disk.
RESERVE_PART = 16


class Space(NamedTuple):
    """What there is of a disk, bytes."""

    free: int
    """What a user can still write."""
    reserve: int
    """What a store leaves of that."""

    @property
    def usable(self) -> int:
        """What a store may still take."""
        return max(0, self.free - self.reserve)


def space(folder: Path) -> Space:
    """Of the disk of a folder. `OSError`."""
    disk = os.statvfs(folder)
    return Space(disk.f_bavail * disk.f_frsize, min(RESERVE_BYTES, disk.f_blocks * disk.f_frsize // RESERVE_PART))


class BlockFile:
    """A file that is read and written at offsets in bytes. Reading is safe on any thread, also during a write.

    All methods raise `OSError`.
    """

    def __init__(self, path: Path, *, writable: bool) -> None:
        """Open it, or create it if it is `writable`. `FileNotFoundError`."""
        self._descriptor = make_file(path) if writable else os.open(path, os.O_RDONLY)

    @property
    def size(self) -> int:
        """Bytes."""
        return os.fstat(self._descriptor).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Bytes of the file; fewer at its end."""
        return os.pread(self._descriptor, size, offset)

    def write(self, offset: int, data: bytes) -> None:
        """Write all of it; durable after `sync`."""
        left = memoryview(data)
        while left:
            written = os.pwrite(self._descriptor, left, offset)
            left, offset = left[written:], offset + written

    def sync(self) -> None:
        """Make durable what was written."""
        os.fdatasync(self._descriptor)

    def truncate(self, size: int) -> None:
        """Cut it off behind `size` bytes."""
        os.ftruncate(self._descriptor, size)

    def watch(self, on: bool) -> None:
        """Say to the writer, in whatever process, that this one reads what is in the file now; or no longer."""
        fcntl.flock(self._descriptor, fcntl.LOCK_SH if on else fcntl.LOCK_UN)

    def watched(self) -> bool:
        """Whether somebody else `watch`es it at this moment."""
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        return False

    def close(self) -> None:
        """Release it."""
        os.close(self._descriptor)


class Disk(Protocol):
    """Where a store's files are."""

    @property
    def vfs(self) -> str | None:
        """SQLite's name of the file system layer, only letters, digits and _ -; None: its default."""

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        """Open a file, or create it if it is to be `writable`. `OSError`, `FileNotFoundError`."""

    def space(self, folder: Path) -> Space | None:
        """How much there is; None: there is no end. `OSError`."""


class HostDisk(NamedTuple):
    """The disk of this computer."""

    vfs: str | None = None
    """As in `Disk`."""

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        """As in `Disk`."""
        return BlockFile(path, writable=writable)

    def space(self, folder: Path) -> Space | None:
        """As in `Disk`."""
        return space(folder)


HOST = HostDisk()


class Quota:
    """How much a store may hold: what it was given, and what the disk has, less a reserve."""

    def __init__(self, path: Path, disk: Disk, bound: int | None) -> None:
        """`path`: of the database. `bound`: bytes; None: only that of the disk."""
        self._path = path
        self._disk = disk
        self._bound = bound
        self.bytes = bound
        """By the last look; None: no bound."""

    def look(self) -> None:
        """The files may grow by what the disk has free, less the reserve. What was removed leaves space inside them.
        The log is part of the reserve. `OSError`."""
        space = self._disk.space(self._path.absolute().parent)
        if space is not None:
            most = max(0, taken(self._path) + space.free - space.reserve)
            self.bytes = most if self._bound is None else min(self._bound, most)
