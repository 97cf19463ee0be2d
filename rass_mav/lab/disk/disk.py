"""The disk itself: a VFS that passes SQLite's calls on to the one for Unix, and records what is durable of a file."""

from __future__ import annotations

import ctypes
import errno
import os
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from random import Random
from types import TracebackType

from rass_mav.store.disk import BlockFile

from . import library as c

#: Bytes that are written completely or not at all.
SECTOR = 512


class Image:
    """The durable bytes of a file, and the changes since its last sync."""

    __slots__ = ("_changes", "durable", "exact")

    def __init__(self, content: bytes) -> None:
        self.durable = bytearray(content)
        """What is on the medium."""
        self.exact = True
        """False once changes have been lost: the file as programs see it then differs from the medium."""
        # Offset and data of a write, or the new length and None for a truncation.
        self._changes: list[tuple[int, bytes | None]] = []

    @property
    def settled(self) -> bool:
        """Whether the medium has the file as programs see it."""
        return self.exact and not self._changes

    def write(self, offset: int, data: bytes) -> None:
        """Record a write."""
        self._changes.append((offset, data))

    def truncate(self, length: int) -> None:
        """Record a truncation."""
        self._changes.append((length, None))

    def sync(self) -> None:
        """Make all changes durable."""
        for offset, data in self._changes:
            self._apply(offset, data)
        self._changes.clear()

    def lose(self, rng: Random) -> None:
        """Make durable the changes that the generator picks, tearing writes between sectors, and forget the rest."""
        if not self._changes:
            return
        self.exact = False
        # Drawn for each power cut, so that all and nothing are as likely as anything in between.
        kept = rng.choice((0.0, rng.random(), 1.0))
        torn = rng.choice((0.0, rng.random()))
        for offset, data in self._changes:
            if data is not None and rng.random() < torn:
                end = offset + len(data)
                bounds = [offset, *range((offset // SECTOR + 1) * SECTOR, end, SECTOR), end]
                for start, stop in pairwise(bounds):
                    if rng.random() < 0.5:
                        self._apply(start, data[start - offset : stop - offset])
            elif rng.random() < kept:
                self._apply(offset, data)
        self._changes.clear()

    def _apply(self, offset: int, data: bytes | None) -> None:
        durable = self.durable
        if data is None:
            del durable[offset:]
            return
        if offset > len(durable):
            durable.extend(bytes(offset - len(durable)))
        durable[offset : offset + len(data)] = data


class _File:
    """A file that SQLite has opened, whatever its name is now."""

    __slots__ = ("deleted", "descriptor", "image", "users")

    def __init__(self, path: str) -> None:
        # Stays open: so the file is found after a rename, and no other gets its inode number.
        self.descriptor = os.open(path, os.O_RDWR)
        self.image = Image(os.pread(self.descriptor, os.fstat(self.descriptor).st_size, 0))
        self.users = 0
        self.deleted = ""
        """The path under which it was deleted, until that is durable."""


class _Beside(BlockFile):
    """A file that the program opens itself."""

    def __init__(self, disk: Disk, path: Path, *, writable: bool) -> None:
        if disk.off:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if writable and disk.read_only:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        super().__init__(path, writable=writable)
        self._disk = disk
        self._file = disk.use(path)

    def read(self, offset: int, size: int) -> bytes:
        if self._disk.fails():
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(offset, size)

    def write(self, offset: int, data: bytes) -> None:
        self._change()
        if self._disk.full and offset + len(data) > self.size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(offset, data)
        self._disk.written += len(data)
        self._file.image.write(offset, data)

    def truncate(self, size: int) -> None:
        self._change()
        self._file.image.truncate(size)
        super().truncate(size)

    def sync(self) -> None:
        try:
            self._change()
        except OSError:
            self._file.image.lose(self._disk.rng)
            raise
        self._file.image.sync()

    def close(self) -> None:
        super().close()
        self._disk.leave(self._file)

    def _change(self) -> None:
        if self._disk.change_fails():
            raise OSError(errno.EIO, os.strerror(errno.EIO))


class Disk:
    """A directory of files whose power can be cut. A context manager; otherwise call `close`.

    For the effect of each event and fault see docs/contribute/testing.md. For one thread at a time.
    """

    def __init__(self, rng: Random) -> None:
        """`rng`: every choice is drawn from it. Raises `StoreError` if the library of `sqlite3` cannot be reached."""
        self.full = False
        """Whether files cannot grow."""
        self.read_only = False
        """Whether nothing can be changed."""
        self.error_rate = 0.0
        """Probability 0..1 that an operation fails."""
        self.written = 0
        """Bytes written to its files so far."""
        self.rng = rng
        """For its own choices."""
        self._beside = 0
        self._off = False
        self._changes_left: int | None = None
        # By inode number: files in use, and those with changes that are not durable.
        self._files: dict[int, _File] = {}
        # By address: the file, the methods for Unix, and ours, which SQLite points to as long as the file is open.
        self._opened: dict[int, tuple[_File, c.Methods, c.Methods]] = {}
        self._sqlite = c.load()
        self._temporary = tempfile.TemporaryDirectory(
            prefix="rass-mav-disk-", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        )
        self.directory = Path(self._temporary.name)
        """Where its files lie."""
        self.vfs = self.directory.name
        """Its name for SQLite."""
        self._methods = {
            "close": c.Close(self._close),
            "read": c.Transfer(self._read),
            "write": c.Transfer(self._write),
            "truncate": c.Truncate(self._truncate),
            "sync": c.Sync(self._sync),
        }
        self._unix = self._sqlite.sqlite3_vfs_find(None).contents
        self._ours = c.Vfs.from_buffer_copy(self._unix)
        self._ours.name = self.vfs.encode()
        self._ours.open = c.Open(self._open)
        self._ours.delete = c.Delete(self._delete)
        self._ours.randomness = c.Randomness(self._randomness)
        self._sqlite.sqlite3_vfs_register(self._ours, 0)
        # SQLite points to it until `close`.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._ours))
        self._seed_sqlite()

    @property
    def off(self) -> bool:
        """Whether the power has been cut, and `restart` not been called."""
        return self._off

    def cut(self, *, after: int = 0) -> None:
        """Cut the power after `after` further writes, truncations, deletions and syncs. 0: now."""
        self._off = after == 0
        self._changes_left = after

    def restart(self) -> None:
        """Bring the power back, after a cut or as if there had been one now, with the files as they are on the medium.

        RuntimeError if SQLite still has files open: abandon the store first.
        """
        if self._opened or self._beside:
            raise RuntimeError(f"{len(self._opened) + self._beside} files of the disk are still open")
        for file in self._files.values():
            image = file.image
            image.lose(self.rng)
            if file.deleted and self.rng.random() < 0.5 and not os.path.exists(file.deleted):
                Path(file.deleted).write_bytes(image.durable)
            if not image.exact:
                os.truncate(file.descriptor, len(image.durable))
                os.pwrite(file.descriptor, image.durable, 0)
            os.close(file.descriptor)
        self._files.clear()
        for index in self.directory.glob("*-shm"):
            index.unlink()
        self._off = False
        self._changes_left = None
        self._seed_sqlite()

    def flip_bits(self, path: Path, count: int) -> None:
        """Flip `count` random bits of a file; one that is drawn twice is unchanged. ValueError if the file is empty."""
        file = self._files.get(path.stat().st_ino)
        durable = bytearray() if file is None else file.image.durable
        with path.open("r+b") as stream:
            seen = bytearray(stream.read())
            for _ in range(count):
                place, bit = divmod(self.rng.randrange(8 * len(seen)), 8)
                seen[place] ^= 1 << bit
                if place < len(durable):
                    durable[place] ^= 1 << bit
            stream.seek(0)
            stream.write(seen)

    def close(self) -> None:
        """Remove the disk and its files. RuntimeError if SQLite still has some of them open."""
        if self._opened or self._beside:
            raise RuntimeError(f"{len(self._opened) + self._beside} files of the disk are still open")
        self._sqlite.sqlite3_vfs_unregister(self._ours)
        ctypes.pythonapi.Py_DecRef(ctypes.py_object(self._ours))
        for file in self._files.values():
            os.close(file.descriptor)
        self._temporary.cleanup()

    def __enter__(self) -> Disk:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # -- what the program opens itself ---------------------------------------------------------------------------------

    def open_file(self, path: Path, *, writable: bool) -> BlockFile:
        """Open a file, or create it if it is to be `writable`. `OSError`, `FileNotFoundError`."""
        return _Beside(self, path, writable=writable)

    def space(self, folder: Path) -> None:
        """There is no end; what is full fails."""

    def use(self, path: Path) -> _File:
        """For its files: a file is open."""
        file = self._file(str(path))
        file.users += 1
        self._beside += 1
        return file

    def leave(self, file: _File) -> None:
        """For its files: it is closed."""
        file.users -= 1
        self._beside -= 1
        self._forget(lambda file: file.image.settled and not file.deleted)

    def fails(self) -> bool:
        """For its files: whether an operation fails now."""
        return self._off or (self.error_rate > 0.0 and self.rng.random() < self.error_rate)

    def change_fails(self) -> bool:
        """For its files: whether a change fails now; it counts as one."""
        if self._changes_left is not None:
            self._off = self._changes_left == 0
            self._changes_left -= not self._off
        return self.read_only or self.fails()

    # -- what SQLite calls; an exception would not reach anybody -------------------------------------------------------

    def _file(self, path: str) -> _File:
        number = os.stat(path).st_ino
        if number not in self._files:
            self._files[number] = _File(path)
        return self._files[number]

    def _forget(self, which: Callable[[_File], bool]) -> None:
        for number, file in list(self._files.items()):
            if not file.users and which(file):
                os.close(self._files.pop(number).descriptor)

    def _open(self, vfs: int, name: int | None, address: int, flags: int, found: int | None) -> int:
        if self._off:
            return c.CANTOPEN
        if self.read_only:
            flags = flags & ~(c.OPEN_READWRITE | c.OPEN_CREATE) | c.OPEN_READONLY
        result: int = self._unix.open(ctypes.addressof(self._unix), name, address, flags, found)
        # A file without a name is a temporary one, which is not found after a power cut.
        if result == c.OK and name:
            file = self._file(os.fsdecode(ctypes.string_at(name)))
            methods = ctypes.c_void_p.from_address(address)
            unix = c.Methods.from_address(methods.value or 0)
            ours = c.Methods.from_buffer_copy(unix)
            for method, function in self._methods.items():
                setattr(ours, method, function)
            methods.value = ctypes.addressof(ours)
            file.users += 1
            self._opened[address] = file, unix, ours
        return result

    def _delete(self, vfs: int, name: bytes, sync: int) -> int:
        if self.change_fails():
            return c.IOERR_DELETE
        path = os.fsdecode(name)
        if os.path.exists(path):
            self._file(path).deleted = path
        if sync:
            self._forget(lambda file: bool(file.deleted))
        result: int = self._unix.delete(ctypes.addressof(self._unix), name, 0)
        return result

    def _randomness(self, vfs: int, count: int, out: int) -> int:
        # The VFS for Unix must have been asked by this process before, or it would restart SQLite's generator.
        self._unix.randomness(ctypes.addressof(self._unix), count, out)
        ctypes.memmove(out, self.rng.randbytes(count), count)
        return count

    def _close(self, address: int) -> int:
        file, unix, _ = self._opened.pop(address)
        file.users -= 1
        self._forget(lambda file: file.image.settled and not file.deleted)
        result: int = unix.close(address)
        return result

    def _read(self, address: int, out: int, count: int, offset: int) -> int:
        if self.fails():
            return c.IOERR_READ
        result: int = self._opened[address][1].read(address, out, count, offset)
        return result

    def _write(self, address: int, data: int, count: int, offset: int) -> int:
        file, unix, _ = self._opened[address]
        if self.change_fails():
            return c.IOERR_WRITE
        if self.full and offset + count > os.fstat(file.descriptor).st_size:
            return c.FULL
        result: int = unix.write(address, data, count, offset)
        if result == c.OK:
            self.written += count
            file.image.write(offset, ctypes.string_at(data, count))
        return result

    def _truncate(self, address: int, length: int) -> int:
        file, unix, _ = self._opened[address]
        if self.change_fails():
            return c.IOERR_TRUNCATE
        file.image.truncate(length)
        result: int = unix.truncate(address, length)
        return result

    def _sync(self, address: int, flags: int) -> int:
        image = self._opened[address][0].image
        if self.change_fails():
            image.lose(self.rng)
            return c.IOERR_FSYNC
        image.sync()
        self._forget(lambda file: bool(file.deleted))
        return c.OK

    def _seed_sqlite(self) -> None:
        """Restart SQLite's own generator: it asks the default VFS, once."""
        self._sqlite.sqlite3_vfs_register(self._ours, 1)
        self._sqlite.sqlite3_randomness(0, None)
        self._sqlite.sqlite3_randomness(1, ctypes.create_string_buffer(1))
        self._sqlite.sqlite3_vfs_register(self._unix, 1)
