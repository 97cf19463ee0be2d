"""Explains MAVLink frames that are given in hex: every field of the frame, of TUNNEL, and of a rass_mav message.

    python -m tools.explain_frame fd29...              one frame or several, one behind the other
    python -m tools.explain_frame --payload 410300...  just the payload of a TUNNEL message
    xxd -p air.bin | python -m tools.explain_frame     from stdin

Exit codes: 0 all is well, 1 something is damaged or no frame at all, 2 bad usage.
"""

from __future__ import annotations

import argparse
import re
import struct
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

from rass_mav.core.datum import MOST_PRIORITY, REASONS, TERMS, Datum, DatumId, Fate, Kind, parted
from rass_mav.core.messages import (
    BEACON_BASE,
    BEACON_WANTED,
    BROADCAST,
    NO_ROUTE,
    UNBOUNDED_FREE,
    Beacon,
    Committed,
    CopyStatus,
    CopyStatuses,
    Data,
    Distance,
)
from rass_mav.core.routes.contacts import UNIT_DEGREES, unpack
from rass_mav.core.seals import SEALED
from rass_mav.errors import MalformedError
from rass_mav.mavlink.crc import crc16
from rass_mav.mavlink.dialect import FORMATS, common
from rass_mav.mavlink.frames import FLAG_SIGNED, MAGIC_V1, MAGIC_V2, TUNNEL_ID
from rass_mav.mavlink.signing import SIGNATURE_SIZE
from rass_mav.mavlink.tunnel import decode_tunnel
from rass_mav.trust.keys.key_updates import KeyUpdate
from rass_mav.trust.keys.sealing import SEAL_SIZE
from rass_mav.wire import decode
from rass_mav.wire.attestation import ANCHOR, ASK, STATEMENT_SIGNATURE, decode_attestation
from rass_mav.wire.codec import BEACON_BYTES, MORE, TAG_BYTES, VERSION
from rass_mav.wire.generated import DATA_FIELDS, HANDOVER_FIELDS
from rass_mav.wire.introduction import INTRODUCTION, decode_introduction
from rass_mav.wire.key_updates import KEY_REQUEST, KEY_UPDATE, decode_key_request, enclosed
from rass_mav.wire.measurement import decode_measurement
from rass_mav.wire.nodestatus import decode_status
from rass_mav.wire.tags import blocks_in, end_of_fields, tag_of, tags_in
from tools.wire_table import BLOCKS, KEYED, MESSAGES, Field, Part, Record, Rows, When

#: payload_type of our TUNNEL messages unless a node is told otherwise.
PAYLOAD_TYPE = 33200

_LOSS_REASONS = {number: fate.value for fate, number in REASONS.items()} | {
    REASONS[Fate.UNKNOWN]: "from this sequence on nobody knows what was assigned",
    REASONS[Fate.DAMAGED]: "the store of this life was damaged, so many data may be lost",
}
_COPY_STATUSES = {
    CopyStatus.AGAIN: "my copy is bad, take yours back",
    CopyStatus.NONE: "do not count on my copy",
    CopyStatus.TAKEN: "custody is here, or was passed on from here",
    CopyStatus.STILL: "have you still custody?",
    CopyStatus.WANTED: "to all: who has a good copy?",
    CopyStatus.HERE: "a good copy is here",
    CopyStatus.ENCLOSED: "all my neighbours hear you, choose another holder",
    CopyStatus.PASSED_ON: "passed on from here, your copy is not counted on",
}
_LAYOUTS = {layout.record: layout for layout in MESSAGES}


def _declared(record: type, parts: Sequence[Part]) -> Iterator[tuple[tuple[str, str], str]]:
    """The types of the fields of records, as they are in `parts`."""
    for part in parts:
        if isinstance(part, Field):
            yield (record.__name__, part.name), part.type
        elif isinstance(part, Record | Rows) and part.record:
            yield from _declared(part.record, part.parts)


_TYPES = {("Beacon", "moves"): "x64", ("Beacon", "updates"): "x32"} | dict(
    entry for layout in MESSAGES for entry in _declared(layout.record, layout.parts)
)
_TIMESTAMP = "counts the frames of the stream, which is system id, component id and link id"
_CERTIFICATE = struct.Struct("<HI32s64s")


class UnreadableError(Exception):
    """The bytes cannot be explained; the text says why."""


def line(name: str, value: object, note: str = "", *, depth: int = 1) -> str:
    """One field."""
    return f"{'  ' * depth}{name:<{26 - 2 * depth}} {value}{f'  ({note})' if note else ''}"


def from_hex(text: str) -> bytes:
    """Bytes from hex digits; spaces, commas, colons and 0x between them do not matter. Raises `UnreadableError`."""
    digits = re.sub(r"0x|\\x|[\s,:]", "", text, flags=re.I)
    wrong = re.search(r"[^0-9a-f]", digits, re.I)
    if wrong:
        raise UnreadableError(f"not hex: {wrong[0]!r}")
    if not digits:
        raise UnreadableError("no hex digits given")
    if len(digits) % 2:
        raise UnreadableError(f"{len(digits)} hex digits: half a byte is missing")
    return bytes.fromhex(digits)


def explain_frames(data: bytes, payload_type: int) -> Iterator[str]:
    """Lines about the frames that follow each other in `data`. Raises `UnreadableError` at what is none.

    A frame whose checksum is wrong is shown as far as its header goes, and ends the explanation.
    """
    start = 0
    while start < len(data):
        if start:
            yield ""
        start += yield from _explain_frame(data[start:], payload_type)


def _explain_frame(data: bytes, payload_type: int) -> Generator[str, None, int]:
    """Lines about the frame at the start of `data`; returns its length."""
    magic = data[0]
    if magic not in (MAGIC_V1, MAGIC_V2):
        raise UnreadableError(f"no MAVLink frame: it starts with {magic:#04x}, not with 0xfd (MAVLink 2) or 0xfe (1)")
    second = magic == MAGIC_V2
    header = 10 if second else 6
    if len(data) < header:
        raise UnreadableError(f"the frame is cut off: {len(data)} of {header} bytes of its header")
    size = data[1]
    signed = second and bool(data[2] & FLAG_SIGNED)
    length = header + size + 2 + (SIGNATURE_SIZE if signed else 0)
    message_id = int.from_bytes(data[7:10], "little") if second else data[5]
    definition = common.mavlink_map.get(message_id)
    yield f"MAVLink {2 if second else 1} frame, {length} bytes"
    yield line("payload length", size)
    if second:
        yield line(
            "incompatibility flags", f"{data[2]:#04x}", "signed" if signed else "unsigned" if not data[2] else ""
        )
        yield line("compatibility flags", f"{data[3]:#04x}")
    sequence, system, component = data[4:7] if second else data[2:5]
    yield line("sequence", sequence)
    yield line("system id", system)
    yield line("component id", component)
    yield line("message id", message_id, "not in the common dialect" if definition is None else definition.msgname)
    if second and data[2] & ~FLAG_SIGNED:
        raise UnreadableError("the frame has incompatibility flags that nobody knows")
    if len(data) < length:
        raise UnreadableError(f"the frame is cut off: {len(data)} of {length} bytes")
    end = header + size
    checksum = int.from_bytes(data[end : end + 2], "little")
    if definition is None:
        yield line("checksum", f"{checksum:#06x}", "cannot be checked without knowing the message")
        yield line("payload", data[header:end].hex())
        return length
    expected = crc16(data[1:end] + FORMATS[message_id].crc_extra)
    yield line("checksum", f"{checksum:#06x}", "good" if checksum == expected else f"BAD, should be {expected:#06x}")
    if signed:
        signature = data[end + 2 : length]
        ticks = int.from_bytes(signature[1:7], "little")
        yield line("signature link id", signature[0])
        yield line("signature timestamp", ticks, _TIMESTAMP if message_id == TUNNEL_ID else _clock(ticks))
        yield line("signature", signature[7:].hex(), "not checked: that needs the key")
    if checksum != expected:
        raise UnreadableError("the checksum is wrong: the bytes are damaged, or the sender knows another dialect")
    if message_id == TUNNEL_ID:
        yield from _explain_tunnel(data[header:end], payload_type)
    else:
        yield definition.msgname
        # MAVLink 2 trims zeros; and it allows fields behind those that we know.
        whole = data[header:end].ljust(definition.unpacker.size, b"\0")
        for name, value in _in_order(definition, definition.unpacker.unpack_from(whole)):
            yield line(name, _shown(value))
    return length


def _clock(ticks: int) -> str:
    return f"{ticks / 1e5:.5f} s since 2015-01-01 UTC"


def _in_order(definition: Any, values: tuple[Any, ...]) -> Iterator[tuple[str, Any]]:
    """Names and values of a message's fields in its own order; `values`: in that of the wire, arrays laid flat."""
    for name, place in zip(definition.fieldnames, definition.orders, strict=True):
        start, count = sum(definition.lengths[:place]), definition.lengths[place]
        yield name, values[start] if count == 1 else values[start : start + count]


def _shown(value: Any) -> str:
    return repr(value.rstrip(b"\0").decode("utf-8", "replace")) if isinstance(value, bytes) else str(value)


def _explain_tunnel(wire: bytes, payload_type: int) -> Iterator[str]:
    try:
        fields = decode_tunnel(wire)
    except MalformedError as error:
        raise UnreadableError(str(error)) from None
    ours = fields.payload_type == payload_type
    yield "TUNNEL"
    yield line("target_system", fields.target_system, "everybody" if not fields.target_system else "")
    yield line("target_component", fields.target_component, "everybody" if not fields.target_component else "")
    yield line("payload_type", fields.payload_type, "rass_mav" if ours else f"not ours, which is {payload_type}")
    yield line("payload_length", len(fields.payload))
    if ours:
        yield from explain_payload(fields.payload)
    else:
        yield line("payload", fields.payload.hex())


def explain_payload(payload: bytes) -> Iterator[str]:
    """Lines about a TUNNEL payload of ours (docs/reference/protocol.md). Raises `UnreadableError`."""
    beside = _BESIDE.get(payload[1]) if payload[:1] == _MORE_HEAD and len(payload) > 1 else None
    try:
        # At time 0, so that the moment of creation is minus the age.
        record: Any = decode(payload, 0.0) if beside is None else _READERS[beside.number](payload)
    except MalformedError as error:
        raise UnreadableError(f"no rass_mav message: {error}") from None
    layout = beside or _LAYOUTS[type(record)]
    yield f"{layout.title} (type {layout.number}, version {payload[0] >> 4}), {len(payload)} bytes"
    if beside is None:
        yield from _fields(record, 1)
        yield from _behind(record, payload)
    else:
        yield from _parts(beside.parts, payload, 2, {}, 1)


def _behind(message: Any, payload: bytes) -> Iterator[str]:
    """What follows the fields: the place and the tags that show other nodes who says it, and unknown blocks."""
    if isinstance(message, CopyStatuses):
        place, tag = tag_of(message, payload)
        if place is not None:
            yield line("place", f"{place:08x}", "low half of the count of what the sender says to single nodes")
            yield from _tags([(tag.hex(), f"for node {message.target}")])
    elif isinstance(message, Committed):
        tag = payload[end_of_fields(message) :]
        if tag:
            yield from _tags([(tag[:TAG_BYTES].hex(), f"for node {message.target}")])
    elif isinstance(message, Beacon | Data):
        start = BEACON_BYTES
        if isinstance(message, Data):
            start = DATA_FIELDS.size + sum(HANDOVER_FIELDS.size + len(h.datum.payload) for h in message.handovers)
        answers = message.answers if isinstance(message, Beacon) else ()
        pairs = zip_longest(tags_in(payload, start), answers)
        tags = [(tag.hex(), f"for node {answer.target}" if answer else "of no answer") for tag, answer in pairs if tag]
        if tags:
            yield from _tags(tags)
        for kind, content in blocks_in(payload, start):
            if kind not in {block.kind for block in BLOCKS}:
                yield line("block", kind, "of a later version")
                yield line("content", content.hex(), depth=2)


def _tags(tags: list[tuple[str, str]]) -> Iterator[str]:
    yield line("tags", len(tags), "not checked: that needs the keys")
    for tag, whose in tags:
        yield line("tag", tag, whose, depth=2)


# -- what nodes with keys say about links and keys ---------------------------------------------------------------------


def _parts(
    parts: Sequence[Part], payload: bytes, at: int, values: dict[str, int], depth: int
) -> Generator[str, None, int]:
    """The parts that begin at `at` in a payload that can be read; returns where they end. `values`: of the fields
    before."""
    for part in parts:
        if isinstance(part, Field):
            size = int(part.type[:-6]) if part.type.endswith(" bytes") else int(part.type[1:]) // 8
            raw = payload[at : at + size]
            at += size
            number = values[part.name] = values[part.counts] = int.from_bytes(raw, "little")
            values |= {flag: number & bit for flag, bit in part.flags}
            shown = raw.hex() if part.type.endswith(" bytes") else str(number)
            if part.type[0] == "x":
                shown = f"{number:0{2 * size}x}"
            note = _KEYED_NOTES.get(part.key or part.name)
            yield line(
                part.title or part.name.replace("_", " "), shown, note(values) if note else part.about, depth=depth
            )
        elif isinstance(part, Rows):
            for _ in range(values[part.name]):
                at = yield from _parts(part.parts, payload, at, values, depth + 1)
        elif isinstance(part, When):
            if bool(values[part.name]) != part.unless:
                at = yield from _parts(part.parts, payload, at, values, depth)
        else:
            node_id, serial, public, signature = _CERTIFICATE.unpack_from(payload, at)
            at += _CERTIFICATE.size
            yield line("certificate", "of the sender")
            yield line("node id", node_id, depth=2)
            yield line("serial", serial, "a base" if not serial else "", depth=2)
            yield line("public key", public.hex(), depth=2)
            yield line("signature", signature.hex(), _UNCHECKED, depth=2)
    return at


_MORE_HEAD = bytes([VERSION << 4 | MORE])
_UNCHECKED = "by the ground; not checked: that needs its public key"
#: What numbers mean, by the key of their field.
_KEYED_NOTES: dict[str, Callable[[dict[str, int]], str]] = {
    "first_serial": lambda v: f"serials of the statements: from {v['first']} on",
    "signature": lambda _: _UNCHECKED,
    "update.flags": lambda v: "revoked" if v["flags"] else "with a key",
}
#: What is no message of core, by the type in its second byte; and what reads it, to find whether it can be read.
_BESIDE = {layout.number: layout for layout in KEYED}
_READERS: dict[int, Callable[[bytes], Any]] = {
    INTRODUCTION: decode_introduction,
    STATEMENT_SIGNATURE: decode_attestation,
    ANCHOR: decode_attestation,
    ASK: decode_attestation,
    KEY_UPDATE: lambda payload: KeyUpdate.unpack(enclosed(payload)),
    KEY_REQUEST: decode_key_request,
}


# -- the fields of messages --------------------------------------------------------------------------------------------


def _fields(record: Any, depth: int) -> Iterator[str]:
    """Every field of a message or a part of one."""
    for name, value in zip(record._fields, record, strict=True):
        if type(record) in _LAYOUTS and name in _LAYOUTS[type(record)].not_sent:
            continue
        yield from _field(record, name, value, depth)


def _field(record: Any, name: str, value: Any, depth: int) -> Iterator[str]:
    if isinstance(value, DatumId):
        yield line(name, value, "origin-epoch-sequence", depth=depth)
    elif isinstance(value, Datum):
        yield line(name, "", depth=depth).rstrip()
        yield from _fields(value, depth + 1)
        contents = _CONTENTS.get(value.kind & ~TERMS)
        open_part, payload = parted(value.kind, value.payload)
        if payload and open_part:
            priority, ttl_s = value.terms
            yield line("priority", priority, f"0..{MOST_PRIORITY}", depth=depth + 1)
            yield line("lifetime", "none" if ttl_s is None else f"{ttl_s} s", depth=depth + 1)
        if contents and value.intact:
            yield from contents(payload, depth + 1)
        elif value.kind & SEALED and len(payload) >= SEAL_SIZE:
            yield line("sealed", f"{len(payload) - SEAL_SIZE} bytes", "contents, encrypted", depth=depth + 1)
            yield line("seal", payload[-SEAL_SIZE:].hex(), "tag; not checked: that needs keys", depth=depth + 1)
    elif isinstance(value, Distance):
        yield line(name, "", "distant replicas", depth=depth)
        yield from _fields(value, depth + 1)
    elif value is None:
        return
    elif isinstance(value, bytes):
        yield line(name, f"{value.hex()}", f"{len(value)} bytes: {value!r}"[:60], depth=depth)
    elif isinstance(value, tuple):
        yield line(name, len(value), depth=depth)
        for one in value:
            if isinstance(one, int):
                yield line("", f"{one:08x}", depth=depth + 1)
            elif not hasattr(one, "_fields"):
                yield line("", f"{one[0]:08x}", f"CRC of the datum {one[1]:08x}", depth=depth + 1)
            elif isinstance(one, DatumId):
                yield line("", one, depth=depth + 1)
            else:
                yield f"{'  ' * (depth + 1)}{type(one).__name__}"
                yield from _fields(one, depth + 2)
    elif name == "created":
        yield line("age", f"{-value:.3f} s", depth=depth)
    else:
        type_ = _TYPES.get((type(record).__name__, name), "")
        shown = f"{value:0{int(type_[1:]) // 4}x}" if type_.startswith("x") and name != "flags" else str(value)
        yield line(name, shown, _note(record, name, value), depth=depth)


def _flags(flags: int) -> str:
    words = {BEACON_BASE: "base", BEACON_WANTED: "wants a newer announcement"}
    return ", ".join(word for bit, word in words.items() if flags & bit) or "none"


def _kind(kind: int) -> str:
    plain = kind & ~(SEALED | TERMS)
    name = Kind(plain).name.lower() if plain in list(Kind) else "unknown"
    return f"{'sealed, ' if kind & SEALED else ''}{name}{', with terms' if kind & TERMS else ''}"


def _potential(value: int) -> str:
    if value == 0xFFFFFFFF:
        return "a base"
    return f"fitness {value / (1 << 24):.6f}" if value else "no room"


def _motion(moves: int) -> str:
    *place, north, east = unpack(moves)
    latitude, longitude = (part * UNIT_DEGREES for part in place)
    circle = (1 << 20) * UNIT_DEGREES
    return (
        f"{latitude:.6f}, {longitude:.6f} degrees and multiples of {circle:.6f}; {north:.2f} m/s north, {east:.2f} east"
    )


def _bits(bitmap: int, first: int) -> str:
    """The numbers that a bitmap names, whose lowest bit means `first`."""
    return ", ".join(str(first + i) for i in range(bitmap.bit_length()) if bitmap >> i & 1)


def _bitmap(record: Any, bitmap: int) -> str:
    behind = record.first + record.run if hasattr(record, "run") else record.next_index + 1
    return f"and {_bits(bitmap, behind)}" if bitmap else ""


def _no_route(beacon: Any, _: int) -> str:
    return "no route" if beacon.hops == NO_ROUTE else ""


#: By a field's name, or by its record's and its own where it means something else elsewhere.
_NOTES: dict[str, Callable[[Any, int], str]] = {
    "target": lambda _, value: "everybody" if value == BROADCAST else "",
    "flags": lambda _, value: _flags(value),
    "Beacon.hops": lambda _, value: "no route" if value == NO_ROUTE else "to that base",
    "Beacon.base": _no_route,
    "Beacon.base_life": _no_route,
    "Beacon.route_number": _no_route,
    "risk": lambda _, value: f"{value / 65535:.3f}",
    "free": lambda _, value: "no bound" if value == UNBOUNDED_FREE else "items",
    "potential": lambda _, value: _potential(value),
    "at_least": lambda _, value: "it may be older" if value else "it is as old as that",
    "kind": lambda _, value: _kind(value),
    "Datum.crc": lambda datum, _: "good" if datum.intact else "BAD: the datum is damaged",
    "reason": lambda _, value: _LOSS_REASONS.get(value, "unknown"),
    "replica": lambda data, value: "custody is offered" if not value else "custody is elsewhere",
    "near": lambda _, value: "the sender keeps a replica for it; who hears it refuses",
    "custodian": lambda _, value: "who hears it refuses",
    "further": lambda _, value: "more copies should go on from the receiver",
    "status": lambda _, value: _COPY_STATUSES[CopyStatus(value)] if value in list(CopyStatus) else "unknown",
    "Handover.number": lambda _, value: "hand-over" if value else "no custody offered",
    "question": lambda _, value: "that it answers" if value else "it answers none",
    "size": lambda _, value: "bytes",
    "chunk_size": lambda _, value: "bytes",
    "moves": lambda _, value: _motion(value) if value else "not told",
    "run": lambda entry, value: f"up to {entry.first + value - 1}",
    "lost": lambda _, value: "told lost" if value else "arrived",
    "bits": lambda _, value: f"it matches one in {1 << value} of the data that have not arrived",
    "assigned": lambda _, value: "the sequences below have been assigned, and no other",
    "bitmap": _bitmap,
    "position": lambda chunk, _: "" if chunk.data else "a question: what has come?",
}


def _note(record: Any, name: str, value: int) -> str:
    """What a number means, where that is not plain."""
    note = _NOTES.get(f"{type(record).__name__}.{name}") or _NOTES.get(name)
    return note(record, value) if note else ""


def _measurement(payload: bytes, depth: int) -> Iterator[str]:
    try:
        measurement = decode_measurement(payload)
    except MalformedError as error:
        yield line("measurement", "unreadable", str(error).partition(":")[0], depth=depth)
        return
    units = {
        "latitude": "degrees",
        "longitude": "degrees",
        "altitude": "metres above mean sea level",
        "error_m": "metres at most, of the position",
    }
    yield line("measurement", "", depth=depth).rstrip()
    for name, value in zip(measurement._fields, measurement, strict=True):
        shown = "unknown" if value is None else f"{value:.7g}" if name in ("reading", "risk") else str(value)
        yield line(name, shown, units.get(name, ""), depth=depth + 1)


def _status(payload: bytes, depth: int) -> Iterator[str]:
    try:
        status = decode_status(payload)
    except MalformedError as error:
        yield line("status", "unreadable", str(error).partition(":")[0], depth=depth)
        return
    yield line("status", "", depth=depth).rstrip()
    for name, value in zip(status._fields, status, strict=True):
        if isinstance(value, Mapping):
            yield line(name, len(value), depth=depth + 1)
            for node_id, one in value.items():
                shown = f"{one:.3f} of its beacons" if name == "neighbours" else f"{one} data"
                yield line(f"node {node_id}", shown, depth=depth + 2)
        else:
            plain = f"{value:.3f}" if name == "risk" else str(value)
            yield line(name, _UNTOLD.get(name, "unknown") if value is None else plain, depth=depth + 1)


_UNTOLD = {"free": "no limit", "hops": "no route"}
#: What is in the payloads of data, by their kind.
_CONTENTS: dict[int, Callable[[bytes, int], Iterator[str]]] = {Kind.MEASUREMENT: _measurement, Kind.STATUS: _status}


def main(arguments: Sequence[str] | None = None) -> int:
    """Explain what is given; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.explain_frame",
        description="Explain MAVLink frames given in hex, down to the fields of rass_mav's own messages.",
        epilog="example: python -m tools.explain_frame --payload 440200030005030201b2a10a0000",
    )
    parser.add_argument("hex", metavar="HEX", nargs="*", help="bytes in hex, spaces allowed; none: read from stdin")
    parser.add_argument("--payload", action="store_true", help="the bytes are a TUNNEL payload, not a whole frame")
    parser.add_argument(
        "--payload-type",
        type=int,
        default=PAYLOAD_TYPE,
        metavar="N",
        help="payload_type of our TUNNEL messages (33200)",
    )
    options = parser.parse_args(arguments)
    try:
        data = from_hex(" ".join(options.hex) if options.hex else sys.stdin.read())
        lines = explain_payload(data) if options.payload else explain_frames(data, options.payload_type)
        for text in lines:
            print(text)
    except UnreadableError as error:
        sys.stdout.flush()
        print(f"explain_frame.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
