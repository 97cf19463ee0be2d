"""tools/explain_frame.py: whole frames, payloads, and what is neither."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Kind, make_datum
from rass_mav.core.messages import Chunk, Data, Handover, Receipt
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.signing import Signer
from rass_mav.wire import decode, encode
from rass_mav.wire.codec import NUMBERS, VERSION
from rass_mav.wire.measurement import Measurement, encode_measurement
from rass_mav.wire.nodestatus import NodeStatus, encode_status
from tests.trust.test_words import SEVEN
from tests.wire.kinds import beside, examples, type_of
from tools import emulated_pi, spots
from tools.explain_frame import UnreadableError, explain_frames, explain_payload, from_hex, main

ROOT = Path(__file__).parents[1]
EXAMPLES = examples()
BESIDE = beside()
#: Messages between nodes; the others are about links and keys, or show what the ground has signed.
GOLDEN = {name: payload for name, payload in EXAMPLES.items() if type_of(payload) not in BESIDE}
ACCEPT = GOLDEN["accept"]


def frame(payload: bytes, payload_type: int = 33200) -> bytes:
    return FrameWriter(7, 191).tunnel(payload, payload_type=payload_type)


def explained(data: bytes, payload_type: int = 33200) -> dict[str, str]:
    """Last value of each field."""
    return fields(explain_frames(data, payload_type))


def fields(lines: Iterable[str]) -> dict[str, str]:
    found = [re.fullmatch(r"\s+(\S.*?)\s{2,}(\S.*)|\s+(\S+) (\S.*)", text) for text in lines]
    return {(m[1] or m[3]): (m[2] or m[4]) for m in found if m}


@pytest.mark.parametrize("name", GOLDEN)
def test_every_golden_vector_is_explained_with_all_its_fields(name: str) -> None:
    text = list(explain_payload(GOLDEN[name]))
    message = decode(GOLDEN[name], 0.0)
    assert message is not None
    assert f"type {NUMBERS[type(message)]}, version {VERSION}" in text[0]
    absent = {(Chunk, "target"), (Receipt, "senders")}
    absent |= {(Data, f) for f in ("distance",) if getattr(message, f, None) is None}
    on_the_wire = [f for f in type(message)._fields if (type(message), f) not in absent]
    if name.endswith("-tagged"):
        on_the_wire += ["tags"] if hasattr(message, "committed") or hasattr(message, "answers") else ["place", "tags"]
    shown = [line.split()[0] for line in text[1:] if line.startswith("  ") and line[2] != " "]
    assert shown == ["age" if f == "created" else f for f in on_the_wire]


@pytest.mark.parametrize("name", sorted(EXAMPLES.keys() - GOLDEN.keys()))
def test_every_example_of_what_is_beside_the_messages_is_explained(name: str) -> None:
    payload = EXAMPLES[name]
    head = next(explain_payload(payload))
    assert head.startswith(f"{BESIDE[payload[1]]} (type {payload[1]}, version {VERSION}), ")
    assert name.startswith(BESIDE[payload[1]].lower().replace(" ", "-"))
    with pytest.raises(UnreadableError):
        list(explain_payload(payload[:-1]))


@pytest.mark.parametrize("name", EXAMPLES)
def test_no_byte_is_left_out(name: str) -> None:
    payload = EXAMPLES[name]
    text = list(explain_payload(payload))
    for at in range(len(payload)):
        other = payload[:at] + bytes([payload[at] ^ 1]) + payload[at + 1 :]
        with suppress(UnreadableError):
            assert list(explain_payload(other)) != text


def test_what_is_beside_the_messages_is_told_field_by_field() -> None:
    found = list(explain_payload(EXAMPLES["introduction-certificate"]))
    public = SEVEN.certificate.public.hex()
    assert [line.split()[-1] for line in found if line.startswith("    public key")] == [public]
    found = list(explain_payload(EXAMPLES["introduction-proofs"]))
    assert "  place                    0a0b0c0d00000005  (the sender's last one)" in found
    assert "    tag                    0001020304050607" in found
    found = list(explain_payload(EXAMPLES["introduction-question"]))
    assert [line.split()[-1] for line in found if line.startswith("    node id")] == ["7", "8"]
    statement_signature = fields(explain_payload(EXAMPLES["statement-signature"]))
    assert statement_signature["first"] == "513  (serials of the statements: from 513 on)"
    assert (statement_signature["salt"].split()[0], statement_signature["hash"]) == ("01020304", "2229c4178efc0396")
    anchor = fields(explain_payload(EXAMPLES["anchor"]))
    assert (anchor["first"].split()[0], anchor["anchor"]) == ("40", "a0a1a2a3a4a5a6a7")
    assert anchor["signature"].startswith(EXAMPLES["anchor"][-64:].hex())
    ask = list(explain_payload(EXAMPLES["ask"]))
    assert [line.split()[-1] for line in ask if line.startswith("    serial")] == ["513", "515"]
    key_update = fields(explain_payload(EXAMPLES["key-update"]))
    assert key_update["number"].startswith("2  (of the link key")
    assert key_update["node id"] == "7  (of the drone)"
    assert key_update["sealed key"].startswith(EXAMPLES["key-update"][13:61].hex())
    revoked = fields(explain_payload(EXAMPLES["key-update-revoked"]))
    assert revoked["flags"] == "1  (revoked)"
    assert "sealed key" not in revoked
    assert fields(explain_payload(EXAMPLES["key-request"]))["number"] == "1  (of the sender's link key)"


def test_tags_are_told_with_whom_they_are_for() -> None:
    answers = fields(explain_payload(EXAMPLES["beacon-answers-tagged"]))
    assert answers["tag"] == f"{EXAMPLES['beacon-answers-tagged'][-8:].hex()}  (for node 3)"
    assert fields(explain_payload(EXAMPLES["committed-tagged"]))["tag"] == answers["tag"]
    words = fields(explain_payload(EXAMPLES["copy-statuses-tagged"]))
    tag = EXAMPLES["copy-statuses-tagged"][-8:].hex()
    assert (words["place"].split()[0], words["tag"]) == ("00000005", f"{tag}  (for node 3)")


def test_blocks_of_later_versions_are_shown_as_they_are() -> None:
    found = fields(explain_payload(EXAMPLES["data"] + b"\x09\x02ab"))
    assert (found["block"], found["content"]) == ("9  (of a later version)", "6162")
    assert "block" not in fields(explain_payload(EXAMPLES["data"]))


def test_sealed_data_and_statuses_are_taken_apart() -> None:
    found = fields(explain_payload(EXAMPLES["data-sealed"]))
    assert found["kind"] == "129  (sealed, measurement)"
    assert found["sealed"] == "10 bytes  (contents, encrypted)"
    assert found["seal"].startswith(EXAMPLES["data-sealed"][-16:].hex())
    status = NodeStatus(5, 2, 3, None, 0.25, None, 80, (47.5, 8.25), {8: 1.0}, {7: 2}, next_hop=8, link_key=2)
    datum = make_datum(DatumId(7, 0xABCD, 4), Kind.STATUS, -3.0, encode_status(status))
    (wire,) = encode(Data(7, 8, (Handover(1, datum),)), 0.0)
    found = fields(explain_payload(wire))
    assert [found[name] for name in ("held", "free", "hops", "battery", "place")] == [
        "5", "no limit", "no route", "80", "(47.5, 8.25)"
    ]  # fmt: skip
    assert (found["node 8"], found["node 7"], found["link_key"]) == ("1.000 of its beacons", "2 data", "2")


def test_a_whole_frame() -> None:
    data = frame(ACCEPT)
    text = "\n".join(explain_frames(data, 33200))
    assert text.startswith(f"MAVLink 2 frame, {len(data)} bytes")
    found = explained(data)
    assert found["system id"] == "7"
    assert found["component id"] == "191"
    assert found["message id"] == "385  (TUNNEL)"
    assert found["checksum"] == f"0x{data[-1]:02x}{data[-2]:02x}  (good)"
    assert found["payload_length"] == str(len(ACCEPT))
    assert found["number"] == "01020305"
    assert found["handle"] == "a1b2"


def test_meanings_are_told_beside_the_numbers() -> None:
    beacon = fields(explain_payload(GOLDEN["beacon-drone"]))
    assert beacon["risk"] == "16384  (0.250)"
    assert beacon["potential"] == "8388608  (fitness 0.500000)"
    assert fields(explain_payload(GOLDEN["beacon-base"]))["flags"] == "1  (base)"
    assert fields(explain_payload(GOLDEN["beacon-request"]))["hops"] == "255  (no route)"
    assert fields(explain_payload(GOLDEN["sack"]))["bitmap"] == "5  (and 11, 13)"
    assert fields(explain_payload(GOLDEN["deletion-report"]))["reason"] == "1  (corrupted)"


def test_a_measurement_is_taken_apart_and_its_checksum_is_checked() -> None:
    payload = encode_measurement(Measurement(47.5, 8.25, 412.5, 0.75, 1.0))
    datum = make_datum(DatumId(7, 0xABCD, 4), Kind.MEASUREMENT, -3.0, payload)
    (wire,) = encode(Data(7, 8, (Handover(1, datum),)), 0.0)
    found = fields(explain_payload(wire))
    assert found["latitude"] == "47.5  (degrees)"
    assert found["altitude"] == "412.5  (metres above mean sea level)"
    assert found["reading"] == "0.75"
    assert found["unit"] == "unknown"
    assert found["age"] == "3.000 s"
    assert found["crc"].endswith("(good)")
    (wire,) = encode(Data(7, 8, (Handover(1, datum._replace(crc=datum.crc ^ 1)),)), 0.0)
    damaged = fields(explain_payload(wire))
    assert "BAD" in damaged["crc"]
    assert "latitude" not in damaged
    payload = encode_measurement(Measurement(47.5, 8.25, 412.5, 0.75, 1.0, None, "usvh", 3.2))
    datum = make_datum(DatumId(7, 0xABCD, 4), Kind.MEASUREMENT, -3.0, payload)
    (wire,) = encode(Data(7, 8, (Handover(1, datum),)), 0.0)
    found = fields(explain_payload(wire))
    assert (found["unit"], found["error_m"]) == ("usvh", "3.2  (metres at most, of the position)")


def test_a_signed_frame() -> None:
    data = FrameWriter(7, 191, Signer(bytes(32), 3, 1_000_000)).tunnel(ACCEPT, payload_type=33200)
    found = explained(data)
    assert found["incompatibility flags"] == "0x01  (signed)"
    assert found["signature link id"] == "3"
    assert found["signature timestamp"].startswith("1000000  (counts the frames of the stream")
    assert found["signature"].startswith(data[-6:].hex())
    assert found["handle"] == "a1b2"


def test_other_messages_are_named_field_by_field() -> None:
    writer = FrameWriter(7, 1)
    found = explained(writer.message(common.MAVLink_named_value_float_message(5, b"RAD", 1.5)))
    assert (found["name"], found["value"], found["time_boot_ms"]) == ("'RAD'", "1.5", "5")
    # Text in the middle of the wire, then fields of an extension.
    found = explained(writer.message(common.MAVLink_statustext_message(4, b"all well", 9, 2)))
    assert (found["severity"], found["text"], found["id"], found["chunk_seq"]) == ("4", "'all well'", "9", "2")
    speeds = list(range(8))
    version = common.MAVLink_autopilot_version_message(5, 1, 2, 3, 4, speeds, [7] * 8, [0] * 8, 11, 12, 13)
    found = explained(writer.message(version))
    assert found["flight_custom_version"] == str(tuple(speeds))
    assert (found["vendor_id"], found["uid"]) == ("11", "13")


def test_mavlink_1() -> None:
    mav = common.MAVLink(None, 9, 1)
    mav.mavlink20 = lambda: False
    heartbeat = mav.heartbeat_encode(2, 3, 81, 0, 4).pack(mav, force_mavlink1=True)
    found = explained(heartbeat)
    assert found["message id"] == "0  (HEARTBEAT)"
    assert found["checksum"].endswith("(good)")
    assert found["system id"] == "9"


def test_another_payload_type_is_not_ours() -> None:
    found = explained(frame(ACCEPT, 211))
    assert found["payload_type"] == "211  (not ours, which is 33200)"
    assert found["payload"] == ACCEPT.hex()
    assert explained(frame(ACCEPT, 40000), payload_type=40000)["handle"] == "a1b2"


def test_frames_follow_each_other_and_spaces_do_not_matter(capsys: pytest.CaptureFixture[str]) -> None:
    two = frame(ACCEPT) + frame(GOLDEN["sack"])
    assert main([two.hex(" ")]) == 0
    first = capsys.readouterr().out
    assert first.count("MAVLink 2 frame") == 2
    assert main([two[:5].hex(":"), "0x" + two[5:].hex()]) == 0
    assert capsys.readouterr().out == first


def test_from_stdin(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(ACCEPT.hex() + "\n"))
    assert main(["--payload"]) == 0
    assert capsys.readouterr().out.startswith("Accept")


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (["hello"], "not hex: 'h'"),
        ([""], "no hex digits"),
        (["fd0"], "half a byte"),
        (["0102030405"], "no MAVLink frame"),
        (["fd05"], "cut off"),
        ([frame(ACCEPT).hex()[:-6]], "cut off"),
        (["fd00" + "80" + frame(ACCEPT).hex()[6:]], "incompatibility flags"),
        ([frame(ACCEPT).hex() + "00"], "no MAVLink frame"),
        ([frame(b"\x4f").hex()], "type 15 is not known"),
        (["--payload", "1402"], f"version 1, ours is {VERSION}"),
        (["--payload", "4402"], "truncated"),
    ],
)
def test_garbage_is_one_line_and_exit_code_1(given: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(given) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert reason in said


def test_a_wrong_checksum_is_told_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(frame(ACCEPT))
    data[15] ^= 0x40
    assert main([data.hex()]) == 1
    output = capsys.readouterr()
    assert "BAD, should be" in output.out
    assert "the checksum is wrong" in output.err


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_are_explained_or_refused(data: bytes, whole: bool) -> None:
    try:
        lines = list(explain_frames(data, 33200) if whole else explain_payload(data))
    except UnreadableError:
        return
    assert lines or not data


@given(st.binary(min_size=1))
def test_hex_in_any_spelling(data: bytes) -> None:
    assert from_hex(data.hex()) == from_hex(data.hex(",").upper()) == data


def test_as_a_program() -> None:
    page = (ROOT / "tools" / "README.md").read_text(encoding="utf-8")
    [shown] = re.findall(r"^    python (.* --payload) " + ACCEPT.hex() + "$", page, re.M)
    command = [sys.executable, *shown.split()]
    # As in a shell: only what the environment has installed, and the present folder.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    options: dict[str, Any] = {"env": environment, "cwd": ROOT, "capture_output": True, "text": True}
    good = subprocess.run([*command, ACCEPT.hex()], check=False, timeout=60, **options)
    assert (good.returncode, good.stderr) == (0, "")
    printed = page.split("prints:")[1].split("\n## ")[0]
    example = "\n".join(line[4:] for line in printed.splitlines() if line.startswith("    "))
    assert good.stdout.rstrip() == example
    bad = subprocess.run([*command, "ff"], check=False, timeout=60, **options)
    assert (bad.returncode, bad.stdout, len(bad.stderr.splitlines())) == (1, "", 1)


def test_what_the_emulated_systems_need_is_said_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    assert emulated_pi.main(["armhf"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "debootstrap" in line
    assert "qemu-arm-static" in line
    assert "qemu-aarch64-static" not in line


def test_a_process_takes_memory_that_is_not_the_emulators() -> None:
    # Without an emulator only the code does not count.
    assert 1 < emulated_pi.memory_mib(os.getpid()) < 10_000


def test_sources_and_hot_spots_are_compared_with_where_the_sources_are(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("numpy", reason="numpy is not installed (extra ground)")
    short = ("--set", "steps=80", "--set", "data.until_step=70", "--set", "radiation.strength=[3e5,1e6]")
    spots.main(["field-sources", "--seeds", "1", *short])
    _, _, row = capsys.readouterr().out.splitlines()
    seed, found, errors, covered, areas, _, away = (cell.strip() for cell in row.strip("|").split("|"))
    assert (seed, found, covered) == ("1", "2 of 2", "2")
    assert all(float(error) < 20.0 for error in errors.split(", "))
    assert len(areas.split(", ")) == len(away.split(", ")) == 2
