"""Rows on the pages of a SQLite database, read without SQLite (sqlite.org/fileformat2.html, sections 1.6 and 2.1).

For a database that SQLite refuses: one page that is beyond repair must not take the others with it. What is read here
may be anything. So only its checksum makes it a row, which `found_in` checks.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rass_mav.core.datum import Datum, DatumId, Fate

from .payloads import Payloads
from .schema import sound_loss

TABLE_LEAF = 0x0D
_INDEX_LEAF = 0x0A
_INDEX_INTERIOR = 0x02
#: Longer records cannot be ours, bytes.
_MAX_RECORD = (1 << 20) + 4096
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


class FoundLoss(NamedTuple):
    """A row of the table of losses."""

    id: DatumId
    fate: Fate
    proof: bytes


class FoundNumber(NamedTuple):
    """A row of `meta` or `counter`."""

    name: bytes
    value: int


def rows_on(page: bytes, number: int, fetch: Callable[[int], bytes | None]) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """The rows of one page: rowid (0 in a table without) and columns, texts as bytes. Rows that do not parse are left
    out.

    `number`: of the page, from 1. `fetch`: returns the page with a number, for rows that do not fit one.
    """
    start = 100 if number == 1 else 0
    kind = page[start]
    if kind not in (TABLE_LEAF, _INDEX_LEAF, _INDEX_INTERIOR):
        return
    pointers = start + (12 if kind == _INDEX_INTERIOR else 8)
    count = min(int.from_bytes(page[start + 3 : start + 5], "big"), (len(page) - pointers) // 2)
    for pointer in range(pointers, pointers + 2 * count, 2):
        try:
            at = int.from_bytes(page[pointer : pointer + 2], "big") + (4 if kind == _INDEX_INTERIOR else 0)
            size, at = _varint(page, at)
            rowid = 0
            if kind == TABLE_LEAF:
                rowid, at = _varint(page, at)
            record = _payload(page, at, size, kind == TABLE_LEAF, fetch)
            yield rowid, _columns(record)
        except (IndexError, ValueError, struct.error):
            continue


def free_pages(first: bytes, fetch: Callable[[int], bytes | None]) -> set[int] | None:
    """The numbers of the unused pages; None: they cannot be determined. `first`: page 1."""
    trunk, count = struct.unpack_from(">II", first, 32)
    free: set[int] = set()
    while trunk:
        page = fetch(trunk)
        if page is None or trunk in free:
            return None
        free.add(trunk)
        following, leaves = struct.unpack_from(">II", page, 0)
        if leaves > len(page) // 4 - 2:
            return None
        free.update(struct.unpack_from(f">{leaves}I", page, 8))
        trunk = following
    return free if len(free) == count else None


def found_in(columns: tuple[Any, ...], payloads: Payloads) -> Datum | FoundLoss | FoundNumber | None:
    """What a row says; None: it is not ours, or not sound. `OSError`."""
    if len(columns) in (10, 11):
        return _datum(columns, payloads)
    if len(columns) == 5 and (loss := sound_loss(columns[:3], columns[3], columns[4])) is not None:
        return FoundLoss(DatumId(*columns[:3]), *loss)
    if len(columns) == 3:
        name, value, inverse = columns
        if type(name) is bytes and type(value) is int and inverse == ~value:
            return FoundNumber(name, value)
    return None


def _datum(columns: tuple[Any, ...], payloads: Payloads) -> Datum | None:
    # The first version had no at_least.
    _, origin, epoch, sequence, kind, created, hops, crc, size, *at_least, payload = columns
    if type(payload) is int and type(size) is int:
        payload = payloads.read(payload, size)
    numbers = (origin, epoch, sequence, kind, hops, crc, size, *at_least)
    if any(type(number) is not int or number < 0 for number in numbers) or type(payload) is not bytes:
        return None
    # SQLite stores a real number without a fraction as an integer, and has NULL for what is no number.
    if type(created) not in (float, int) or math.isnan(created) or len(payload) != size:
        return None
    if (
        max(epoch, sequence, crc) >= 1 << 32
        or origin >= 1 << 16
        or max(kind, hops) > 255
        or max(at_least, default=0) > 1
    ):
        return None
    datum = Datum(DatumId(origin, epoch, sequence), kind, float(created), hops, crc, payload, bool(*at_least))
    return datum if datum.intact else None


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for end in range(at, at + 8):
        value = value << 7 | data[end] & 0x7F
        if data[end] < 0x80:
            return value, end + 1
    value = value << 8 | data[at + 8]
    return value - (1 << 64) if value >> 63 else value, at + 9


def _payload(page: bytes, at: int, size: int, table: bool, fetch: Callable[[int], bytes | None]) -> bytes:
    usable = len(page)
    if not 0 < size <= _MAX_RECORD:
        raise ValueError
    most = usable - 35 if table else (usable - 12) * 64 // 255 - 23
    if size <= most:
        if at + size > usable:
            raise ValueError
        return page[at : at + size]
    least = (usable - 12) * 32 // 255 - 23
    local = least + (size - least) % (usable - 4)
    if local > most:
        local = least
    parts = [page[at : at + local]]
    left = size - local
    following = int.from_bytes(page[at + local : at + local + 4], "big")
    while left > 0:
        more = fetch(following)
        if more is None:
            raise ValueError
        parts.append(more[4 : 4 + left])
        left -= len(parts[-1])
        following = int.from_bytes(more[:4], "big")
    return b"".join(parts)


def _columns(record: bytes) -> tuple[Any, ...]:
    end, at = _varint(record, 0)
    kinds = []
    while at < end:
        kind, at = _varint(record, at)
        kinds.append(kind)
    if at != end or len(kinds) > 16:
        raise ValueError
    columns: list[Any] = []
    for kind in kinds:
        size = _INTEGERS.get(kind, 0)
        if kind == 7:
            size = 8
            columns.append(struct.unpack_from(">d", record, at)[0])
        elif size:
            columns.append(int.from_bytes(record[at : at + size], "big", signed=True))
        elif kind in (8, 9):
            columns.append(kind - 8)
        elif kind >= 12:
            size = (kind - 12) // 2
            columns.append(record[at : at + size])
        elif kind == 0:
            columns.append(None)
        else:
            raise ValueError
        at += size
        if at > len(record):
            raise ValueError
    return tuple(columns)
