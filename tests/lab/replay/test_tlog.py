"""Reading telemetry logs, whole and damaged."""

from __future__ import annotations

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega, common

from rass_mav.lab.medium.tlog import TlogWriter
from rass_mav.lab.replay.tlog import Record, TlogReader
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink.frames import FrameWriter

from .logs import START, Said, vehicle

FLIGHT = vehicle(1, 4, home=(0, 0))


def stored(said: list[Said]) -> list[bytes]:
    """The bytes of each record."""
    out = []
    for at, frame in said:
        file = io.BytesIO()
        TlogWriter(file).record(frame, at)
        out.append(file.getvalue())
    return out


def read(data: bytes) -> tuple[list[Record], TlogReader]:
    reader = TlogReader(io.BytesIO(data))
    records = list(reader)
    assert reader.read == len(records) + reader.rejected
    return records, reader


def frames(data: bytes) -> list[bytes]:
    return [record.raw for record in read(data)[0]]


def test_what_is_written_is_read() -> None:
    records, reader = read(b"".join(stored(FLIGHT)))
    assert [(record.time_us, record.raw) for record in records] == [(round(at * 1e6), raw) for at, raw in FLIGHT]
    assert all(record.frame is not None and record.frame.system_id == 1 for record in records)
    assert reader.rejected == 0


def test_a_log_longer_than_the_buffer() -> None:
    said = vehicle(3, 900)
    parts = stored(said)
    assert sum(map(len, parts)) > 1 << 16
    assert frames(b"".join(parts)) == [raw for _, raw in said]


@given(st.data())
def test_a_truncated_log_gives_all_its_whole_records(data: Any) -> None:
    parts = stored(FLIGHT)
    whole = data.draw(st.integers(0, len(parts) - 1))
    rest = data.draw(st.integers(1, len(parts[whole]) - 1))
    records, reader = read(b"".join(parts[:whole]) + parts[whole][:rest])
    assert [record.raw for record in records] == [raw for _, raw in FLIGHT[:whole]]
    assert reader.rejected == 1


@given(st.data())
def test_a_damaged_frame_costs_one_record(data: Any) -> None:
    """Any byte behind the frame's length and flags: the framing still holds."""
    parts = stored(FLIGHT)
    which = data.draw(st.integers(0, len(parts) - 1))
    damaged = bytearray(parts[which])
    place = data.draw(st.sampled_from([12, 13, 14, *range(18, len(damaged))]))
    damaged[place] ^= data.draw(st.integers(1, 255))
    records, reader = read(b"".join([*parts[:which], bytes(damaged), *parts[which + 1 :]]))
    assert [record.raw for record in records] == [raw for n, (_, raw) in enumerate(FLIGHT) if n != which]
    assert reader.rejected == 1


def test_each_of_two_damaged_neighbours_is_counted() -> None:
    parts = stored(FLIGHT)
    for which in (3, 4):
        parts[which] = parts[which][:-1] + bytes([parts[which][-1] ^ 1])
    records, reader = read(b"".join(parts))
    assert len(records) == len(FLIGHT) - 2
    assert reader.rejected == 2


@pytest.mark.no_cover
@pytest.mark.parametrize("which", range(len(FLIGHT)))
def test_a_changed_length_hides_no_other_record(which: int) -> None:
    """Not even when it ends just where another record does."""
    parts = stored(FLIGHT)
    for length in range(256):
        damaged = bytearray(parts[which])
        if damaged[9] == length:
            continue
        damaged[9] = length
        found = frames(b"".join([*parts[:which], bytes(damaged), *parts[which + 1 :]]))
        assert found == [raw for n, (_, raw) in enumerate(FLIGHT) if n != which], length


@given(st.integers(0, len(FLIGHT)), st.binary(min_size=1, max_size=700))
def test_garbage_between_records_hides_none(where: int, garbage: bytes) -> None:
    parts = stored(FLIGHT)
    records, reader = read(b"".join([*parts[:where], garbage, *parts[where:]]))
    assert [record.raw for record in records] == [raw for _, raw in FLIGHT]
    assert reader.rejected >= 1


@given(st.binary(max_size=2000))
def test_whatever_the_bytes_nothing_is_raised(data: bytes) -> None:
    _, reader = read(data)
    assert reader.read <= len(data)
    assert bool(reader.read) == bool(data)


@given(st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=30))
def test_a_flight_with_any_bytes_overwritten_still_reads(changes: list[tuple[int, int]]) -> None:
    data = bytearray(b"".join(stored(FLIGHT)))
    for place, value in changes:
        data[place % len(data)] = value
    intact = {raw for _, raw in FLIGHT}
    records, _ = read(bytes(data))
    # A checksum of 16 bits: what is read is what was written.
    assert {record.raw for record in records if record.frame is not None} <= intact
    assert len(records) >= len(FLIGHT) - 3 * len(changes)


def test_times_that_go_back_a_little_are_taken_as_they_are() -> None:
    said = [(at - (0.3 if n % 4 == 0 else 0.0), raw) for n, (at, raw) in enumerate(FLIGHT)]
    records, reader = read(b"".join(stored(said)))
    assert [record.time_us for record in records] == [round(at * 1e6) for at, _ in said]
    assert reader.rejected == 0


@pytest.mark.parametrize(
    ("which", "shift"),
    [(which, shift) for which in (0, 5, len(FLIGHT) - 1) for shift in (-86400.0, 20.0, 3e7)] + [(5, -20.0)],
)
def test_a_time_that_nobody_agrees_with_is_rejected(which: int, shift: float) -> None:
    said = [(at + (shift if n == which else 0.0), raw) for n, (at, raw) in enumerate(FLIGHT)]
    records, reader = read(b"".join(stored(said)))
    assert [record.raw for record in records] == [raw for n, (_, raw) in enumerate(FLIGHT) if n != which]
    assert reader.rejected == 1


def test_a_clock_that_is_set_in_flight_costs_nothing() -> None:
    said = [(at - (START if n < 6 else 0.0), raw) for n, (at, raw) in enumerate(FLIGHT)]
    records, _ = read(b"".join(stored(said)))
    assert [record.raw for record in records] == [raw for _, raw in FLIGHT]


def test_a_log_with_long_silences_loses_its_last_record_only() -> None:
    said = [(START + 20.0 * n, raw) for n, (_, raw) in enumerate(FLIGHT)]
    assert frames(b"".join(stored(said))) == [raw for _, raw in said[:-1]]


def test_after_one_long_silence_nothing_is_lost() -> None:
    said = [(at + (3600.0 if n > 5 else 0.0), raw) for n, (at, raw) in enumerate(FLIGHT)]
    assert frames(b"".join(stored(said))) == [raw for _, raw in said]


def test_a_single_record_is_a_log() -> None:
    assert frames(stored(FLIGHT)[0]) == [FLIGHT[0][1]]


def test_messages_beyond_the_dialect_are_read_and_damaged_ones_are_not() -> None:
    message_id = ardupilotmega.MAVLINK_MSG_ID_AHRS
    assert message_id not in common.mavlink_map
    raw = ardupilotmega.MAVLink_ahrs_message(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0).pack(ardupilotmega.MAVLink(None, 1, 1))
    whole = stored([FLIGHT[0], (START, raw), *FLIGHT[1:]])
    records, reader = read(b"".join(whole))
    assert records[1] == Record(round(START * 1e6), raw, None)
    assert reader.rejected == 0
    # One damage in 256 is not seen: the checksum proves 8 of its 16 bits.
    seen = 0
    for bit in range(64):
        damaged = bytearray(whole[1])
        damaged[18 + bit // 8] ^= 1 << bit % 8
        seen += read(b"".join([whole[0], bytes(damaged), *whole[2:]]))[1].rejected
    assert seen >= 60


def test_version_1_frames_and_signed_frames() -> None:
    old = autopilot_heartbeat().pack(common.MAVLink(None, 7, 1), force_mavlink1=True)
    assert old[0] == 0xFE
    mav = common.MAVLink(None, 8, 1)
    mav.signing.secret_key = bytes(32)
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = 1
    signed = autopilot_heartbeat().pack(mav)
    assert signed[2] == 1
    plain = FrameWriter(9, 1).message(autopilot_heartbeat())
    said = [(START, old), (START, bytes(signed)), (START, plain)]
    assert frames(b"".join(stored(said))) == [old, bytes(signed), plain]
