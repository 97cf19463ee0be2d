"""The statements of bases as they travel from node to node: entries of receipts, checksums.

A base reports in blocks of 128 numbers. The entry of a block covers what has arrived in it, and extends in both
directions as far as numbers follow each other without a gap. Where nothing is missing, one entry covers everything from
0 on, and a newer entry contains the older ones.

The node that creates a statement computes its checksum, which travels with it: noise on the air and flipped bits in
memory do not spread. It covers the bytes as they travel, so they are packed here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from zlib import crc32

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Receipt, ReceiptEntry, SequenceMark
from rass_mav.core.news.layouts import DELETION_ENTRY, RECEIPT, RECEIPT_ENTRY, SEQUENCE_MARK
from rass_mav.core.news.ranges import Ranges

#: In the last byte before a bitmap: these numbers were reported lost.
TOLD_LOST = 0x80


def entry_bytes(entry: ReceiptEntry) -> bytes:
    """An entry of a receipt as it travels, 9 to 33 bytes."""
    origin, epoch, first, run, bitmap, lost = entry
    size = bitmap.bit_length() + 7 >> 3
    rest = bytearray(RECEIPT_ENTRY.pack(origin, epoch))
    for number in (first, run):
        while number > 0x7F:
            rest.append(number & 0x7F | 0x80)
            number >>= 7
        rest.append(number)
    rest.append(size | TOLD_LOST if lost else size)
    return bytes(rest) + bitmap.to_bytes(size, "little")


def receipt_crc(base: int, life: int, serial: int, entries: Iterable[ReceiptEntry]) -> int:
    """CRC-32 of a statement: `<HIIB` base, its life, serial, count, and the entries."""
    packed = [entry_bytes(entry) for entry in entries]
    return crc32(b"".join(packed), crc32(RECEIPT.pack(base, life, serial, len(packed))))


def sequence_mark_crc(origin: int, epoch: int, assigned: int) -> int:
    """CRC-32 of an origin's report about its numbers, `<HII`."""
    return crc32(SEQUENCE_MARK.pack(origin, epoch, assigned))


def note_crc(id: DatumId, reason: int) -> int:
    """CRC-32 of a deletion report, `<HIIB`."""
    return crc32(DELETION_ENTRY.pack(*id, reason))


def is_sound_note(id: DatumId, reason: int, crc: int) -> bool:
    """Whether a deletion report is unchanged since its origin created it."""
    try:
        return note_crc(id, reason) == crc
    except struct.error:
        # A flipped bit has made a number longer than any that travels.
        return False


def make_receipt(base: int, life: int, serial: int, entries: Iterable[ReceiptEntry]) -> Receipt:
    """A statement with its checksum."""
    entries = tuple(entries)
    return Receipt(base, life, serial, receipt_crc(base, life, serial, entries), entries)


def make_sequence_mark(origin: int, epoch: int, assigned: int) -> SequenceMark:
    """An origin's report with its checksum."""
    return SequenceMark(origin, epoch, assigned, sequence_mark_crc(origin, epoch, assigned))


#: Numbers in a block, and bits in a bitmap at most.
RECEIPT_BITS = 128


def blocks(ranges: Ranges) -> Iterator[int]:
    """Blocks whose entries together cover everything."""
    last = -1
    for first, end in ranges:
        for block in (first // RECEIPT_BITS, (end - 1) // RECEIPT_BITS):
            if block > last:
                last = block
                yield block


def entry_of(origin: int, epoch: int, ranges: Ranges, block: int, *, lost: bool) -> ReceiptEntry | None:
    """The entry of a block of an origin and epoch; None: there is nothing in it."""
    ahead = ranges.behind(block * RECEIPT_BITS)
    first, end = next(ahead, (0, 0))
    if first >= (block + 1) * RECEIPT_BITS or not end:
        return None
    # To the end of the block in which the run ends.
    limit = -(-end // RECEIPT_BITS) * RECEIPT_BITS
    bitmap = 0
    for start, stop in ahead:
        if start >= limit:
            break
        bitmap |= ((1 << (min(stop, limit) - start)) - 1) << (start - end)
    return ReceiptEntry(origin, epoch, first, end - first, bitmap, lost)


def ranges_of(entry: ReceiptEntry) -> list[tuple[int, int]]:
    """The numbers that an entry covers, as (first, last + 1)."""
    _, _, first, run, bitmap, _ = entry
    end = first + run
    ranges = [(first, end)]
    while bitmap:
        skip = (bitmap & -bitmap).bit_length() - 1
        bitmap >>= skip
        length = (~bitmap & (bitmap + 1)).bit_length() - 1
        bitmap >>= length
        ranges.append((end + skip, end + skip + length))
        end += skip + length
    return ranges


def last_of(entry: ReceiptEntry) -> int:
    """The highest number that an entry covers."""
    return entry.first + entry.run + entry.bitmap.bit_length() - 1


def covers(a: ReceiptEntry, b: ReceiptEntry) -> bool:
    """Whether an entry covers all numbers that another one of the same kind, origin and epoch covers."""
    _, _, first_a, run_a, bits_a, _ = a
    _, _, first_b, run_b, bits_b, _ = b
    if first_b < first_a:
        return False
    ahead = first_b + run_b - first_a - run_a
    if ahead <= 0:
        # The run of b is within that of a.
        return not bits_b >> -ahead & ~bits_a
    if not bits_a or ahead > RECEIPT_BITS:
        return False
    inside = max(0, first_b - first_a - run_a)
    return not ((bits_b << ahead) | ((1 << ahead) - (1 << inside))) & ~bits_a
