"""The payloads that are too large for the database, in a file beside it: each is written to the disk once.

The file is a row of sectors. The first is its head: which store it belongs to. A payload begins at a sector of its
own; which one, its row in the database says, and no other record of it exists. docs/reference/store.md describes the
order of
writes.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.store import MAX_PARTIALS, PartialKey

from .disk import BlockFile, Disk
from .extents import Extents
from .files import PAYLOADS, beside, sync_directory
from .partials import MAX_RUNS, Partial, PartialTable, Run
from .quota import MOST_BESIDE_BYTES, MOST_PARTIAL_BYTES, SECTOR_BYTES, lies_beside, sectors_of

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
        self._positions: dict[_Key, int] = {}
        """The first sectors of payloads to which no commit that succeeded refers yet."""
        self._partials = PartialTable(path, disk)
        self._taken: list[Partial] = []
        """Those that have become payloads to which no commit that succeeded refers yet."""

    def begin(self, life: int, positions: Iterable[tuple[Any, int, Any]]) -> None:
        """`life`: the store's. `positions`: arrival, sector and size of each payload, as `read_positions` found them.
        The file belongs to this store, whatever its head says. `OSError`; ValueError: they cannot be."""
        self._life = life
        used = []
        for arrival, sector, size in positions:
            if type(size) is not int or size < 1:
                raise ValueError(f"row {arrival} has a payload of {size!r} bytes")
            used.append((sector, sectors_of(size)))
        end = sectors_of(self.size)
        self._extents = Extents(used, 1, end)
        # The log can be as old as a power cut has left it. Rows are always right, and of two partials the later one.
        found = self._partials.open(life)
        usable: dict[PartialKey, Partial] = {}
        used.sort()
        for key, partial in reversed(found.items()):
            extent = partial.sector, sectors_of(key.size)
            if partial.sector < 1 or not lies_beside(key.size) or not _is_free(used, *extent):
                continue
            runs = tuple([run for run in partial.runs if len(self._piece(key, partial, run))])
            if runs:
                usable[key] = partial._replace(runs=runs)
                used.insert(bisect_left(used, extent), extent)
                end = max(end, sum(extent))
        if found:
            self._partials.find(
                dict(reversed(usable.items())), [one for key, one in found.items() if key not in usable]
            )
            self._extents = Extents(used, 1, end)
        if self._file is not None and self.life != life:
            self._file.write(0, head_of(life))
            self._file.sync()

    @property
    def empty(self) -> bool:
        """Whether it holds nothing."""
        return not self._extents.used

    def write(self, data: Iterable[Datum], apart: Iterable[Datum]) -> None:
        """Make the large payloads of data and of second contents durable, all with one sync.

        `OSError`. A payload keeps its position until a commit succeeds: nobody knows
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
        # Of what was written before a sync that failed, nobody knows whether it is on the medium: all of it once more.
        missing = {key: [(0, key.size)] for key in large}
        new = [key for key in large if key not in self._positions]
        taken: list[Partial] = []
        for key in new:
            if (partial := self._partials.take(PartialKey(key.id, key.crc, key.size))) is not None:
                taken.append(partial)
                self._positions[key] = partial.sector
                # Pieces of another content came under this checksum, perhaps.
                runs = [run for run in partial.runs if crc32(_part(large[key], run)) == run.crc]
                missing[key] = Partial(partial.sector, tuple(runs)).gaps(0, key.size)
            else:
                self._positions[key] = self._extents.take(sectors_of(key.size))
        try:
            for key, payload in large.items():
                at = self._positions[key] * SECTOR_BYTES
                for start, stop in missing[key]:
                    file.write(at + start, payload[start:stop])
            try:
                file.sync()
            except OSError:
                # No later sync makes up for it.
                self.give_way()
                raise
        except BaseException:
            for key in new:
                self._extents.give_back(self._positions.pop(key), sectors_of(key.size))
            self._partials.end(taken)
            raise
        self._taken += taken

    def position(self, datum: Datum, *, apart: bool = False) -> int | None:
        """The first sector of a payload that was written since the last commit; None: it goes into its row."""
        return self._positions.get(_Key(apart, datum.id, datum.crc, len(datum.payload)))

    def settle(self, written: Collection[int], gone: Iterable[tuple[int, int]]) -> None:
        """A commit has succeeded. It refers to the new payloads `written`, by sector, and no longer to those `gone`, by
        sector and size."""
        for sector, size in gone:
            self._extents.release(sector, sectors_of(size))
        for key, sector in self._positions.items():
            if sector not in written:
                self._extents.release(sector, sectors_of(key.size))
        self._positions.clear()
        self._partials.end(self._taken)
        self._taken.clear()

    def recycle(self, *, trim_bytes: int = TRIM_BYTES) -> None:
        """The last commit is durable: use again what was released, unless somebody still reads an older state. Cut off
        the end of the file if more than so many bytes of it are free. `OSError`."""
        file, extents = self._file, self._extents
        if file is None or (extents.waiting and file.watched()):
            return
        extents.recycle()
        self.cut_off(trim_bytes)

    def cut_off(self, trim_bytes: int = 0) -> None:
        """Cut off the end of the file if more than so many bytes of it are free. `OSError`."""
        file, extents = self._file, self._extents
        if file is not None and extents.tail * SECTOR_BYTES > trim_bytes:
            # Before the table knows: what could not be cut off is still there.
            end = (extents.end - extents.tail) * SECTOR_BYTES
            if end < file.size:
                file.truncate(end)
            extents.trim()

    # -- what has not come whole ---------------------------------------------------------------------------------------

    def keep(self, runs: Mapping[PartialKey, Iterable[tuple[int, bytes]]], forgotten: Iterable[PartialKey]) -> None:
        """Forget some partials, and write pieces of others, each with its offset, where they stay. No sync: nobody is
        promised anything. One for which there is no space is forgotten."""
        for key in forgotten:
            self._forget(key)
        for key, pieces in runs.items():
            try:
                self._add(key, pieces)
            except OSError:
                self._forget(key)

    def _add(self, key: PartialKey, pieces: Iterable[tuple[int, bytes]]) -> None:
        partial = self._partials.pieces.get(key)
        file = self._file or self._create()
        if partial is None:
            partials = self._partials.pieces
            while partials and (
                len(partials) >= MAX_PARTIALS or key.size + sum(k.size for k in partials) > MOST_PARTIAL_BYTES
            ):
                self._forget(next(iter(partials)))
                partials = self._partials.pieces
            partial = Partial(self._extents.take(sectors_of(key.size)))
            self._partials.keep(key, partial)
        for offset, data in pieces:
            for start, stop in partial.gaps(offset, offset + len(data)):
                if len(partial.runs) == MAX_RUNS:
                    break
                part = data[start - offset : stop - offset]
                file.write(partial.sector * SECTOR_BYTES + start, part)
                partial = partial._replace(runs=(*partial.runs, Run(start, len(part), crc32(part))))
        self._partials.keep(key, partial)

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        """The pieces that are there, each with its offset. On any thread. `OSError`."""
        partial = self._partials.pieces.get(key)
        if partial is None:
            return []
        pieces = [(run.offset, self._piece(key, partial, run)) for run in partial.runs]
        return [(offset, data) for offset, data in pieces if data]

    def _piece(self, key: PartialKey, partial: Partial, run: Run) -> bytes:
        """A piece as it was written; empty: it is not there, or others use its sectors by now."""
        if self._file is None or run.offset + run.size > key.size:
            return b""
        data = self._file.read(partial.sector * SECTOR_BYTES + run.offset, run.size)
        return data if len(data) == run.size and crc32(data) == run.crc else b""

    def _forget(self, key: PartialKey) -> None:
        partial = self._partials.take(key)
        if partial is not None:
            self._partials.end([partial])
            self._extents.give_back(partial.sector, sectors_of(key.size))

    def give_way(self) -> bool:
        """Forget all partials: others can use their sectors. Returns whether there were some."""
        keys = list(self._partials.pieces)
        for key in keys:
            self._forget(key)
        return bool(keys)

    def close(self) -> None:
        """Release the files."""
        super().close()
        self._partials.close()

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


def _is_free(used: list[tuple[int, int]], sector: int, count: int) -> bool:
    """Whether a range of sectors overlaps none of those `used`, which are sorted."""
    index = bisect_left(used, (sector, 0))
    return (index == 0 or sum(used[index - 1]) <= sector) and (index == len(used) or used[index][0] >= sector + count)


def _part(payload: bytes, run: Run) -> bytes:
    return payload[run.offset : run.offset + run.size]


class _Key(NamedTuple):
    apart: int
    id: DatumId
    crc: int
    size: int
