"""Encoding and decoding of TUNNEL payloads (docs/reference/protocol.md). Little-endian, version in the first four bits.

tools/wire_table.py says what stands where, and the functions in `generated.py` follow from it. Here is what they do not
do.

Fields appended at the end are ignored. Another major version or an unknown type raises `ForeignError`, so that it can
be counted separately from garbage. Times travel as ages.
"""

from __future__ import annotations

import struct
from typing import NamedTuple
from zlib import crc32

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import BROADCAST, Beacon, Committed, Data, Distance, Handover, Message
from rass_mav.core.seals import CRC_MASK
from rass_mav.errors import MalformedError

from . import generated
from .generated import (
    ACCEPT,
    ANSWERS,
    ANSWERS_BLOCK_FIELDS,
    BEACON,
    BEACON_CRC,
    BEACON_FIELDS,
    COMMITTED,
    COMMITTED_FIELDS,
    DATA,
    DATA_FIELDS,
    DISTANCE,
    DISTANCE_BLOCK_FIELDS,
    FURTHER_TARGETED,
    HANDOVER_FIELDS,
    KEY,
    KEY_BLOCK_FIELDS,
    MORE,
    MOTION,
    MOTION_BLOCK_FIELDS,
    NUMBERS,
    OFFER,
    PAIR_FIELDS,
    PROOF,
    PROOF_BLOCK_FIELDS,
    REFUSED_FIELDS,
    TAGS,
    TARGETED,
    UPDATES,
    UPDATES_BLOCK_FIELDS,
    VERSION,
    WITH_SENDER,
)  # fmt: skip
from .parts import MAX_TUNNEL, OLDEST, PLACE_BYTES, ROOM_FOR_TAG, TAG_BYTES, Tags, age

__all__ = [
    "ANSWERS", "BEACON", "COMMITTED", "DISTANCE", "KEY", "MAX_TUNNEL", "MORE", "MOTION", "NUMBERS",
    "PLACE_BYTES", "PROOF", "TAGS", "TAG_BYTES", "UPDATES", "VERSION",
]  # fmt: skip

# Without the first byte.
_BEACON_FIELDS = struct.Struct(BEACON_FIELDS.format.replace("B", "x", 1))
_CRC = struct.Struct("<I")
#: Bytes of a beacon without blocks.
BEACON_BYTES = BEACON_FIELDS.size + _CRC.size
# What a block begins with: its kind and its size in bytes.
_BLOCK = struct.Struct("<BB")
#: Bytes of what shows that a beacon's route is true, and that its sender has made it.
PROOF_BYTES, KEY_BYTES = PROOF_BLOCK_FIELDS.size, KEY_BLOCK_FIELDS.size
#: Bytes of an answer without its sender, which is known where it is in a beacon, and before it.
_ANSWER_BYTES = ANSWERS_BLOCK_FIELDS.size
_SENDER_BYTES = COMMITTED_FIELDS.size - _ANSWER_BYTES

_DATA_BYTES, _HANDOVER_BYTES = DATA_FIELDS.size, HANDOVER_FIELDS.size

_REPLICA = 0x80
_STRONG_BYTES = 16


class ForeignError(MalformedError):
    """Another major version, or a message type of a later one: not garbage, but not for us."""

    def __init__(self, text: str, version: int, sender: int | None = None) -> None:
        super().__init__(text)
        self.version = version
        """Major version of the message, 0..15."""
        self.sender = sender
        """Node id of the sender of a message of another version; None: the message has none."""


def _head(type_: int) -> int:
    return VERSION << 4 | type_


# -- encoding ----------------------------------------------------------------------------------------------------------


def encode(message: Message, now: float, tags: Tags | None = None) -> list[bytes]:
    """The TUNNEL payloads of a message: usually one; data and answers that do not fit one frame fill several.

    `now`: seconds on the sender's timeline, for ages. `tags`: None: the node has no keys. ValueError or struct.error: a
    message that exceeds its bounds, which is our bug.
    """
    kind = type(message)
    encoder = _ENCODERS[kind]
    return encoder(message, now) if tags is None or kind not in _WITH_TAGS else encoder(message, now, tags)


def answer_claim(m: Committed) -> bytes:
    """What the tag of an answer covers: its bytes without the sender, and then all of each content hash but the
    checksum in them."""
    strong = [(content_hash >> 32).to_bytes(_STRONG_BYTES, "little") for _, content_hash in m.committed]
    return _answer_bytes(m) + b"".join(strong)


#: First byte of all messages whose type is in the second one.
MORE_HEAD = bytes([_head(MORE)])
_BEACON_HEAD, _DATA_HEAD = _head(BEACON), _head(DATA)
_OVERHEARD = frozenset(bytes([_head(number)]) for number in (DATA, OFFER, ACCEPT))


def _encode_beacon(m: Beacon, now: float, tags: Tags | None = None) -> list[bytes]:
    answers, moves, proof, key, updates = m[-5:]
    rest = BEACON_FIELDS.pack(_BEACON_HEAD, *m[:-5])
    if moves:
        rest += _BLOCK.pack(MOTION, MOTION_BLOCK_FIELDS.size) + MOTION_BLOCK_FIELDS.pack(moves)
    if proof:
        rest += _BLOCK.pack(PROOF, PROOF_BYTES) + proof
    if key:
        rest += _BLOCK.pack(KEY, KEY_BYTES) + key
    if updates:
        rest += _BLOCK.pack(UPDATES, UPDATES_BLOCK_FIELDS.size) + UPDATES_BLOCK_FIELDS.pack(updates)
    if answers:
        rest += _encode_answers(answers, MAX_TUNNEL - len(rest) - _CRC.size, tags)
    return [rest[:BEACON_CRC] + _CRC.pack(crc32(rest)) + rest[BEACON_CRC:]]


def _encode_data(m: Data, now: float, tags: Tags | None = None) -> list[bytes]:
    sender, target, handovers, replica, distance = m
    found = []
    parts: list[bytes] = []
    tail = b""
    if replica and distance:
        tail = _BLOCK.pack(DISTANCE, DISTANCE_BLOCK_FIELDS.size) + DISTANCE_BLOCK_FIELDS.pack(*distance)
    most = room = MAX_TUNNEL - _DATA_BYTES - len(tail)
    flag = _REPLICA if replica else 0
    for number, (id, kind, created, hops, crc, payload, at_least) in handovers:
        size = _HANDOVER_BYTES + len(payload)
        if size > room:
            if size > most:
                raise ValueError(f"a datum of {len(payload)} bytes does not fit one frame")
            head = DATA_FIELDS.pack(_DATA_HEAD, sender, target, flag | len(parts) // 2)
            found.append(head + b"".join(parts) + tail)
            parts = []
            room = most
        parts.append(HANDOVER_FIELDS.pack(number, *id, age(created, now, at_least), hops, kind, crc, len(payload)))
        parts.append(payload)
        room -= size
    found.append(DATA_FIELDS.pack(_DATA_HEAD, sender, target, flag | len(parts) // 2) + b"".join(parts) + tail)
    return found


def _encode_answers(answers: tuple[Committed, ...], room: int, tags: Tags | None) -> bytes:
    """A block with as much of the answers as fits `room` bytes, and the block with their tags."""
    room -= _BLOCK.size + ROOM_FOR_TAG
    riders = answer_tags = b""
    for answer in answers:
        # The first tag and the head of its block are in what stays free.
        part, _ = _part_of(answer, room - len(riders) - len(answer_tags))
        if part is not None:
            riders += _answer_bytes(part)
            answer_tags += b"" if tags is None else tags.of_answer(part.target, answer_claim(part))
    blocks = _BLOCK.pack(ANSWERS, len(riders)) + riders if riders else b""
    return blocks + _BLOCK.pack(TAGS, len(answer_tags)) + answer_tags if answer_tags else blocks


def _part_of(m: Committed, room: int) -> tuple[Committed | None, Committed | None]:
    """As much of an answer as fits `room` bytes, without its sender, and what does not fit."""
    room = max(0, room - _ANSWER_BYTES)
    if len(m.committed) * PAIR_FIELDS.size + len(m.refused) * REFUSED_FIELDS.size <= room:
        return m, None
    done = m.committed[: room // PAIR_FIELDS.size]
    no = m.refused[: (room - len(done) * PAIR_FIELDS.size) // REFUSED_FIELDS.size]
    rest = m._replace(committed=m.committed[len(done) :], refused=m.refused[len(no) :])
    return (m._replace(committed=done, refused=no) if done or no else None), rest


def _answer_bytes(m: Committed) -> bytes:
    """An answer without its sender."""
    _, target, committed, refused = m
    said = ANSWERS_BLOCK_FIELDS.pack(target, len(committed), len(refused))
    for number, content_hash in committed:
        said += PAIR_FIELDS.pack(number, content_hash & CRC_MASK)
    for number in refused:
        said += REFUSED_FIELDS.pack(number)
    return said


def _encode_committed(m: Committed, now: float, tags: Tags | None = None) -> list[bytes]:
    head = COMMITTED_FIELDS.pack(_head(COMMITTED), m.sender, 0, 0, 0)[:_SENDER_BYTES]
    frames = []
    rest: Committed | None = m
    while rest is not None:
        part, rest = _part_of(rest, MAX_TUNNEL - ROOM_FOR_TAG - len(head))
        assert part is not None
        tag = b"" if tags is None else tags.of_answer(part.target, answer_claim(part))
        frames.append(head + _answer_bytes(part) + tag)
    return frames


# -- decoding ----------------------------------------------------------------------------------------------------------


def target_of(payload: bytes) -> int:
    """The node id that a TUNNEL payload names; BROADCAST: it names none, or is not a message of ours."""
    if len(payload) > 4 and payload[0] in TARGETED:
        return payload[3] | payload[4] << 8
    further = payload[:1] == MORE_HEAD and len(payload) > 5 and payload[1] in FURTHER_TARGETED
    return payload[4] | payload[5] << 8 if further else BROADCAST


def is_overheard(payload: bytes) -> bool:
    """Whether a TUNNEL payload begins like a message of this version that nodes read even if it is for another one."""
    return payload[:1] in _OVERHEARD


def beacon_sender(payload: bytes) -> int | None:
    """The node id in a TUNNEL payload that begins like a `Beacon` of this version; None: it does not."""
    return payload[1] | payload[2] << 8 if len(payload) > 2 and payload[0] == _BEACON_HEAD else None


def decode(payload: bytes, now: float) -> Message:
    """The message in a TUNNEL payload. Raises `MalformedError`, and nothing else, whatever the bytes.

    `now`: seconds on the receiver's timeline, for ages.
    """
    try:
        decoder = _DECODERS.get(payload[0])
        if decoder is None and payload[:1] == MORE_HEAD and len(payload) > 1:
            decoder = _FURTHER_DECODERS.get(payload[1])
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
    sender = p[1] | p[2] << 8 if len(p) > 2 and type_ in WITH_SENDER else BROADCAST
    return ForeignError(f"version {version}, ours is {VERSION}", version, None if sender == BROADCAST else sender)


def _decode_beacon(p: bytes, now: float) -> Beacon:
    rest = p[:BEACON_CRC] + p[BEACON_CRC + 4 :]
    fields = _BEACON_FIELDS.unpack_from(rest)
    if (crc32(rest),) != _CRC.unpack_from(p, BEACON_CRC):
        raise MalformedError("a beacon with a wrong checksum")
    if fields[0] == BROADCAST:
        raise MalformedError("a beacon from the broadcast id")
    blocks = _decode_blocks(rest, BEACON_FIELDS.size, fields[0]) if len(p) > BEACON_BYTES else _NO_BLOCKS
    # What `Beacon._make` does, without its checks: most frames that a node hears are beacons.
    return tuple.__new__(Beacon, fields + blocks[1:])


class _Blocks(NamedTuple):
    distance: Distance | None = None
    """How a distant replica keeps away."""
    # From here on as in a beacon.
    answers: tuple[Committed, ...] = ()
    moves: int = 0
    proof: bytes = b""
    key: bytes = b""
    updates: int = 0


_NO_BLOCKS = _Blocks()


def _decode_blocks(p: bytes, at: int, sender: int) -> _Blocks:
    """The blocks from `at` to the end. Unknown ones are ignored."""
    distance, answers, moves, proof, key, updates = _NO_BLOCKS
    while at < len(p):
        kind, size = _BLOCK.unpack_from(p, at)
        at += _BLOCK.size
        if at + size > len(p):
            raise MalformedError("truncated block")
        if kind == ANSWERS:
            answers += _decode_answers(p[at : at + size], sender)
        elif kind == DISTANCE and size >= DISTANCE_BLOCK_FIELDS.size:
            distance = Distance._make(DISTANCE_BLOCK_FIELDS.unpack_from(p, at))
        elif kind == MOTION and size >= MOTION_BLOCK_FIELDS.size:
            (moves,) = MOTION_BLOCK_FIELDS.unpack_from(p, at)
        elif kind == PROOF and size >= PROOF_BYTES:
            proof = p[at : at + PROOF_BYTES]
        elif kind == KEY and size >= KEY_BYTES:
            key = p[at : at + KEY_BYTES]
        elif kind == UPDATES and size >= UPDATES_BLOCK_FIELDS.size:
            (updates,) = UPDATES_BLOCK_FIELDS.unpack_from(p, at)
        at += size
    return _Blocks(distance, answers, moves, proof, key, updates)


def _decode_answers(block: bytes, sender: int) -> tuple[Committed, ...]:
    answers = []
    at = 0
    while at < len(block):
        answer, at = _decode_answer(block, at, sender)
        answers.append(answer)
    return tuple(answers)


def _decode_data(p: bytes, now: float) -> Data:
    _, sender, target, count = DATA_FIELDS.unpack_from(p)
    at = _DATA_BYTES
    handovers = []
    for _ in range(count & ~_REPLICA):
        number, origin, epoch, sequence, age, hops, kind, crc, size = HANDOVER_FIELDS.unpack_from(p, at)
        at += _HANDOVER_BYTES
        data = p[at : at + size]
        at += size
        if len(data) != size or not size:
            raise MalformedError("truncated datum")
        created = now - (age & OLDEST) / 1000.0
        datum = Datum(DatumId(origin, epoch, sequence), kind, created, hops, crc, data, age >= OLDEST)
        handovers.append(Handover(number, datum))
    replica = count >= _REPLICA
    if at == len(p):
        return Data(sender, target, tuple(handovers), replica)
    blocks = _decode_blocks(p, at, sender)
    return Data(sender, target, tuple(handovers), replica, blocks.distance if replica else None)


def _decode_committed(p: bytes, now: float) -> Committed:
    return _decode_answer(p, _SENDER_BYTES, p[1] | p[2] << 8)[0]


def _decode_answer(p: bytes, at: int, sender: int) -> tuple[Committed, int]:
    """An answer, and where it ends."""
    target, done, no = ANSWERS_BLOCK_FIELDS.unpack_from(p, at)
    at += _ANSWER_BYTES
    middle = at + done * PAIR_FIELDS.size
    end = middle + no * REFUSED_FIELDS.size
    if len(p) < end:
        raise MalformedError("truncated answer")
    committed = tuple(PAIR_FIELDS.iter_unpack(p[at:middle]))
    refused = tuple([number for (number,) in REFUSED_FIELDS.iter_unpack(p[middle:end])]) if no else ()
    return Committed(sender, target, committed, refused), end


# -- all of them -------------------------------------------------------------------------------------------------------

_ENCODERS = generated.ENCODERS | {Beacon: _encode_beacon, Data: _encode_data, Committed: _encode_committed}
_WITH_TAGS = generated.WITH_TAGS | {Beacon, Data, Committed}
_BY_KIND = generated.DECODERS | {Beacon: _decode_beacon, Data: _decode_data, Committed: _decode_committed}
# By first byte; the others by the second one, behind a head of type MORE.
_DECODERS = {_head(NUMBERS[kind]): decoder for kind, decoder in _BY_KIND.items() if NUMBERS[kind] < MORE}
_FURTHER_DECODERS = {NUMBERS[kind]: decoder for kind, decoder in _BY_KIND.items() if NUMBERS[kind] > MORE}
