"""How plain messages are written and read. From `table.py`, by tools/wire.py: do not edit."""

from collections.abc import Callable
from struct import Struct
from zlib import crc32

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import (
    BROADCAST,
    Accept,
    Beacon,
    Chunk,
    Committed,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    DeletionReport,
    Message,
    Offer,
    PassedOn,
    Put,
    Query,
    Receipt,
    Report,
    Sack,
    SequenceMark,
    Summary,
)
from rass_mav.errors import MalformedError

from .parts import (
    OLDEST,
    Tags,
    age,
    bitmap_bytes,
    fitting,
    frames,
    read_bitmap,
    read_receipt_entry,
    receipt_entry_bytes,
    tagged_frames,
)

VERSION, MORE = 3, 15

BEACON = 1
DATA = 2
OFFER = 3
ACCEPT = 4
CHUNK = 5
SACK = 6
COMMITTED = 7
RECEIPT = 8
DELETION_REPORT = 9
PUT = 10
QUERY = 11
PASSED_ON = 12
COPY_STATUSES = 13
SEQUENCE_MARK = 14
SUMMARY = 16
NUMBERS: dict[type, int] = {
    Beacon: BEACON,
    Data: DATA,
    Offer: OFFER,
    Accept: ACCEPT,
    Chunk: CHUNK,
    Sack: SACK,
    Committed: COMMITTED,
    Receipt: RECEIPT,
    DeletionReport: DELETION_REPORT,
    Put: PUT,
    Query: QUERY,
    PassedOn: PASSED_ON,
    CopyStatuses: COPY_STATUSES,
    SequenceMark: SEQUENCE_MARK,
    Summary: SUMMARY,
}
#: Types that begin with a sender, and first bytes of those in which a target follows it.
WITH_SENDER = frozenset((1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13))
TARGETED = frozenset((0x32, 0x33, 0x34, 0x36, 0x37, 0x39, 0x3B, 0x3C, 0x3D))

# Kinds of blocks
ANSWERS = 1
DISTANCE = 2
MOTION = 3
PROOF = 4
TAGS = 5
KEY = 6

BEACON_FIELDS = Struct("<BHIHBHIHBHHHHHIIH")
HANDOVER_FIELDS = Struct("<IHIIIBBIB")
DATA_FIELDS = Struct("<BHHB")
PAIR_FIELDS = Struct("<II")
REFUSED_FIELDS = Struct("<I")
COMMITTED_FIELDS = Struct("<BHHBB")
SUMMARY_FIELDS = Struct("<BBHIIIBBB")
REPORT_FIELDS = Struct("<HHB")
OFFER_FIELDS = Struct("<BHHIHIIIBBIIB")
ACCEPT_FIELDS = Struct("<BHHIHHB")
ACCEPT_FIELDS_2 = Struct("<BHHIHH")
ACCEPT_FIELDS_3 = Struct("<B")
CHUNK_FIELDS = Struct("<BHH")
SACK_FIELDS = Struct("<BHHHHB")
SACK_FIELDS_2 = Struct("<HB")
RECEIPT_FIELDS = Struct("<BHIIIB")
DELETION_REPORT_FIELDS = Struct("<BHHB")
DELETION_ENTRY_FIELDS = Struct("<IHIIBI")
DELETION_ENTRY_FIELDS_2 = Struct("<IHIIBI10s")
PUT_FIELDS = Struct("<BHHHHIIIBBIB")
QUERY_FIELDS = Struct("<BHHB")
DATUM_ID_FIELDS = Struct("<HII")
PASSED_ON_FIELDS = Struct("<BHHB")
COPY_STATUSES_FIELDS = Struct("<BHHB")
COPY_STATUS_ENTRY_FIELDS = Struct("<HIIB")
SEQUENCE_MARK_FIELDS = Struct("<BHIII")
ANSWERS_BLOCK_FIELDS = Struct("<HBB")
DISTANCE_BLOCK_FIELDS = Struct("<HHB")
MOTION_BLOCK_FIELDS = Struct("<Q")
PROOF_BLOCK_FIELDS = Struct("<8s")
TAGS_BLOCK_FIELDS = Struct("<")
KEY_BLOCK_FIELDS = Struct("<8s")
BEACON_CRC = 37


def report_bytes(row: Report) -> bytes:
    """A report as it travels."""
    handle, next_index, bitmap = row
    told = bitmap_bytes(bitmap, 128)
    return REPORT_FIELDS.pack(handle, next_index, len(told)) + told


def read_report(p: bytes, at: int) -> tuple[Report, int]:
    """A report, and where it ends."""
    handle, next_index, size = REPORT_FIELDS.unpack_from(p, at)
    at += REPORT_FIELDS.size
    bitmap = read_bitmap(p, at, size, 128)
    at += size
    return Report(handle, next_index, bitmap), at


def _encode_offer(m: Offer, now: float) -> list[bytes]:
    sender, target, number, id, kind, created, hops, crc, size, chunk_size, at_least = m
    return [
        OFFER_FIELDS.pack(
            0x33, sender, target, number, *id, age(created, now, at_least), hops, kind, crc, size, chunk_size
        )
    ]


def _decode_offer(p: bytes, now: float) -> Offer:
    _, sender, target, number, origin, epoch, sequence, age, hops, kind, crc, size, chunk_size = (
        OFFER_FIELDS.unpack_from(p)
    )
    if size < 1:
        raise MalformedError(f"size is {size}")
    if not 1 <= chunk_size <= 123:
        raise MalformedError(f"chunk_size is {chunk_size}")
    return Offer(
        sender,
        target,
        number,
        DatumId(origin, epoch, sequence),
        kind,
        now - (age & OLDEST) / 1000.0,
        hops,
        crc,
        size,
        chunk_size,
        age >= OLDEST,
    )


def _encode_accept(m: Accept, now: float) -> list[bytes]:
    sender, target, number, handle, next_index, bitmap = m
    told = bitmap_bytes(bitmap, 256)
    return [fitting(ACCEPT_FIELDS.pack(0x34, sender, target, number, handle, next_index, len(told)) + told)]


def _decode_accept(p: bytes, now: float) -> Accept:
    _, sender, target, number, handle, next_index = ACCEPT_FIELDS_2.unpack_from(p)
    if len(p) == 13:
        return Accept(sender, target, number, handle, next_index)
    (size,) = ACCEPT_FIELDS_3.unpack_from(p, 13)
    bitmap = read_bitmap(p, 14, size, 256)
    return Accept(sender, target, number, handle, next_index, bitmap)


def _encode_chunk(m: Chunk, now: float) -> list[bytes]:
    _target, handle, position, poll, data = m
    if position >= 0x8000:
        raise ValueError(f"position is {position}")
    return [fitting(CHUNK_FIELDS.pack(0x35, handle, position | (0x8000 if poll else 0)) + data)]


def _decode_chunk(p: bytes, now: float) -> Chunk:
    _, handle, position = CHUNK_FIELDS.unpack_from(p)
    return Chunk(BROADCAST, handle, position & 0x7FFF, bool(position & 0x8000), p[5:])


def _encode_sack(m: Sack, now: float) -> list[bytes]:
    sender, target, handle, next_index, bitmap, question, others = m
    told = bitmap_bytes(bitmap, 256)
    if len(others) > 3:
        raise ValueError(f"{len(others)} others")
    return [
        fitting(
            SACK_FIELDS.pack(0x36, sender, target, handle, next_index, len(told))
            + told
            + SACK_FIELDS_2.pack(question, len(others))
            + b"".join([report_bytes(row) for row in others])
        )
    ]


def _decode_sack(p: bytes, now: float) -> Sack:
    _, sender, target, handle, next_index, size = SACK_FIELDS.unpack_from(p)
    bitmap = read_bitmap(p, 10, size, 256)
    at = 10 + size
    if len(p) == at:
        return Sack(sender, target, handle, next_index, bitmap)
    question, count = SACK_FIELDS_2.unpack_from(p, at)
    at += SACK_FIELDS_2.size
    if count > 3:
        raise MalformedError(f"{count} others")
    others = []
    for _ in range(count):
        row, at = read_report(p, at)
        others.append(row)
    return Sack(sender, target, handle, next_index, bitmap, question, tuple(others))


def _encode_receipt(m: Receipt, now: float) -> list[bytes]:
    base, base_life, serial, crc, entries = m
    return [
        fitting(
            RECEIPT_FIELDS.pack(0x38, base, base_life, serial, crc, len(entries))
            + b"".join([receipt_entry_bytes(row) for row in entries])
        )
    ]


def _decode_receipt(p: bytes, now: float) -> Receipt:
    _, base, base_life, serial, crc, count = RECEIPT_FIELDS.unpack_from(p)
    at = 16
    entries = []
    for _ in range(count):
        row, at = read_receipt_entry(p, at)
        entries.append(row)
    if crc32(p[15:at], crc32(p[1:11])) != crc:
        raise MalformedError("a Receipt with a wrong checksum")
    return Receipt(base, base_life, serial, crc, tuple(entries))


def _encode_deletion_report(m: DeletionReport, now: float) -> list[bytes]:
    sender, target, entries = m
    proven = any(row.proof for row in entries)
    return frames(
        DELETION_REPORT_FIELDS,
        0x39,
        sender,
        target,
        [
            DELETION_ENTRY_FIELDS_2.pack(number, *id, reason, crc, proof)
            if proven
            else DELETION_ENTRY_FIELDS.pack(number, *id, reason, crc)
            for number, id, reason, crc, proof in entries
        ],
        flag=0x80 if proven else 0,
    )


def _decode_deletion_report(p: bytes, now: float) -> DeletionReport:
    _, sender, target, count = DELETION_REPORT_FIELDS.unpack_from(p)
    if count & 0x80:
        entries = []
        for at in range(6, 6 + (count & 0x7F) * DELETION_ENTRY_FIELDS_2.size, DELETION_ENTRY_FIELDS_2.size):
            number, origin, epoch, sequence, reason, crc, proof = DELETION_ENTRY_FIELDS_2.unpack_from(p, at)
            entries.append(DeletionEntry(number, DatumId(origin, epoch, sequence), reason, crc, proof))
    else:
        entries = []
        for at in range(6, 6 + (count & 0x7F) * DELETION_ENTRY_FIELDS.size, DELETION_ENTRY_FIELDS.size):
            number, origin, epoch, sequence, reason, crc = DELETION_ENTRY_FIELDS.unpack_from(p, at)
            entries.append(DeletionEntry(number, DatumId(origin, epoch, sequence), reason, crc))
    return DeletionReport(sender, target, tuple(entries))


def _encode_put(m: Put, now: float) -> list[bytes]:
    sender, lamport, writer, datum = m
    id, kind, created, hops, crc, payload, at_least = datum
    return [
        fitting(
            PUT_FIELDS.pack(
                0x3A, sender, lamport, writer, *id, age(created, now, at_least), hops, kind, crc, len(payload)
            )
            + payload
        )
    ]


def _decode_put(p: bytes, now: float) -> Put:
    _, sender, lamport, writer, origin, epoch, sequence, age, hops, kind, crc, size = PUT_FIELDS.unpack_from(p)
    payload = p[28 : 28 + size]
    if len(payload) != size or not size:
        raise MalformedError("truncated payload")
    return Put(
        sender,
        lamport,
        writer,
        Datum(DatumId(origin, epoch, sequence), kind, now - (age & OLDEST) / 1000.0, hops, crc, payload, age >= OLDEST),
    )


def _encode_query(m: Query, now: float) -> list[bytes]:
    sender, target, ids = m
    if len(ids) > 12:
        raise ValueError(f"{len(ids)} ids")
    return [
        fitting(QUERY_FIELDS.pack(0x3B, sender, target, len(ids)) + b"".join([DATUM_ID_FIELDS.pack(*id) for id in ids]))
    ]


def _decode_query(p: bytes, now: float) -> Query:
    _, sender, target, count = QUERY_FIELDS.unpack_from(p)
    if count > 12:
        raise MalformedError(f"{count} ids")
    ids = [
        DatumId._make(DATUM_ID_FIELDS.unpack_from(p, at))
        for at in range(6, 6 + count * DATUM_ID_FIELDS.size, DATUM_ID_FIELDS.size)
    ]
    return Query(sender, target, tuple(ids))


def _encode_passed_on(m: PassedOn, now: float, tags: Tags | None = None) -> list[bytes]:
    sender, target, ids, holders = m
    return tagged_frames(
        PASSED_ON_FIELDS, 0x3C, sender, target, [DATUM_ID_FIELDS.pack(*id) for id in ids], tags, holders
    )


def _decode_passed_on(p: bytes, now: float) -> PassedOn:
    _, sender, target, count = PASSED_ON_FIELDS.unpack_from(p)
    ids = [
        DatumId._make(DATUM_ID_FIELDS.unpack_from(p, at))
        for at in range(6, 6 + count * DATUM_ID_FIELDS.size, DATUM_ID_FIELDS.size)
    ]
    return PassedOn(sender, target, tuple(ids), ())


def _encode_copy_statuses(m: CopyStatuses, now: float, tags: Tags | None = None) -> list[bytes]:
    sender, target, entries = m
    return tagged_frames(
        COPY_STATUSES_FIELDS,
        0x3D,
        sender,
        target,
        [COPY_STATUS_ENTRY_FIELDS.pack(*id, status) for id, status in entries],
        tags,
        None,
    )


def _decode_copy_statuses(p: bytes, now: float) -> CopyStatuses:
    _, sender, target, count = COPY_STATUSES_FIELDS.unpack_from(p)
    entries = []
    for at in range(6, 6 + count * COPY_STATUS_ENTRY_FIELDS.size, COPY_STATUS_ENTRY_FIELDS.size):
        origin, epoch, sequence, status = COPY_STATUS_ENTRY_FIELDS.unpack_from(p, at)
        entries.append(CopyStatusEntry(DatumId(origin, epoch, sequence), status))
    return CopyStatuses(sender, target, tuple(entries))


def _encode_sequence_mark(m: SequenceMark, now: float) -> list[bytes]:
    origin, epoch, assigned, crc = m
    return [SEQUENCE_MARK_FIELDS.pack(0x3E, origin, epoch, assigned, crc)]


def _decode_sequence_mark(p: bytes, now: float) -> SequenceMark:
    _, origin, epoch, assigned, crc = SEQUENCE_MARK_FIELDS.unpack_from(p)
    if crc32(p[1:11]) != crc:
        raise MalformedError("a Sequence mark with a wrong checksum")
    return SequenceMark(origin, epoch, assigned, crc)


ENCODERS: dict[type, Callable[..., list[bytes]]] = {
    Offer: _encode_offer,
    Accept: _encode_accept,
    Chunk: _encode_chunk,
    Sack: _encode_sack,
    Receipt: _encode_receipt,
    DeletionReport: _encode_deletion_report,
    Put: _encode_put,
    Query: _encode_query,
    PassedOn: _encode_passed_on,
    CopyStatuses: _encode_copy_statuses,
    SequenceMark: _encode_sequence_mark,
}
WITH_TAGS: frozenset[type] = frozenset(
    (
        PassedOn,
        CopyStatuses,
    )
)
DECODERS: dict[type, Callable[[bytes, float], Message]] = {
    Offer: _decode_offer,
    Accept: _decode_accept,
    Chunk: _decode_chunk,
    Sack: _decode_sack,
    Receipt: _decode_receipt,
    DeletionReport: _decode_deletion_report,
    Put: _decode_put,
    Query: _decode_query,
    PassedOn: _decode_passed_on,
    CopyStatuses: _decode_copy_statuses,
    SequenceMark: _decode_sequence_mark,
}
