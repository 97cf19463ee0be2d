"""The marks of data in a summary: a few bits stand for each datum, packed as they travel.

A summary of n data has marks below n << bits, one for each datum. The mark of a datum that is not in the summary is one
of them by accident with a probability of at most 1 / 2^bits. Base, life and serial of the summary go into the marks, so
such accidents are independent from one summary to the next.

The marks are packed as a Rice code: in ascending order, each as the difference to the one before it. Its high part is
so many ones and a zero, followed by its low `bits` bits. That takes at most bits + 2 bits a datum.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from zlib import crc32

from rass_mav.core.datum import DatumId

#: Bits of a mark beyond what the number of data requires: the fewest and the most.
MIN_BITS, MAX_BITS = 8, 16
#: Bytes of packed marks at most.
MARK_BYTES = 89
#: So many data always fit.
MAX_MARKS = 8 * MARK_BYTES // (MIN_BITS + 2)

_pack_id = struct.Struct("<HII").pack


def marks_of(ids: Iterable[DatumId], base: int, life: int, serial: int, size: int) -> list[int]:
    """The mark of each of these data in a summary, 0 .. size - 1. `size`: the number of data in the summary << bits."""
    salt = crc32(_pack_id(base, life, serial))
    marks = []
    for id in ids:
        # The middle of the square of a CRC. Not the CRC itself: it is linear, so two data that collide in one summary
        # would collide in all.
        x = crc32(_pack_id(*id), salt)
        marks.append((x * x >> 16 & 0xFFFFFFFF) * size >> 32)
    return marks


def bits_for(count: int) -> int:
    """How many bits the marks of so many data have, 1 .. `MAX_MARKS`: as many as always fit."""
    return min(MAX_BITS, 8 * MARK_BYTES // count - 2)


def pack_marks(marks: Sequence[int], bits: int) -> bytes:
    """Marks in ascending order, as they travel."""
    low = (1 << bits) - 1
    packed = at = last = 0
    for mark in marks:
        gap = mark - last
        last = mark
        ones = gap >> bits
        packed |= ((1 << ones) - 1 | (gap & low) << ones + 1) << at
        at += ones + 1 + bits
    return packed.to_bytes(at + 7 >> 3, "little")


def unpack_marks(packed: bytes, count: int, bits: int) -> tuple[int, ...]:
    """So many marks. ValueError: it is not what `pack_marks` returns for them."""
    left, room = int.from_bytes(packed, "little"), 8 * len(packed)
    low, last = (1 << bits) - 1, 0
    marks = []
    for _ in range(count):
        ones = (~left & left + 1).bit_length() - 1
        left >>= ones + 1
        last += ones << bits | left & low
        left >>= bits
        room -= ones + 1 + bits
        if room < 0:
            raise ValueError("marks are missing")
        marks.append(last)
    if left or room > 7 or last >= count << bits:
        raise ValueError("more than the marks")
    return tuple(marks)
