"""The payloads that are too large for the database, in a file beside it: each is written to the disk once.

The file is a row of sectors. The first is its head: which store it belongs to. A payload begins at a sector of its
own; which one, its row in the database says, and no other record of it exists. docs/store.md describes the order of
writes.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

from rass_mav.core.datum import Datum, DatumId

from .disk import BlockFile, Disk
from .extents import Extents
from .files import PAYLOADS, beside, sync_directory
from .quota import MOST_BESIDE_BYTES, SECTOR_BYTES, lies_beside, sectors_of

#: While more than this is free at the end of the file, bytes, a commit cuts it off.
TRIM_BYTES = 1 << 20

_HEAD = struct.Struct("<8sI")
_MAGIC = b"RASSPAYL"


def head_of(life: int) -> bytes:
    """The first sector of the file of the store with this life."""
    head = _HEAD.pack(_MAGIC, life).ljust(SECTOR_BYTES - 4, b"\0")
    return head + crc32(head).to_bytes(4, "little")


def life_in(head: bytes) -> int | None:
    """The life of the store that a head names; None: it is no head, or a damaged one."""
    if len(head) != SECTOR_BYTES or crc32(head[:-4]) != int.from_bytes(head[-4:], "little"):
        return None
    magic, life = _HEAD.unpack_from(head)
    return life if magic == _MAGIC else None


class Payloads:
    """The file, as far as it exists, for reading. Any thread may read."""

    def __init__(self, path: Path, disk: Disk, *, writable: bool) -> None:
        """`path`: of the database. `OSError`."""
        self.path = beside(path, PAYLOADS)
        self._disk = disk
        self._writable = writable
        self._file: BlockFile | None = None
        self.foreign = False
        """Whether it was found to be another store's, and is not read."""
        self.look()

    def look(self) -> bool:
        """Open the file if it has appeared. Returns whether there is one."""
        if self._file is None and not self.foreign and self.path.exists():
            self._file = self._disk.open_file(self.path, writable=self._writable)
        return self._file is not None

    @property
    def size(self) -> int:
        """Bytes; 0: there is no file."""
        return 0 if self._file is None else self._file.size

    @property
    def life(self) -> int | None:
        """The life of the store that it belongs to; None: it does not say."""
        return None if self._file is None else life_in(self._file.read(0, SECTOR_BYTES))

    def read(self, sector: int, size: int) -> bytes:
        """A payload, or its first bytes; fewer than `size` if they are not there. `OSError`."""
        # The numbers may come from a damaged row.
        there = self.size - sector * SECTOR_BYTES
        if self._file is None or sector < 1 or there < 1 or not 0 < size <= MOST_BESIDE_BYTES:
            return b""
        return self._file.read(sector * SECTOR_BYTES, min(size, there))

    def expect(self, life: int) -> None:
        """Read it only if it does not name another store than the one with this life. `OSError`."""
        if self.life not in (None, life):
            self.close()
            self.foreign = True

    def watch(self, on: bool) -> None:
        """Read only what is in the file now, which then stays there; or no longer."""
        if self.look() and self._file is not None:
            self._file.watch(on)

    def close(self) -> None:
        """Release the file."""
        if self._file is not None:
            self._file.close()
            self._file = None


class PayloadWriter(Payloads):
    """The file, open for the one process that writes."""

    def __init__(self, path: Path, disk: Disk) -> None:
        """`OSError`."""
        super().__init__(path, disk, writable=True)
        self._life = 0
        self._extents = Extents((), 1, 1)
        self._placed: dict[_Key, int] = {}
        """The first sectors of payloads to which no commit that succeeded refers yet."""

    def begin(self, life: int, places: Iterable[tuple[Any, int, Any]]) -> None:
        """`life`: the store's. `places`: arrival, sector and size of each payload, as `read_places` found them. The
        file belongs to this store, whatever its head says. `OSError`; ValueError: they cannot be."""
        self._life = life
        used = []
        for arrival, sector, size in places:
            if type(size) is not int or size < 1:
                raise ValueError(f"row {arrival} has a payload of {size!r} bytes")
            used.append((sector, sectors_of(size)))
        self._extents = Extents(used, 1, sectors_of(self.size))
        if self._file is not None and self.life != life:
            self._file.write(0, head_of(life))
            self._file.sync()

    @property
    def empty(self) -> bool:
        """Whether it holds nothing."""
        return not self._extents.used

    def write(self, data: Iterable[Datum], apart: Iterable[Datum], limit: int | None) -> None:
        """Make the large payloads of data and of second contents durable, all with one sync. `limit`: bound of the file
        in bytes; None: no bound.

        `OSError`, with ENOSPC also beyond the limit. A payload keeps its place until a commit succeeds: nobody knows
        whether one that failed is on the medium.
        """
        large = {
            _Key(second, datum.id, datum.crc, len(datum.payload)): datum.payload
            for second, some in enumerate((data, apart))
            for datum in some
            if lies_beside(len(datum.payload))
        }
        if not large:
            return
        file = self._file or self._create()
        new = [key for key in large if key not in self._placed]
        self._placed.update((key, self._extents.take(sectors_of(key.size))) for key in new)
        try:
            for key, payload in large.items():
                at = self._placed[key] * SECTOR_BYTES
                if limit is not None and at + key.size > limit:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                file.write(at, payload)
            file.sync()
        except BaseException:
            for key in new:
                self._extents.give_back(self._placed.pop(key), sectors_of(key.size))
            raise

    def place(self, datum: Datum, *, apart: bool = False) -> int | None:
        """The first sector of a payload that was written since the last commit; None: it goes into its row."""
        return self._placed.get(_Key(apart, datum.id, datum.crc, len(datum.payload)))

    def settle(self, kept: Collection[int], gone: Iterable[tuple[int, int]]) -> None:
        """A commit has succeeded. It refers to the new payloads `kept`, by sector, and no longer to those `gone`, by
        sector and size."""
        for sector, size in gone:
            self._extents.release(sector, sectors_of(size))
        for key, sector in self._placed.items():
            if sector not in kept:
                self._extents.release(sector, sectors_of(key.size))
        self._placed.clear()

    def recycle(self, *, trim_bytes: int = TRIM_BYTES) -> None:
        """The last commit is durable: use again what was released, unless somebody still reads an older state. Cut off
        the end of the file if more than so many bytes of it are free. `OSError`."""
        file, extents = self._file, self._extents
        if file is None or (extents.waiting and file.watched()):
            return
        extents.recycle()
        if extents.tail * SECTOR_BYTES > trim_bytes:
            # Before the table knows: what could not be cut off is still there.
            end = (extents.end - extents.tail) * SECTOR_BYTES
            if end < file.size:
                file.truncate(end)
            extents.trim()

    def _create(self) -> BlockFile:
        file = self._disk.open_file(self.path, writable=True)
        try:
            file.write(0, head_of(self._life))
            file.sync()
            sync_directory(self.path)
        except BaseException:
            file.close()
            raise
        self._file = file
        return file


class _Key(NamedTuple):
    apart: int
    id: DatumId
    crc: int
    size: int
