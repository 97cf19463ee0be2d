"""Encoding and decoding of TUNNEL payloads (docs/protocol.md). Little-endian, version in the first four bits.

Fields appended at the end are ignored. Another major version or an unknown type raises `ForeignError`, so that it can
be counted separately from garbage. Times travel as ages.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple, Protocol
from zlib import crc32

from rass_mav.core.content_hashes import CRC_MASK
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import (
    BROADCAST,
    KINDS,
    MAX_OTHERS,
    NOTE_PROOF_BYTES,
    OTHER_BITS,
    QUERY_IDS,
    REPORT_BITS,
    Accept,
    Beacon,
    Chunk,
    Committed,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    DeletionReport,
    Distance,
    Handover,
    Message,
    Offer,
    PassedOn,
    Put,
    Query,
    Receipt,
    ReceiptEntry,
    Report,
    Sack,
    SequenceMark,
    Summary,
    Target,
)
from rass_mav.core.news.checksums import TOLD_LOST, entry_bytes, receipt_crc, sequence_mark_crc, summary_crc
from rass_mav.core.news.marks import MARK_BYTES, MAX_BITS, MIN_BITS, pack_marks, unpack_marks
from rass_mav.core.news.statements import RECEIPT_BITS
from rass_mav.errors import MalformedError

#: Bytes of a TUNNEL payload.
MAX_TUNNEL = 128
#: Major version of the format, the high four bits of the first byte.
VERSION = 3

BEACON, DATA, OFFER, ACCEPT, CHUNK, SACK, COMMITTED, RECEIPT, DELETION_REPORT, PUT, QUERY, PASSED_ON, COPY_STATUSES = (
    range(1, 14)
)
SEQUENCE_MARK = 14
#: After a head of this type, the second byte is the type, from 16 on.
MORE = 15
SUMMARY = 16

# A beacon without its checksum, which is at `_SEAL` and covers all bytes before and after it.
_BEACON = struct.Struct("<BHIHBHIHBHHHHHIIH")
_BEACON_FIELDS = struct.Struct(_BEACON.format.replace("B", "x", 1))
_SEAL = 37
# What may follow the fields of a beacon, or the hand-overs of data: its kind and its size in bytes. Unknown kinds are
# ignored.
_BLOCK = struct.Struct("<BB")
#: The block with answers to hand-overs.
ANSWERS = 1
#: The block of distant replicas.
DISTANCE = 2
#: The block of a beacon with the sender's motion.
MOTION = 3
#: The block with the tags of the answers in the frame, in the same order.
TAGS = 5
_MOVES = struct.Struct("<Q")
#: The block of a beacon with the element of its route in the base's hash chain.
PROOF = 4
#: Its bytes.
PROOF_BYTES = 8
#: The block of a beacon with the sender's key for it.
KEY = 6
#: Its bytes.
KEY_BYTES = 8
_TO = struct.Struct("<BHHB")
_DATUM = struct.Struct("<IHIIIBBIB")
_DISTANCE = struct.Struct("<HHB")
_OFFER = struct.Struct("<BHHIHIIIBBIIB")
_ACCEPT = struct.Struct("<BHHIHH")
_CHUNK = struct.Struct("<BHH")
_SACK = struct.Struct("<BHHHHB")
# After the bitmap of a Sack: the question that it answers, and how many further transfers follow.
_FURTHER = struct.Struct("<HB")
_REPORT = struct.Struct("<HHB")
_SENDER = struct.Struct("<BH")
# An answer without its sender, which is known where it rides on another message.
_RIDER = struct.Struct("<HBB")
_DONE = struct.Struct("<II")
_NUMBER = struct.Struct("<I")
_RECEIPT = struct.Struct("<BHIIIB")
_PAIR = struct.Struct("<HI")
_NOTE = struct.Struct("<IHIIBI")
#: Bit of the number of notes: each has its proof.
_PROVEN = 0x80
_PROVEN_NOTE = struct.Struct(f"{_NOTE.format}{NOTE_PROOF_BYTES}s")
_SEQUENCE_MARK = struct.Struct("<BHIII")
_SUMMARY = struct.Struct("<BBHIIIBBB")
_PUT = struct.Struct("<BHHHHIIIBBIB")
_ID = struct.Struct("<HII")
_COPY_STATUS = struct.Struct("<HIIB")

#: Largest payload of a datum that goes whole in one frame.
INLINE_BYTES = MAX_TUNNEL - _TO.size - _DATUM.size
#: Largest payload of a chunk.
CHUNK_BYTES = MAX_TUNNEL - _CHUNK.size
#: Largest summary.
SUMMARY_BYTES = _SUMMARY.size + MARK_BYTES

_POLL = 0x8000
_REPLICA = 0x80
# In an age: the datum is at least this old. And the largest age, which means the same.
_AT_LEAST = 0x80000000
_OLDEST = 0x7FFFFFFF
# Bytes that stay free after answers that end custody or are about copies, for a message authentication code: a tag
# behind the head of its block, or behind the place of the word among all words of its sender.
_MAC = 12
#: Bytes of a tag.
TAG_BYTES = 8
#: Bytes of a word's place, before its tag.
PLACE_BYTES = 4
#: Holders that one frame is for. Each has a tag of its own, behind its node id.
MOST_HOLDERS = 4
_HOLDER = struct.Struct(f"<H{TAG_BYTES}s")
_STRONG_BYTES = 16
# The types in which, in every version, the node id of the sender follows the head.
_WITH_SENDER = frozenset(
    (BEACON, DATA, OFFER, ACCEPT, SACK, COMMITTED, DELETION_REPORT, PUT, QUERY, PASSED_ON, COPY_STATUSES)
)


class ForeignError(MalformedError):
    """Another major version, or a message type of a later one: not garbage, but not for us."""

    def __init__(self, text: str, version: int, sender: int | None = None) -> None:
        super().__init__(text)
        self.version = version
        """Major version of the message, 0..15."""
        self.sender = sender
        """Node id of the sender of a message of another version; None: the message has none."""


class Tags(Protocol):
    """Shows the receivers who says what ends custody or is about copies: for nodes with keys."""

    def of_answer(self, to: int, said: bytes) -> bytes:
        """The tag of an answer, `TAG_BYTES`. `said`: `answer_said`."""

    def of_word(self, type_: int, to: Sequence[int], said: bytes) -> tuple[int, list[bytes]]:
        """The place of a message of this type, and its tag for each receiver. `said`: the message so far."""


def _head(type_: int) -> int:
    return VERSION << 4 | type_


def _age(created: float, now: float, at_least: bool) -> int:
    """Milliseconds, and the bit for "at least this old". A reader takes that from `_OLDEST` too, with or without it."""
    age = int((now - created) * 1000.0 + 0.5)
    if age >= _OLDEST:
        return _AT_LEAST | _OLDEST
    return max(age, 0) | (_AT_LEAST if at_least else 0)


# -- encoding ----------------------------------------------------------------------------------------------------------


def encode(message: Message, now: float, tags: Tags | None = None) -> list[bytes]:
    """The TUNNEL payloads of a message: usually one; data and answers that do not fit one frame fill several.

    `now`: seconds on the sender's timeline, for ages. `tags`: None: the node has no keys. ValueError or struct.error: a
    message that exceeds its bounds, which is our bug.
    """
    encoder = _ENCODERS[type(message)]
    return encoder(message, now) if tags is None or encoder not in _WITH_TAGS else encoder(message, now, tags)


def answer_said(m: Committed) -> bytes:
    """What the tag of an answer covers: its bytes without the sender, and then all of each content hash but the
    checksum in them."""
    strong = [(content_hash >> 32).to_bytes(_STRONG_BYTES, "little") for _, content_hash in m.committed]
    return _answer_bytes(m) + b"".join(strong)


#: First byte of all messages whose type is in the second one.
MORE_HEAD = bytes([_head(MORE)])
_BEACON_HEAD = _head(BEACON)
_OVERHEARD = frozenset(bytes([_head(number)]) for number in (DATA, OFFER, ACCEPT))


def _encode_beacon(m: Beacon, now: float, tags: Tags | None = None) -> list[bytes]:
    rest = _BEACON.pack(_BEACON_HEAD, *m[:-4])
    if m.moves:
        rest += _BLOCK.pack(MOTION, _MOVES.size) + _MOVES.pack(m.moves)
    if m.proof:
        rest += _BLOCK.pack(PROOF, PROOF_BYTES) + m.proof
    if m.key:
        rest += _BLOCK.pack(KEY, KEY_BYTES) + m.key
    if m.answers:
        rest += _encode_answers(m.answers, MAX_TUNNEL - len(rest) - _NUMBER.size, tags)[0]
    return [rest[:_SEAL] + _NUMBER.pack(crc32(rest)) + rest[_SEAL:]]


def _encode_data(m: Data, now: float, tags: Tags | None = None) -> list[bytes]:
    frames = []
    parts: list[bytes] = []
    tail = _BLOCK.pack(DISTANCE, _DISTANCE.size) + _DISTANCE.pack(*m.distance) if m.replica and m.distance else b""
    most = room = MAX_TUNNEL - _TO.size - len(tail)
    flag = _REPLICA if m.replica else 0
    for number, (id, kind, created, hops, crc, payload, at_least) in m.handovers:
        size = _DATUM.size + len(payload)
        if size > room:
            if size > most:
                raise ValueError(f"a datum of {len(payload)} bytes does not fit one frame")
            head = _TO.pack(_head(DATA), m.sender, m.target, flag | len(parts) // 2)
            frames.append(head + b"".join(parts) + tail)
            parts = []
            room = most
        parts.append(_DATUM.pack(number, *id, _age(created, now, at_least), hops, kind, crc, len(payload)))
        parts.append(payload)
        room -= size
    frames.append(_TO.pack(_head(DATA), m.sender, m.target, flag | len(parts) // 2) + b"".join(parts) + tail)
    if m.answers:
        block, rest = _encode_answers(m.answers, MAX_TUNNEL - len(frames[-1]), tags)
        frames[-1] += block
        for answer in rest:
            frames += _encode_committed(answer, now, tags)
    return frames


def _encode_answers(answers: tuple[Committed, ...], room: int, tags: Tags | None) -> tuple[bytes, list[Committed]]:
    """A block with as much of the answers as fits `room` bytes, the block with their tags, and what does not fit."""
    room -= _BLOCK.size + _MAC
    riders = told = b""
    left = []
    for answer in answers:
        # The first tag and the head of its block are in what stays free.
        part, rest = _part_of(answer, room - len(riders) - len(told))
        if part is not None:
            riders += _answer_bytes(part)
            told += b"" if tags is None else tags.of_answer(part.target, answer_said(part))
        if rest is not None:
            left.append(rest)
    blocks = _BLOCK.pack(ANSWERS, len(riders)) + riders if riders else b""
    return (blocks + _BLOCK.pack(TAGS, len(told)) + told if told else blocks), left


def _part_of(m: Committed, room: int) -> tuple[Committed | None, Committed | None]:
    """As much of an answer as fits `room` bytes, without its sender, and what does not fit."""
    room = max(0, room - _RIDER.size)
    done = m.committed[: room // _DONE.size]
    no = m.refused[: (room - len(done) * _DONE.size) // _NUMBER.size]
    if len(done) == len(m.committed) and len(no) == len(m.refused):
        return m, None
    rest = m._replace(committed=m.committed[len(done) :], refused=m.refused[len(no) :])
    return (m._replace(committed=done, refused=no) if done or no else None), rest


def _answer_bytes(m: Committed) -> bytes:
    """An answer without its sender."""
    done = [(number, content_hash & CRC_MASK) for number, content_hash in m.committed]
    numbers = struct.pack(f"<{2 * len(done) + len(m.refused)}I", *chain(*done, m.refused))
    return _RIDER.pack(m.target, len(done), len(m.refused)) + numbers


def _encode_offer(m: Offer, now: float) -> list[bytes]:
    return [
        _OFFER.pack(
            _head(OFFER), m.sender, m.target, m.number, *m.id, _age(m.created, now, m.at_least), m.hops, m.kind, m.crc,
            m.size, m.chunk_size,
        )
    ]  # fmt: skip


def _encode_accept(m: Accept, now: float) -> list[bytes]:
    *fields, bitmap = m
    told = _bitmap_bytes(bitmap, REPORT_BITS)
    return [_ACCEPT.pack(_head(ACCEPT), *fields) + bytes([len(told)]) + told]


def _encode_chunk(m: Chunk, now: float) -> list[bytes]:
    if len(m.data) > CHUNK_BYTES or m.position >= _POLL:
        raise ValueError("chunk too large")
    return [_CHUNK.pack(_head(CHUNK), m.handle, m.position | (_POLL if m.poll else 0)) + m.data]


def _encode_sack(m: Sack, now: float) -> list[bytes]:
    told = _bitmap_bytes(m.bitmap, REPORT_BITS)
    parts = [_SACK.pack(_head(SACK), m.sender, m.target, m.handle, m.next_index, len(told)), told]
    parts.append(_FURTHER.pack(m.question, len(m.others)))
    for handle, next_index, bitmap in m.others:
        told = _bitmap_bytes(bitmap, OTHER_BITS)
        parts += [_REPORT.pack(handle, next_index, len(told)), told]
    return [b"".join(parts)]


def _bitmap_bytes(bitmap: int, bits: int) -> bytes:
    return bitmap.to_bytes(bits // 8, "little").rstrip(b"\0")


def _encode_committed(m: Committed, now: float, tags: Tags | None = None) -> list[bytes]:
    head = _SENDER.pack(_head(COMMITTED), m.sender)
    frames = []
    rest: Committed | None = m
    while rest is not None:
        part, rest = _part_of(rest, MAX_TUNNEL - _MAC - len(head))
        assert part is not None
        tag = b"" if tags is None else tags.of_answer(part.target, answer_said(part))
        frames.append(head + _answer_bytes(part) + tag)
    return frames


def _encode_receipt(m: Receipt, now: float) -> list[bytes]:
    head = _RECEIPT.pack(_head(RECEIPT), m.base, m.base_life, m.serial, m.crc, len(m.entries))
    payload = head + b"".join(map(entry_bytes, m.entries))
    if len(payload) > MAX_TUNNEL:
        raise ValueError(f"a receipt of {len(payload)} bytes")
    return [payload]


def _encode_sequence_mark(m: SequenceMark, now: float) -> list[bytes]:
    return [_SEQUENCE_MARK.pack(_head(SEQUENCE_MARK), *m)]


def _encode_summary(m: Summary, now: float) -> list[bytes]:
    packed = pack_marks(m.marks, m.bits)
    if len(packed) > MARK_BYTES:
        raise ValueError(f"a summary of {len(packed)} bytes")
    fields = (m.base, m.base_life, m.serial, m.crc, len(m.marks), m.bits, len(packed))
    return [_SUMMARY.pack(_head(MORE), SUMMARY, *fields) + packed]


def _encode_rows(
    type_: int, m: DeletionReport | Query | PassedOn | CopyStatuses, row: struct.Struct, rows: Any, free: int = 0,
    tags: Tags | None = None, to: Sequence[int] = (), flag: int = 0,
) -> list[bytes]:  # fmt: skip
    """As many frames as necessary, at least one; `free`: bytes that stay free at the end of each, or hold the tags for
    these nodes. `flag`: a bit of the byte with the number of rows."""
    each = (MAX_TUNNEL - _TO.size - free) // row.size
    frames = []
    for start in range(0, len(rows) or 1, each):
        part = rows[start : start + each]
        head = _TO.pack(_head(type_), m.sender, m.target, len(part) | flag)
        frame = head + b"".join([row.pack(*fields) for fields in part])
        if tags is not None and to:
            place, told = tags.of_word(type_, to, frame)
            if m.target == BROADCAST:
                told = [_HOLDER.pack(*holder) for holder in zip(to, told, strict=True)]
            frame += _NUMBER.pack(place) + b"".join(told)
        frames.append(frame)
    return frames


def _encode_deletion_report(m: DeletionReport, now: float) -> list[bytes]:
    rows = [(e.number, *e.id, e.reason, e.crc) for e in m.entries]
    if not any(e.proof for e in m.entries):
        return _encode_rows(DELETION_REPORT, m, _NOTE, rows)
    # struct fills up with zeros.
    rows_proven = [(*row, e.proof) for row, e in zip(rows, m.entries, strict=True)]
    return _encode_rows(DELETION_REPORT, m, _PROVEN_NOTE, rows_proven, flag=_PROVEN)


def _encode_put(m: Put, now: float) -> list[bytes]:
    d = m.datum
    head = _PUT.pack(
        _head(PUT), m.sender, m.lamport, m.writer, *d.id, _age(d.created, now, d.at_least), d.hops, d.kind, d.crc,
        len(d.payload),
    )  # fmt: skip
    if len(head) + len(d.payload) > MAX_TUNNEL:
        raise ValueError(f"an entry of {len(d.payload)} bytes does not fit one frame")
    return [head + d.payload]


def _encode_query(m: Query, now: float) -> list[bytes]:
    if len(m.ids) > QUERY_IDS:
        raise ValueError(f"a query of {len(m.ids)} entries")
    return _encode_rows(QUERY, m, _ID, m.ids)


def _encode_passed_on(m: PassedOn, now: float, tags: Tags | None = None) -> list[bytes]:
    if tags is None or m.target != BROADCAST:
        return _encode_rows(PASSED_ON, m, _ID, m.ids, _MAC, tags, (m.target,))
    frames = []
    for start in range(0, len(m.holders), MOST_HOLDERS):
        to = m.holders[start : start + MOST_HOLDERS]
        frames += _encode_rows(PASSED_ON, m, _ID, m.ids, PLACE_BYTES + len(to) * _HOLDER.size, tags, to)
    return frames


def _encode_copy_statuses(m: CopyStatuses, now: float, tags: Tags | None = None) -> list[bytes]:
    # What is said to everybody is a question, and ends nothing.
    to = () if m.target == BROADCAST else (m.target,)
    return _encode_rows(COPY_STATUSES, m, _COPY_STATUS, [(*e.id, e.status) for e in m.entries], _MAC, tags, to)


# -- decoding ----------------------------------------------------------------------------------------------------------


def target_of(payload: bytes) -> int:
    """The node id that a TUNNEL payload names; BROADCAST: it names none, or is not a message of ours."""
    return payload[3] | payload[4] << 8 if len(payload) > 4 and payload[0] in _TARGETED else BROADCAST


def is_overheard(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a message of this version that nodes read even if it is for another one."""
    return payload[:1] in _OVERHEARD


def beacon_sender(payload: bytes) -> int | None:
    """The node id in a TUNNEL payload that begins like a `Beacon` of this version; None: it does not."""
    return payload[1] | payload[2] << 8 if len(payload) > 2 and payload[0] == _BEACON_HEAD else None


# In a mock swarm all nodes that hear a frame decode it one after the other.
@lru_cache(maxsize=16)
def decode(payload: bytes, now: float) -> Message:
    """The message in a TUNNEL payload. Raises `MalformedError`, and nothing else, whatever the bytes.

    `now`: seconds on the receiver's timeline, for ages.
    """
    try:
        decoder = _DECODERS.get(payload[0])
        if decoder is None:
            raise _foreign(payload)
        return decoder(payload, now)
    except (struct.error, IndexError) as error:
        raise MalformedError(f"truncated message: {error}") from None


def _foreign(p: bytes) -> ForeignError:
    version, type_ = p[0] >> 4, p[0] & 15
    if version == VERSION:
        if type_ == MORE and len(p) > 1:
            type_ = p[1]
        return ForeignError(f"message type {type_} is not known", version)
    sender = p[1] | p[2] << 8 if len(p) > 2 and type_ in _WITH_SENDER else BROADCAST
    return ForeignError(f"version {version}, ours is {VERSION}", version, None if sender == BROADCAST else sender)


def _decode_beacon(p: bytes, now: float) -> Beacon:
    rest = p[:_SEAL] + p[_SEAL + 4 :]
    fields = _BEACON_FIELDS.unpack_from(rest)
    if (crc32(rest),) != _NUMBER.unpack_from(p, _SEAL):
        raise MalformedError("a beacon with a wrong checksum")
    if fields[0] == BROADCAST:
        raise MalformedError("a beacon from everybody")
    blocks = _decode_blocks(rest, _BEACON.size, fields[0]) if len(rest) > _BEACON.size else _NO_BLOCKS
    # What `Beacon._make` does, without its checks: most frames that a node hears are beacons.
    return tuple.__new__(Beacon, (*fields, blocks.answers, blocks.moves, blocks.proof, blocks.key))


class _Blocks(NamedTuple):
    answers: tuple[Committed, ...] = ()
    distance: Distance | None = None
    """How a distant replica keeps away."""
    moves: int = 0
    proof: bytes = b""
    key: bytes = b""


_NO_BLOCKS = _Blocks()


def _decode_blocks(p: bytes, at: int, sender: int) -> _Blocks:
    """The blocks from `at` to the end. Unknown ones are ignored."""
    answers, distance, moves, proof, key = _NO_BLOCKS
    while at < len(p):
        kind, size = _BLOCK.unpack_from(p, at)
        at += _BLOCK.size
        if at + size > len(p):
            raise MalformedError("truncated block")
        if kind == ANSWERS:
            answers += _decode_answers(p[at : at + size], sender)
        elif kind == DISTANCE and size >= _DISTANCE.size:
            distance = Distance._make(_DISTANCE.unpack_from(p, at))
        elif kind == MOTION and size >= _MOVES.size:
            (moves,) = _MOVES.unpack_from(p, at)
        elif kind == PROOF and size >= PROOF_BYTES:
            proof = p[at : at + PROOF_BYTES]
        elif kind == KEY and size >= KEY_BYTES:
            key = p[at : at + KEY_BYTES]
        at += size
    return _Blocks(answers, distance, moves, proof, key)


def _decode_answers(block: bytes, sender: int) -> tuple[Committed, ...]:
    answers = []
    at = 0
    while at < len(block):
        answer, at = _decode_answer(block, at, sender)
        answers.append(answer)
    return tuple(answers)


def _decode_data(p: bytes, now: float) -> Data:
    _, sender, target, count = _TO.unpack_from(p)
    at = _TO.size
    handovers = []
    for _ in range(count & ~_REPLICA):
        number, origin, epoch, sequence, age, hops, kind, crc, size = _DATUM.unpack_from(p, at)
        at += _DATUM.size
        data = p[at : at + size]
        at += size
        if len(data) != size or not size:
            raise MalformedError("truncated datum")
        created = now - (age & _OLDEST) / 1000.0
        datum = Datum(DatumId(origin, epoch, sequence), kind, created, hops, crc, data, age >= _OLDEST)
        handovers.append(Handover(number, datum))
    replica = count >= _REPLICA
    if at == len(p):
        return Data(sender, target, tuple(handovers), replica)
    blocks = _decode_blocks(p, at, sender)
    return Data(sender, target, tuple(handovers), replica, blocks.distance if replica else None, blocks.answers)


def _decode_offer(p: bytes, now: float) -> Offer:
    (_, sender, target, number, origin, epoch, sequence, age, hops, kind, crc, size, chunk) = _OFFER.unpack_from(p)
    if size <= 0 or not 0 < chunk <= CHUNK_BYTES:
        raise MalformedError(f"an offer of {size} bytes in chunks of {chunk}")
    id = DatumId(origin, epoch, sequence)
    created = now - (age & _OLDEST) / 1000.0
    return Offer(sender, target, number, id, kind, created, hops, crc, size, chunk, age >= _OLDEST)


def _decode_accept(p: bytes, now: float) -> Accept:
    _, sender, target, number, handle, next_index = _ACCEPT.unpack_from(p)
    at = _ACCEPT.size
    bitmap = _read_bitmap(p, at + 1, p[at], REPORT_BITS) if len(p) > at else 0
    return Accept(sender, target, number, handle, next_index, bitmap)


def _decode_chunk(p: bytes, now: float) -> Chunk:
    _, handle, index = _CHUNK.unpack_from(p)
    return Chunk(BROADCAST, handle, index & ~_POLL, bool(index & _POLL), p[_CHUNK.size :])


def _decode_sack(p: bytes, now: float) -> Sack:
    _, sender, target, handle, next_index, size = _SACK.unpack_from(p)
    bitmap = _read_bitmap(p, _SACK.size, size, REPORT_BITS)
    at = _SACK.size + size
    if len(p) == at:
        return Sack(sender, target, handle, next_index, bitmap)
    question, count = _FURTHER.unpack_from(p, at)
    if count > MAX_OTHERS:
        raise MalformedError(f"a sack of {count} further transfers")
    at += _FURTHER.size
    further = []
    for _ in range(count):
        named, first, size = _REPORT.unpack_from(p, at)
        at += _REPORT.size
        further.append(Report(named, first, _read_bitmap(p, at, size, OTHER_BITS)))
        at += size
    return Sack(sender, target, handle, next_index, bitmap, question, tuple(further))


def _read_bitmap(p: bytes, at: int, size: int, bits: int) -> int:
    bitmap = p[at : at + size]
    if len(bitmap) != size or size > bits // 8:
        raise MalformedError("truncated bitmap")
    return int.from_bytes(bitmap, "little")


def _decode_committed(p: bytes, now: float) -> Committed:
    return _decode_answer(p, _SENDER.size, _SENDER.unpack_from(p)[1])[0]


def _decode_answer(p: bytes, at: int, sender: int) -> tuple[Committed, int]:
    """An answer, and where it ends."""
    target, done, no = _RIDER.unpack_from(p, at)
    at += _RIDER.size
    end = at + done * _DONE.size
    committed = tuple([_DONE.unpack_from(p, i) for i in range(at, end, _DONE.size)])
    refused = tuple([_NUMBER.unpack_from(p, end + i * _NUMBER.size)[0] for i in range(no)])
    return Committed(sender, target, committed, refused), end + no * _NUMBER.size


def _decode_receipt(p: bytes, now: float) -> Receipt:
    _, base, life, serial, crc, count = _RECEIPT.unpack_from(p)
    at = _RECEIPT.size
    entries = []
    for _ in range(count):
        entry, at = _decode_receipt_entry(p, at)
        entries.append(entry)
    if receipt_crc(base, life, serial, entries) != crc:
        raise MalformedError("a receipt with a wrong checksum")
    return Receipt(base, life, serial, crc, tuple(entries))


def _decode_receipt_entry(p: bytes, at: int) -> tuple[ReceiptEntry, int]:
    """An entry, and where the next one begins. Each content has exactly one encoding."""
    origin, epoch = _PAIR.unpack_from(p, at)
    first, at = _decode_varint(p, at + _PAIR.size)
    run, at = _decode_varint(p, at)
    size = p[at] & ~TOLD_LOST
    lost = p[at] >= TOLD_LOST
    at += 1
    bits = p[at : at + size]
    if len(bits) != size or size > RECEIPT_BITS // 8 or (size and not bits[-1]):
        raise MalformedError("a receipt with a bitmap of a wrong size")
    bitmap = int.from_bytes(bits, "little")
    if not run or bitmap & 1 or first + run + bitmap.bit_length() > 1 << 32:
        raise MalformedError(f"a receipt of {run} numbers from {first}, and {bitmap:x}")
    return ReceiptEntry(origin, epoch, first, run, bitmap, lost), at + size


def _decode_varint(p: bytes, at: int) -> tuple[int, int]:
    """A number of at most 5 bytes, the low seven bits first, and where it ends."""
    number = 0
    for shift in range(0, 35, 7):
        byte = p[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            if not byte and shift:
                break
            return number, at
    raise MalformedError("a number in a longer form than necessary")


def _decode_sequence_mark(p: bytes, now: float) -> SequenceMark:
    sequence_mark = SequenceMark._make(_SEQUENCE_MARK.unpack_from(p)[1:])
    if sequence_mark_crc(*sequence_mark[:3]) != sequence_mark.crc:
        raise MalformedError("a Given with a wrong checksum")
    return sequence_mark


def _decode_summary(p: bytes, now: float) -> Summary:
    _, _, base, life, serial, crc, count, bits, size = _SUMMARY.unpack_from(p)
    packed = p[_SUMMARY.size : _SUMMARY.size + size]
    if len(packed) != size or size > MARK_BYTES or not count or not MIN_BITS <= bits <= MAX_BITS:
        raise MalformedError(f"a summary of {count} data with {bits} bits in {size} bytes")
    if summary_crc(base, life, serial, bits, count, packed) != crc:
        raise MalformedError("a summary with a wrong checksum")
    try:
        marks = unpack_marks(packed, count, bits)
    except ValueError as error:
        raise MalformedError(f"a summary: {error}") from None
    return Summary(base, life, serial, crc, bits, marks)


def _decode_more(p: bytes, now: float) -> Message:
    decoder = _MORE_DECODERS.get(p[1]) if len(p) > 1 else None
    if decoder is None:
        raise _foreign(p)
    return decoder(p, now)


def _decode_rows(p: bytes, row: struct.Struct, flag: int = 0) -> tuple[int, int, list[tuple[Any, ...]]]:
    """Sender, target and the fields of each row."""
    _, sender, target, count = _TO.unpack_from(p)
    return sender, target, [row.unpack_from(p, _TO.size + i * row.size) for i in range(count - flag)]


def _decode_deletion_report(p: bytes, now: float) -> DeletionReport:
    proven = p[_TO.size - 1] & _PROVEN
    sender, target, rows = _decode_rows(p, _PROVEN_NOTE if proven else _NOTE, proven)
    return DeletionReport(sender, target, tuple([DeletionEntry(row[0], DatumId(*row[1:4]), *row[4:]) for row in rows]))


def _decode_put(p: bytes, now: float) -> Put:
    (_, sender, lamport, writer, origin, epoch, sequence, age, hops, kind, crc, size) = _PUT.unpack_from(p)
    data = p[_PUT.size : _PUT.size + size]
    if len(data) != size or not size:
        raise MalformedError("truncated entry")
    created = now - (age & _OLDEST) / 1000.0
    datum = Datum(DatumId(origin, epoch, sequence), kind, created, hops, crc, data, age >= _OLDEST)
    return Put(sender, lamport, writer, datum)


def _decode_query(p: bytes, now: float) -> Query:
    sender, target, rows = _decode_rows(p, _ID)
    return Query(sender, target, tuple(map(DatumId._make, rows)))


def _decode_passed_on(p: bytes, now: float) -> PassedOn:
    sender, target, rows = _decode_rows(p, _ID)
    return PassedOn(sender, target, tuple(map(DatumId._make, rows)))


def _decode_copy_statuses(p: bytes, now: float) -> CopyStatuses:
    sender, target, rows = _decode_rows(p, _COPY_STATUS)
    return CopyStatuses(sender, target, tuple([CopyStatusEntry(DatumId(*row[:3]), row[3]) for row in rows]))


# -- all of them -------------------------------------------------------------------------------------------------------


class Format(NamedTuple):
    """How a kind of message is encoded."""

    number: int
    """Its type: the low four bits of the first byte; from 16 on the second byte, after a first one of type 15."""
    encode: Callable[..., list[bytes]]
    decode: Callable[[bytes, float], Message]


FORMATS: dict[type, Format] = {
    Beacon: Format(BEACON, _encode_beacon, _decode_beacon),
    Data: Format(DATA, _encode_data, _decode_data),
    Offer: Format(OFFER, _encode_offer, _decode_offer),
    Accept: Format(ACCEPT, _encode_accept, _decode_accept),
    Chunk: Format(CHUNK, _encode_chunk, _decode_chunk),
    Sack: Format(SACK, _encode_sack, _decode_sack),
    Committed: Format(COMMITTED, _encode_committed, _decode_committed),
    Receipt: Format(RECEIPT, _encode_receipt, _decode_receipt),
    DeletionReport: Format(DELETION_REPORT, _encode_deletion_report, _decode_deletion_report),
    Put: Format(PUT, _encode_put, _decode_put),
    Query: Format(QUERY, _encode_query, _decode_query),
    PassedOn: Format(PASSED_ON, _encode_passed_on, _decode_passed_on),
    CopyStatuses: Format(COPY_STATUSES, _encode_copy_statuses, _decode_copy_statuses),
    SequenceMark: Format(SEQUENCE_MARK, _encode_sequence_mark, _decode_sequence_mark),
    Summary: Format(SUMMARY, _encode_summary, _decode_summary),
}
_ENCODERS = {kind: format.encode for kind, format in FORMATS.items()}
_WITH_TAGS = frozenset({_encode_beacon, _encode_data, _encode_committed, _encode_passed_on, _encode_copy_statuses})
# By second byte, after a first one of type 15.
_MORE_DECODERS = {format.number: format.decode for format in FORMATS.values() if format.number > MORE}
# By first byte.
_DECODERS = {_head(format.number): format.decode for format in FORMATS.values() if format.number < MORE}
_DECODERS[_head(MORE)] = _decode_more
#: First bytes of messages whose target node id is in bytes 3 and 4.
_TARGETED = frozenset(_head(FORMATS[kind].number) for kind, about in KINDS.items() if about.target is Target.NAMED)
