"""tools/rass.lua: what Wireshark shows of our frames is what `rass_mav.wire` reads in them."""

from __future__ import annotations

import json
import re
import shutil
import struct
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from rass_mav.core.datum import TERMS, DatumId, Kind, make_datum
from rass_mav.core.messages import (
    Accept,
    Chunk,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
    ReceiptEntry,
    Report,
    Sack,
)
from rass_mav.core.news.statements import make_receipt
from rass_mav.core.seals import SEALED
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.signing import Signer
from rass_mav.trust.keys.key_updates import KeyUpdate
from rass_mav.wire import decode, encode
from rass_mav.wire.attestation import Ask, Signed, StatementSignature
from rass_mav.wire.codec import VERSION
from rass_mav.wire.introduction import Introduction
from rass_mav.wire.key_updates import KeyRequest
from rass_mav.wire.measurement import Measurement, encode_measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.patience import PATIENCE_S
from tests.wire.kinds import beside, blocks, examples, type_of
from tools.explain_frame import _READERS, UnreadableError, explain_payload

TSHARK = shutil.which("tshark")
pytestmark = pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian: apt install tshark)")

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "tools" / "rass.lua"
EXAMPLES = examples()
#: Messages between nodes; the others are about links and keys, or show what the ground has signed.
GOLDEN = {name: payload for name, payload in EXAMPLES.items() if type_of(payload) not in beside()}

#: The port that the script knows; on others it finds our frames by their content.
PORT = 14600
LINKTYPE_RAW = 101

#: A field of our messages -> its name in Wireshark, where that is another one.
NAMES = {
    "Beacon.number": "beacon", "Datum.hops": "datum_hops", "Offer.hops": "datum_hops",
    "DeletionEntry.proof": "report_proof",
}  # fmt: skip

Shown = dict[str, list[str]]


def pcap(datagrams: Sequence[bytes], port: int) -> bytes:
    """A capture file with a UDP datagram a packet (https://wiki.wireshark.org/Development/LibpcapFileFormat)."""
    packets = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, LINKTYPE_RAW)]
    for number, data in enumerate(datagrams):
        udp = struct.pack(">HHHH", port, port, 8 + len(data), 0) + data
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 1, 17, 0, b"\x7f\0\0\1", b"\x7f\0\0\1") + udp
        packets.append(struct.pack("<IIII", number, 0, len(ip), len(ip)) + ip)
    return b"".join(packets)


def leaves(layer: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """All fields of tshark's JSON, however deep, as (name, value)."""
    if isinstance(layer, dict):
        for key, value in layer.items():
            yield from leaves(value, key)
    elif isinstance(layer, list):
        for value in layer:
            yield from leaves(value, name)
    else:
        yield name, layer


def shown(directory: Path, datagrams: Sequence[bytes], port: int = PORT, *options: str) -> list[Shown]:
    """What tshark shows of each datagram: our fields with their values in order."""
    assert TSHARK is not None
    file = directory / "air.pcap"
    file.write_bytes(pcap(datagrams, port))
    command = [TSHARK, "-r", str(file), "-X", f"lua_script:{SCRIPT}", "-T", "json", "--no-duplicate-keys", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert "rass.lua" not in done.stderr
    found = []
    for packet in json.loads(done.stdout):
        fields: Shown = {}
        for name, value in leaves(packet["_source"]["layers"]):
            if name.startswith("rass"):
                fields.setdefault(name, []).append(value)
        found.append(fields)
    return found


def said(record: Any, now: float = 0.0) -> Iterator[tuple[str, int | bytes]]:
    """All fields of a message as the dissector names them. `created` is an age on the wire."""
    kind = type(record).__name__
    # Blocks with answers are the last ones.
    for name, value in sorted(zip(record._fields, record, strict=True), key=lambda field: field[0] == "answers"):
        if (
            (kind, name) == ("Chunk", "target")
            or value is None
            or (name in ("moves", "proof", "key", "updates", "senders", "data") and not value)
        ):
            continue  # not on the wire
        if name == "created":
            yield "age", round((now - value) * 1000)
        elif name in ("handovers", "entries", "ids", "others"):
            yield "count", len(value)
            for each in value:
                yield from said(each, now)
        elif name in ("answers", "distance", "moves", "proof", "key", "updates") and kind != "DeletionEntry":
            yield from said_in_a_block(name, value)
        elif name in ("committed", "refused"):
            yield name, len(value)
            names = ("number", "crc") if name == "committed" else ("refused_number",)
            for each in value:
                yield from zip(names, each if name == "committed" else (each,), strict=True)
        elif hasattr(value, "_fields"):
            if name == "distance":
                yield from [("block", 2), ("block_size", 5)]
            yield from said(value, now)
        elif name == "payload":
            yield from said_of_a_payload(value, record.kind)
        elif name == "bitmap":
            size = (value.bit_length() + 7) // 8
            chunks = kind in ("Accept", "Sack", "Report")
            yield "bitmap_size" if chunks else "entry_size", size
            if size:
                yield name if chunks else "entry_bitmap", value.to_bytes(size, "little")
        else:
            yield NAMES.get(f"{kind}.{name}", name), value


def said_of_a_payload(payload: bytes, kind: int) -> Iterator[tuple[str, int | bytes]]:
    yield "size", len(payload)
    yield "payload", payload
    if kind & TERMS:
        yield from [("priority", payload[0]), ("lifetime", int.from_bytes(payload[1:4], "little"))]
        payload = payload[4:]
    if kind & SEALED:
        yield from [("sealed", payload[:-16]), ("seal", payload[-16:])]


def said_in_a_block(name: str, value: Any) -> Iterator[tuple[str, int | bytes]]:
    if name == "distance":
        yield from [("block", 2), ("block_size", 5), *said(value)]
    elif name == "moves":
        yield from [("block", 3), ("block_size", 8), (name, value)]
    elif name == "proof":
        yield from [("block", 4), ("block_size", 8), (name, value)]
    elif name == "key":
        yield from [("block", 6), ("block_size", 8), (name, value)]
    elif name == "updates":
        yield from [("block", 7), ("block_size", 4), (name, value)]
    elif value:
        yield "block", 1
        yield "block_size", sum(4 + 8 * len(each.committed) + 4 * len(each.refused) for each in value)
        for each in value:
            # Their sender is the message's.
            yield from list(said(each))[1:]


def said_beside(record: Any) -> Iterator[tuple[str, int | bytes]]:
    """All fields of a payload that is no message between nodes."""
    if isinstance(record, Signed):
        content, _, signature = record[1:]
        yield from [("base", content.base), ("base_life", content.base_life)]
        if isinstance(content, StatementSignature):
            yield from [("first_serial", content.first), ("salt", content.salt), ("count", len(content.hashes))]
            yield from [("hash", one) for one in content.hashes]
        else:
            yield from [("chain", content.serial), ("first_number", content.first)]
            yield "anchor", content.element
        yield "signature", signature
    elif isinstance(record, Ask):
        yield from [("bases", len(record.bases)), ("statements", len(record.statements))]
        for row in (*record.bases, *record.statements):
            yield from list(zip(("base", "base_life", "serial"), row, strict=False))
    elif isinstance(record, Introduction):
        yield from [("sender", record.sender), ("introduction.flags", bool(record.certificate) + 2 * record.wants)]
        yield from [("introduction.flags.certificate", bool(record.certificate))]
        yield from [("introduction.flags.wanted", record.wants)]
        yield from [("asked", len(record.asked)), ("proofs", len(record.proofs))]
        if record.certificate:
            node_id, serial, public, signature = struct.unpack("<HI32s64s", record.certificate)
            yield from [("node_id", node_id), ("node_serial", serial)]
            yield from [("public_key", public), ("signature", signature)]
        yield from [("nonce", record.nonce)] * bool(record.asked)
        yield from [("node_id", node_id) for node_id in record.asked]
        if record.proofs:
            place, beacon, key, next_end = record.whereabouts
            yield from [("place", place), ("introduction.beacon", beacon)]
            yield from [("key", key), ("introduction.next_end", next_end)]
        for node_id, tag in record.proofs:
            yield "node_id", node_id
            yield "tag", tag
    elif isinstance(record, KeyUpdate):
        yield from [("update.flags", not record.sealed), ("link_key", record.number)]
        yield from [("node_id", record.node_id), ("node_serial", record.serial)]
        yield from [("sealed_key", record.sealed)] * bool(record.sealed)
        yield "signature", record.signature
    else:
        assert isinstance(record, KeyRequest)
        yield from [("node_id", record.node_id), ("node_serial", record.serial), ("link_key", record.number)]


_BYTES = {
    f"rass.{name}"
    for name in (
        "payload", "data", "bitmap", "entry_bitmap", "block_content", "proof", "key",
        "introduction.next_end", "report_proof",
        "sealed", "seal", "tag", "public_key", "signature", "hash", "anchor", "sealed_key",
    )
}  # fmt: skip


def read(name: str, text: str) -> int | bytes:
    if name in _BYTES:
        return bytes.fromhex(text.replace(":", ""))
    if text in ("True", "False"):
        return int(text == "True")
    return int(text, 0)


def assert_shows(fields: Shown, message: Message) -> None:
    # The tags are no part of the message.
    blocks = zip(fields.get("rass.block", []), fields.get("rass.block_size", []), strict=True)
    kept = [block for block in blocks if block[0] != "5"]
    if kept:
        fields = fields | {"rass.block": [kind for kind, _ in kept], "rass.block_size": [size for _, size in kept]}
    hidden = r"version|type|flags\.|proven|flags_tree|beacon_crc|measurement|status\.|tag$|place$|node_id$"
    assert_equal(fields, said(message), hidden)


def assert_equal(fields: Shown, told: Iterator[tuple[str, int | bytes]], hidden: str) -> None:
    expected: dict[str, list[int | bytes]] = {}
    for name, value in told:
        expected.setdefault(f"rass.{name}", []).append(value)
    ours = {
        name: values
        for name, values in fields.items()
        if name.startswith("rass.") and not re.match(rf"rass\.({hidden})", name)
    }
    assert {name: [read(name, value) for value in values] for name, values in ours.items()} == expected


def frame(payload: bytes, writer: FrameWriter | None = None, payload_type: int = 33200) -> bytes:
    return (writer or FrameWriter(7, 191)).tunnel(payload, payload_type=payload_type)


def decoded(payload: bytes) -> Message:
    message = decode(payload, 0.0)
    assert message is not None
    return message


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Shown]:
    found = shown(tmp_path_factory.mktemp("golden"), [frame(payload) for payload in GOLDEN.values()])
    return dict(zip(GOLDEN, found, strict=True))


@pytest.fixture(scope="module")
def shown_beside(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Shown]:
    names = EXAMPLES.keys() - GOLDEN.keys()
    found = shown(tmp_path_factory.mktemp("beside"), [frame(EXAMPLES[name]) for name in names])
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("name", sorted(EXAMPLES.keys() - GOLDEN.keys()))
def test_every_field_of_what_is_beside_the_messages_is_shown(name: str, shown_beside: dict[str, Shown]) -> None:
    fields = shown_beside[name]
    assert fields["rass.type_more"] == [str(EXAMPLES[name][1])]
    assert "rass.malformed" not in fields
    assert_equal(fields, said_beside(_READERS[EXAMPLES[name][1]](EXAMPLES[name])), "version|type|.*_tree")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("committed-tagged", {"tag": ["d6a91f1ca57aae4f"]}),
        ("beacon-answers-tagged", {"tag": ["d6a91f1ca57aae4f"], "block": ["6", "1", "5"]}),
        ("copy-statuses-tagged", {"place": ["5"], "tag": ["fccb20cd23548b10"]}),
    ],
)  # fmt: skip
def test_tags_are_shown_with_whom_they_are_for(name: str, told: dict[str, list[str]], golden: dict[str, Shown]) -> None:
    found = {field: golden[name].get(f"rass.{field}", []) for field in told}
    found["tag"] = [tag.replace(":", "") for tag in found["tag"]]
    if "place" in found:
        found["place"] = [str(int(place, 0)) for place in found["place"]]
    assert found == told


def test_statuses_are_taken_apart(tmp_path: Path) -> None:
    status = NodeStatus(5, 2, 3, None, 0.25, None, 80, (47.5, -8.25), {8: 1.0, 9: 0.0}, {7: 2}, True, 8, 0x10001)
    payloads = [encode_status(status), encode_status(status)[:-1], encode_status(status._replace(link_key=None))]
    data = [make_datum(DatumId(7, 0xABCD, 4), Kind.STATUS, -3.0, payload) for payload in payloads]
    sent = [encode(Data(7, 8, (Handover(1, datum),)), 0.0)[0] for datum in data]
    found = shown(tmp_path, [frame(part) for part in sent])
    for fields, part in zip(found, sent, strict=True):
        assert_shows(fields, decoded(part))
    whole, cut, less = (
        {name[12:]: [int(value, 0) for value in values] for name, values in fields.items() if "status" in name}
        for fields in found
    )
    assert whole == {
        "version": [1], "flags": [15], "held": [5], "alone": [2], "spares": [3], "free": [65535], "risk": [16384],
        "hops": [255], "battery": [80], "latitude": [475000000], "longitude": [-82500000], "neighbours": [2],
        "neighbour": [8, 9], "share": [255, 0], "origins": [1], "origin": [7], "created": [2], "link_key": [0x10001],
    }  # fmt: skip
    assert cut == {name: value for name, value in whole.items() if name != "link_key"}
    assert less == {**cut, "flags": [7]}


@pytest.mark.parametrize("name", GOLDEN)
def test_every_field_of_every_golden_vector_is_shown(name: str, golden: dict[str, Shown]) -> None:
    fields = golden[name]
    assert fields["rass.version"] == [str(VERSION)]
    assert fields["rass.type"] == [str(GOLDEN[name][0] & 15)]
    assert fields["rass_mavlink.checksum_good"] == ["1"]
    assert fields["rass_mavlink.system"] == ["7"]
    assert fields["rass_mavlink.payload_length"] == [str(len(GOLDEN[name]))]
    assert_shows(fields, decoded(GOLDEN[name]))


def test_full_frames_and_measurements(tmp_path: Path) -> None:
    plain = Measurement(47.5, -8.25, 412.5, 0.75, 1.0)
    payload = encode_measurement(plain)
    datum = make_datum(DatumId(7, 0xABCD, 4), Kind.MEASUREMENT, -3.0, payload)
    told = [
        make_datum(DatumId(7, 0xABCD, 5), Kind.MEASUREMENT, -3.0, encode_measurement(plain._replace(**more)))
        for more in ({"unit": "cpm", "error_m": 12.8}, {"unit": "counts"}, {"error_m": 2.5})
    ]
    cut = make_datum(DatumId(7, 0xABCD, 6), Kind.MEASUREMENT, -3.0, told[0].payload[:-1])
    messages: list[Message] = [
        Data(7, 8, (Handover(1, datum), Handover(2, datum))),
        Data(7, 8, (Handover(1, datum._replace(at_least=True)),), True),
        *(Data(7, 8, (Handover(1, each),)) for each in (*told, cut)),
        Chunk(65535, 0xFFFF, 16383, True, bytes(range(123))),
        Sack(1, 65535, 2, 3, (1 << 256) - 1),
        Sack(1, 65535, 2, 3, (1 << 256) - 1, 16383, (Report(4, 5, (1 << 128) - 1),) * 3),
        Accept(1, 65535, 2, 3, 4, (1 << 256) - 1),
        make_receipt(1, 2, 3, [ReceiptEntry(n, n + 1, 100 * n, n + 3, 2 * n, n % 2 == 0) for n in range(1, 9)]),
        make_receipt(1, 2, 4, [ReceiptEntry(1, 2, 0, 0xFFFFFF00, (1 << 128) - 2, False)]),
        CopyStatuses(7, 8, tuple(CopyStatusEntry(DatumId(n, n + 1, n + 2), n) for n in range(10))),
    ]
    payloads = [part for message in messages for part in encode(message, 0.0)]
    fields = shown(tmp_path, [frame(part) for part in payloads])
    for one, part in zip(fields, payloads, strict=True):
        assert_shows(one, decoded(part))
    assert fields[0]["rass.measurement.latitude"] == ["475000000", "475000000"]
    assert fields[0]["rass.measurement.longitude"][0] == "-82500000"
    assert fields[0]["rass.measurement.altitude"][0] == "412500"
    assert float(fields[0]["rass.measurement.reading"][0]) == 0.75
    assert fields[0]["rass.measurement.risk"][0] == "65535"
    shown_of = [[one.get(f"rass.measurement.{name}") for name in ("risk", "unit", "error")] for one in fields[1:6]]
    risk = ["65535"]
    assert shown_of == [
        [risk, None, None], [risk, ["2"], ["128"]], [risk, ["4"], None], [risk, None, ["25"]], [None] * 3
    ]  # fmt: skip


def test_signed_frames_and_several_in_one_datagram(tmp_path: Path) -> None:
    signed = frame(GOLDEN["accept"], FrameWriter(7, 191, Signer(bytes(32), 3, 1_000_000)))
    heartbeat = FrameWriter(9, 1).message(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
    alone, three = shown(tmp_path, [signed, heartbeat + signed + frame(GOLDEN["sack"])])
    assert alone["rass_mavlink.signature_link"] == ["3"]
    assert int(alone["rass_mavlink.signature_timestamp"][0]) >= 1_000_000
    assert alone["rass_mavlink.signature"] == [signed[-6:].hex(":")]
    assert_shows(alone, decoded(GOLDEN["accept"]))
    assert three["rass_mavlink.message_id"] == ["0", "385", "385"]
    assert three["rass.type"] == ["4", "6"]


def test_on_another_port_ours_are_found_and_others_left_alone(tmp_path: Path) -> None:
    heartbeat = FrameWriter(9, 1).message(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
    damaged = bytearray(frame(GOLDEN["accept"]))
    damaged[20] ^= 1
    found = shown(
        tmp_path, [frame(GOLDEN["accept"]), frame(GOLDEN["accept"], payload_type=211), heartbeat, bytes(damaged)], 40001
    )
    assert [fields.get("rass.type") for fields in found] == [["4"], None, None, None]


def test_a_swarm_with_its_own_payload_type(tmp_path: Path) -> None:
    datagrams = [frame(GOLDEN["accept"], payload_type=40000), frame(GOLDEN["accept"])]
    found = shown(tmp_path, datagrams, PORT, "-o", "rass_mavlink.payload_type:40000")
    assert [fields.get("rass.type") for fields in found] == [["4"], None]
    assert found[1]["rass_mavlink.payload_type"] == ["33200"]


def test_blocks_of_later_versions_are_shown_as_they_are(tmp_path: Path) -> None:
    distant = GOLDEN["data-distant"]
    payload = distant[:-7] + b"\x09\x02ab" + distant[-7:] + b"\x0a\0"
    assert not {9, 10} & blocks().keys()
    (fields,) = shown(tmp_path, [frame(payload)])
    assert fields["rass.block"] == ["9", "2", "10"]
    assert fields["rass.block_content"] == ["61:62"]
    for name in ("rass.block", "rass.block_size", "rass.block_content"):
        del fields[name]
    fields |= {"rass.block": ["2"], "rass.block_size": ["5"]}
    assert_shows(fields, decoded(distant))


def test_damage_is_said_and_nothing_breaks(tmp_path: Path) -> None:
    """Every way to cut off every example, too many of something, other versions and types, a wrong checksum."""
    cut = [payload[:size] for payload in EXAMPLES.values() for size in range(1, len(payload))]
    # Each count and each flag of what is beside the messages, one too high and much too high.
    for name, places in (
        ("introduction-question", (2, 4, 5, 6)),
        ("statement-signature", (16,)),
        ("introduction-certificate", (4, 5, 6)),
        ("ask", (2, 3)),
        ("key-update", (2,)),
    ):
        for at in places:
            long = EXAMPLES[name].ljust(128, b"\0")
            cut += [long[:at] + bytes([value]) + long[at + 1 :] for value in (0, 1, 2, 4, 5, 6, 8, 9, 10, 35, 36, 255)]
    cut += [EXAMPLES["introduction-question"][:2] + b"\xff\xff" + EXAMPLES["introduction-question"][4:]]
    flipped = bytearray(GOLDEN["beacon-slow"])
    flipped[29] ^= 1
    cut.append(bytes(flipped))
    strange = [b"\x11" + bytes(40), b"\x4f" + bytes(40)]
    damaged = bytearray(frame(GOLDEN["accept"]))
    damaged[20] ^= 1
    *short, version, kind, checksum = shown(tmp_path, [*map(frame, cut + strange), bytes(damaged)])
    for payload, fields in zip(cut, short, strict=True):
        try:
            list(explain_payload(payload))
        except UnreadableError:
            assert "rass.malformed" in fields, payload.hex()
        else:
            assert "rass.malformed" not in fields, payload.hex()
        assert "rass.foreign" not in fields
    assert "rass.foreign" in version
    assert "rass.foreign" in kind
    assert checksum["rass_mavlink.checksum_good"] == ["0"]
    assert "rass.type" not in checksum


def test_a_message_of_zeros_comes_back_whole(tmp_path: Path) -> None:
    """MAVLink 2 trims zeros."""
    (payload,) = encode(Accept(*([0] * 5)), 0.0)
    trimmed = frame(payload)
    assert len(trimmed) < 20
    (fields,) = shown(tmp_path, [trimmed])
    assert_shows(fields, decoded(payload))
