"""The payloads that people create, and the form in which data are shown to them."""

from __future__ import annotations

import re
from typing import Any

from rass_mav.core.datum import MAX_PAYLOAD, Datum, DatumId, Kind
from rass_mav.core.store import Store, StoredInfo
from rass_mav.errors import DatumError, MalformedError
from rass_mav.wire.measurement import decode_measurement

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


def age(datum: Datum | StoredInfo, now: float, wall: float) -> dict[str, Any]:
    """The age of a datum as plain values: `age_s`, `created` in seconds since 1970, and `at_least` if it may be older.

    `now`: on the node's timeline. `wall`: the same moment in seconds since 1970.
    """
    # A flipped bit on the disk must not put a datum in the future.
    age_s = max(0.0, now - datum.created)
    return {
        "created": round(wall - age_s, 3),
        "age_s": round(age_s, 3),
        **({"at_least": True} if datum.at_least else {}),
    }


def describe(info: StoredInfo, store: Store, now: float, wall: float, *, apart: bool = False) -> dict[str, Any]:
    """One entry of a list, as plain values, with measurements and file names decoded. Times as in `age`. `apart`: it is
    a second content of an id."""
    try:
        kind: str | int = Kind(info.kind).name.lower()
    except ValueError:
        kind = info.kind
    entry: dict[str, Any] = {
        "id": f"{info.id}#{info.crc:08x}" if apart else str(info.id),
        "kind": kind,
        "size": info.size,
        "hops": info.hops,
        **age(info, now, wall),
    }
    if apart:
        entry["apart"] = True
    if info.kind in (Kind.MEASUREMENT, Kind.FILE):
        datum = store.get_apart(info.id, info.crc) if apart else store.get(info.id)
        if datum is not None:
            try:
                if info.kind == Kind.MEASUREMENT:
                    entry["measurement"] = decode_measurement(datum.payload)._asdict()
                else:
                    entry["name"] = unpack_file(datum.payload)[0]
            except MalformedError as error:
                entry["malformed"] = str(error)
    return entry
