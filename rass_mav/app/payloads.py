"""The payloads that people create, and the names of data."""

from __future__ import annotations

import re

from rass_mav.core.datum import MAX_PAYLOAD, DatumId
from rass_mav.errors import DatumError, MalformedError

#: A file of at most so many bytes is one datum of kind FILE. A larger one is cut into parts (`app.staging`).
MOST_SMALL = 1 << 15

_ID = re.compile(r"(\d{1,5})-([0-9a-f]{8})-(\d{1,10})(?:#([0-9a-f]{8}))?", re.ASCII)


def parse_name(text: str) -> tuple[DatumId, int | None]:
    """Parse a name as printed by `ls`: an id, and for its second content a # and the CRC. Raises `DatumError`."""
    match = _ID.fullmatch(text)
    if match is None:
        raise DatumError(f"expected an id like 7-0123abcd-42, got {text!r}")
    id = DatumId(int(match[1]), int(match[2], 16), int(match[3]))
    return id, None if match[4] is None else int(match[4], 16)


def pack_file(name: str, content: bytes) -> bytes:
    """Payload of a datum of kind FILE: one byte with the length of the name, the name in UTF-8, the content.

    Raises `DatumError` if the name does not have 1..255 bytes, or if the payload is too large for a datum.
    """
    encoded = name.encode(errors="replace")
    if not 1 <= len(encoded) <= 255:
        raise DatumError(f"expected a file name of 1 to 255 bytes, got {len(encoded)}")
    if 1 + len(encoded) + len(content) > MAX_PAYLOAD:
        raise DatumError(f"{name}: too large, expected at most {MAX_PAYLOAD - 1 - len(encoded)} bytes")
    return bytes((len(encoded),)) + encoded + content


def unpack_file(payload: bytes) -> tuple[str, bytes]:
    """Name and content. The name is not trustworthy: show it, but never open it. Raises `MalformedError`."""
    size = payload[0] if payload else 0
    if not size or len(payload) < 1 + size:
        raise MalformedError("truncated file name")
    return payload[1 : 1 + size].decode(errors="replace"), payload[1 + size :]
