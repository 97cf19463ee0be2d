"""Which bytes of payloads that have not come whole are in the file beside the database: a table, and its log.

The bytes lie where they stay: when the rest has come, only that is written. No sync makes bytes or log durable. Each
piece has a CRC-32 of its own, so that whatever a power cut leaves behind is recognised.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from rass_mav.core.datum import DatumId
from rass_mav.core.store import PartialKey

from .disk import BlockFile, Disk
from .files import PARTIALS, beside

#: Pieces of one payload, at most. What comes in more of them is not kept.
MAX_RUNS = 1024
#: The log is written anew when it has grown to this size, bytes: more than what is kept can take.
MAX_LOG_BYTES = 256 << 10

_MAGIC = b"RASSPART"
_HEAD = struct.Struct("<8sI")
_BEGIN, _RUN, _END = 1, 2, 3
#: Kind, first sector, and: id, CRC and size of the datum; offset, size and CRC of the piece; nothing.
_RECORDS = {_BEGIN: struct.Struct("<BIHIIII"), _RUN: struct.Struct("<BIIII"), _END: struct.Struct("<BI")}
_CHECK = struct.Struct("<I")


class Run(NamedTuple):
    """Bytes of a payload that are in the file."""

    offset: int
    """In the payload."""
    size: int
    crc: int
    """CRC-32 of these bytes."""


class Partial(NamedTuple):
    """A payload that has not come whole."""

    sector: int
    """The first of those that it will need."""
    runs: tuple[Run, ...] = ()

    def gaps(self, start: int, stop: int) -> list[tuple[int, int]]:
        """What of a range of the payload is in no run."""
        found = []
        for offset, size, _ in sorted([run for run in self.runs if run[0] < stop and run[0] + run[1] > start]):
            if offset > start:
                found.append((start, offset))
            start = max(start, offset + size)
        return [*found, (start, stop)] if start < stop else found


class PartialTable:
    """What is kept, by content; what grew last is last. The log follows it as far as the disk allows."""

    def __init__(self, path: Path, disk: Disk) -> None:
        """`path`: of the database."""
        self._path = beside(path, PARTIALS)
        self._disk = disk
        self._file: BlockFile | None = None
        self._life = 0
        self._end = 0
        self._check = 0
        """The check value of the last record. The next one includes it: what an earlier, longer log has left behind
        the end does not count."""
        self.pieces: Mapping[PartialKey, Partial] = {}
        """Never changed, but replaced: any thread may read it."""

    def open(self, life: int) -> dict[PartialKey, Partial]:
        """What the log of the store with this life says; `keep` then says what of it is true. `OSError`."""
        self._life = life
        if not self._path.exists():
            return {}
        self._file = self._disk.open_file(self._path, writable=True)
        content = self._file.read(0, self._file.size)
        head = self._head()
        if not content.startswith(head):
            return {}
        self._end, self._check = len(head), crc32(head)
        partials: dict[int, tuple[PartialKey, Partial]] = {}
        while (record := self._next(content)) is not None:
            kind, sector, *rest = record
            if kind == _BEGIN:
                origin, epoch, sequence, crc, size = rest
                partials[sector] = PartialKey(DatumId(origin, epoch, sequence), crc, size), Partial(sector)
            elif sector in partials:
                key, partial = partials.pop(sector)
                if kind == _RUN:
                    partials[sector] = key, Partial(sector, (*partial.runs, Run(*rest)))
        return dict(partials.values())

    def _head(self) -> bytes:
        head = _HEAD.pack(_MAGIC, self._life)
        return head + _CHECK.pack(crc32(head))

    def _next(self, content: bytes) -> tuple[int, ...] | None:
        """The next record; None: there is no further one, or it is not sound."""
        shape = _RECORDS.get(content[self._end]) if self._end < len(content) else None
        if shape is None:
            return None
        at = self._end + shape.size
        check = crc32(content[self._end : at], self._check)
        if content[at : at + _CHECK.size] != _CHECK.pack(check):
            return None
        record: tuple[int, ...] = shape.unpack_from(content, self._end)
        self._end, self._check = at + _CHECK.size, check
        return record

    def keep(self, key: PartialKey, partial: Partial) -> None:
        """Keep a payload, or more of it than before."""
        before = self.pieces.get(key)
        new = _all(key, partial) if before is None else _runs(partial, len(before.runs))
        self.pieces = {**{other: pieces for other, pieces in self.pieces.items() if other != key}, key: partial}
        self._log(new)

    def find(self, found: Mapping[PartialKey, Partial], gone: Iterable[Partial]) -> None:
        """After `open`: this is what is true of it, and what is not."""
        self.pieces = dict(found)
        self._log([(_END, partial.sector) for partial in gone])

    def take(self, key: PartialKey) -> Partial | None:
        """Keep it no longer, but leave it in the log until `end`; None: it is not kept."""
        partial = self.pieces.get(key)
        self.pieces = {other: pieces for other, pieces in self.pieces.items() if other != key}
        return partial

    def end(self, partials: Iterable[Partial]) -> None:
        """Others may use their sectors from now on."""
        self._log([(_END, partial.sector) for partial in partials])

    def _log(self, records: Iterable[tuple[int, ...]]) -> None:
        # Without the log a payload comes from its beginning after a restart: no reason to fail.
        with suppress(OSError):
            records = list(records)
            if not records:
                return
            if self._file is None:
                self._file = self._disk.open_file(self._path, writable=True)
            if not self.pieces or self._end > MAX_LOG_BYTES:
                self._file.truncate(0)
                self._end = 0
                records = [record for key, partial in self.pieces.items() for record in _all(key, partial)]
            if records:
                self._append(self._file, records)

    def _append(self, file: BlockFile, records: Iterable[tuple[int, ...]]) -> None:
        head = b"" if self._end else self._head()
        packed_records, check = [head], crc32(head) if head else self._check
        for record in records:
            packed = _RECORDS[record[0]].pack(*record)
            check = crc32(packed, check)
            packed_records += [packed, _CHECK.pack(check)]
        content = b"".join(packed_records)
        file.write(self._end, content)
        self._end, self._check = self._end + len(content), check

    def close(self) -> None:
        """Release the log."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _all(key: PartialKey, partial: Partial) -> list[tuple[int, ...]]:
    return [(_BEGIN, partial.sector, *key.id, key.crc, key.size), *_runs(partial)]


def _runs(partial: Partial, after: int = 0) -> list[tuple[int, ...]]:
    return [(_RUN, partial.sector, *run) for run in partial.runs[after:]]
