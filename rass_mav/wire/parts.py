"""What the functions that write and read messages have in common."""

from __future__ import annotations

from struct import Struct
from typing import Protocol

from rass_mav.core.messages import BROADCAST, ReceiptEntry
from rass_mav.core.news.layouts import RECEIPT_ENTRY
from rass_mav.core.news.statements import RECEIPT_BITS, TOLD_LOST
from rass_mav.core.news.statements import entry_bytes as receipt_entry_bytes
from rass_mav.errors import MalformedError

__all__ = [
    "MAX_TUNNEL", "OLDEST", "PLACE_BYTES", "ROOM_FOR_TAG", "TAG_BYTES", "Tags", "age", "bitmap_bytes", "fitting",
    "frames", "read_bitmap", "read_receipt_entry", "receipt_entry_bytes", "tagged_frames",
]  # fmt: skip

#: Bytes of a TUNNEL payload.
MAX_TUNNEL = 128
#: The largest age, which means "at least this old", with the bit for it or without.
OLDEST = 0x7FFFFFFF
_AT_LEAST = 0x80000000
#: Bytes of a tag.
TAG_BYTES = 8
#: Bytes of a message's place, before its tag.
PLACE_BYTES = 4
#: Bytes that stay free after answers that end custody or are about copies, for a message authentication code: a tag
#: behind the head of its block, or behind the place of the message among all tagged messages of its sender.
ROOM_FOR_TAG = 12
PLACE = Struct("<I")


class Tags(Protocol):
    """Shows the receivers who says what ends custody or is about copies: for nodes with keys."""

    def of_answer(self, to: int, claim: bytes) -> bytes:
        """The tag of an answer, `TAG_BYTES`. `claim`: `answer_claim`."""

    def of_message(self, type_: int, to: int, claim: bytes) -> tuple[int, bytes]:
        """The place of a message of this type, and its tag. `claim`: the message so far."""


def age(created: float, now: float, at_least: bool) -> int:
    """Milliseconds, and the bit for "at least this old"."""
    age = int((now - created) * 1000.0 + 0.5)
    if age >= OLDEST:
        return _AT_LEAST | OLDEST
    return max(age, 0) | (_AT_LEAST if at_least else 0)


def fitting(payload: bytes) -> bytes:
    """The payload; ValueError: it is too long."""
    if len(payload) > MAX_TUNNEL:
        raise ValueError(f"a message of {len(payload)} bytes does not fit one frame")
    return payload


def bitmap_bytes(bitmap: int, bits: int) -> bytes:
    """A bitmap without the zeros at its end."""
    return bitmap.to_bytes(bits // 8, "little").rstrip(b"\0")


def read_bitmap(p: bytes, at: int, size: int, bits: int) -> int:
    """A bitmap of `size` bytes."""
    bitmap = p[at : at + size]
    if len(bitmap) != size or size > bits // 8:
        raise MalformedError("truncated bitmap")
    return int.from_bytes(bitmap, "little")


def frames(
    head: Struct, first: int, sender: int, target: int, rows: list[bytes], free: int = 0, flag: int = 0
) -> list[bytes]:
    """As many frames as necessary, at least one; `free`: bytes that stay free at the end of each. `flag`: a bit of the
    byte with the number of rows."""
    most = room = MAX_TUNNEL - head.size - free
    whole = b"".join(rows)
    if len(whole) <= most:
        return [head.pack(first, sender, target, flag | len(rows)) + whole]
    parts: list[list[bytes]] = [[]]
    for row in rows:
        if len(row) > room:
            if len(row) > most:
                raise ValueError(f"a row of {len(row)} bytes does not fit one frame")
            parts.append([])
            room = most
        parts[-1].append(row)
        room -= len(row)
    return [head.pack(first, sender, target, flag | len(part)) + b"".join(part) for part in parts]


def tagged_frames(
    head: Struct, first: int, sender: int, target: int, rows: list[bytes], tags: Tags | None
) -> list[bytes]:
    """The same, each frame to one node with its place among all that its sender says so, and its tag."""
    plain = frames(head, first, sender, target, rows, ROOM_FOR_TAG)
    if tags is None or target == BROADCAST:
        return plain
    tagged = [(frame, *tags.of_message(first & 15, target, frame)) for frame in plain]
    return [frame + PLACE.pack(place) + tag for frame, place, tag in tagged]


def read_receipt_entry(p: bytes, at: int) -> tuple[ReceiptEntry, int]:
    """An entry of a receipt, and where it ends. Each content has exactly one encoding."""
    origin, epoch = RECEIPT_ENTRY.unpack_from(p, at)
    first, at = _read_varint(p, at + RECEIPT_ENTRY.size)
    run, at = _read_varint(p, at)
    size = p[at]
    lost = size >= TOLD_LOST
    if lost:
        size -= TOLD_LOST
    at += 1
    bitmap = 0
    if size:
        bits = p[at : at + size]
        if len(bits) != size or size > RECEIPT_BITS // 8 or not bits[-1]:
            raise MalformedError("a receipt with a bitmap of a wrong size")
        bitmap = int.from_bytes(bits, "little")
    if not run or bitmap & 1 or first + run + bitmap.bit_length() > 1 << 32:
        raise MalformedError(f"a receipt of {run} numbers from {first}, and {bitmap:x}")
    return ReceiptEntry(origin, epoch, first, run, bitmap, lost), at + size


def _read_varint(p: bytes, at: int) -> tuple[int, int]:
    """A number of at most 5 bytes, the low seven bits first, and where it ends."""
    number = shift = 0
    while (byte := p[at]) >= 0x80 and shift < 28:
        number |= (byte & 0x7F) << shift
        shift += 7
        at += 1
    if byte < 0x80 and (byte or not shift):
        return number | byte << shift, at + 1
    raise MalformedError("a number in a longer form than necessary")
