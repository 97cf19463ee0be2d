"""The checksums of messages that are relayed from node to node: noise on the air and flipped bits in memory do not
spread.

The node that creates a statement computes its checksum, which travels with it. Entries are packed here as they travel,
because the checksum covers their bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from zlib import crc32

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Receipt, ReceiptEntry, SequenceMark, Summary
from rass_mav.core.news.layouts import DELETION_ENTRY, RECEIPT, RECEIPT_ENTRY, SEQUENCE_MARK, SUMMARY
from rass_mav.core.news.marks import pack_marks

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


def is_sound(receipt: Receipt) -> bool:
    """Whether a statement is unchanged since its base created it."""
    base, life, serial, crc, entries = receipt
    try:
        return receipt_crc(base, life, serial, entries) == crc
    except (struct.error, OverflowError, ValueError):
        # A flipped bit has made a number longer than any that travels.
        return False


def summary_crc(base: int, life: int, serial: int, bits: int, count: int, packed: bytes) -> int:
    """CRC-32 of a summary: `<HIIBBB` base, its life, serial, count, bits, bytes of packed marks, and these."""
    return crc32(packed, crc32(SUMMARY.pack(base, life, serial, count, bits, len(packed))))


def is_sound_summary(summary: Summary) -> bool:
    """Whether a summary is unchanged since its base created it."""
    base, life, serial, crc, bits, marks = summary
    try:
        return summary_crc(base, life, serial, bits, len(marks), pack_marks(marks, bits)) == crc
    except (struct.error, OverflowError, ValueError):
        # As above.
        return False


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
        # As above.
        return False


def make_receipt(base: int, life: int, serial: int, entries: Iterable[ReceiptEntry]) -> Receipt:
    """A statement with its checksum."""
    entries = tuple(entries)
    return Receipt(base, life, serial, receipt_crc(base, life, serial, entries), entries)


def make_summary(base: int, life: int, serial: int, bits: int, marks: Iterable[int]) -> Summary:
    """A summary with its checksum."""
    marks = tuple(sorted(marks))
    crc = summary_crc(base, life, serial, bits, len(marks), pack_marks(marks, bits))
    return Summary(base, life, serial, crc, bits, marks)


def make_sequence_mark(origin: int, epoch: int, assigned: int) -> SequenceMark:
    """An origin's report with its checksum."""
    return SequenceMark(origin, epoch, assigned, sequence_mark_crc(origin, epoch, assigned))
