"""Frames and TUNNEL are, byte for byte, what pymavlink writes and reads."""

from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.errors import MalformedError
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.tunnel import TunnelFields, decode_tunnel, tunnel_from_datagram

from . import pymav

u8 = st.integers(0, 255)
u16 = st.integers(0, 0xFFFF)
# Zeros at the end are trimmed on the wire, so data have them often.
tunnel_data = st.one_of(
    st.binary(max_size=128),
    st.builds(lambda head, zeros: (head + bytes(zeros))[:128], st.binary(max_size=20), st.integers(0, 128)),
)
# No deadline: the first example pays for what the others find ready.
unhurried = settings(deadline=None)

# Whole frames as pymavlink 2.4.50 wrote them.
GOLDEN_TUNNEL = bytes.fromhex("fd0a000007092a810100b0810000057261737321502a")
GOLDEN_TUNNEL_SIGNED = bytes.fromhex("fd0a010007092a810100b081000005726173732119b90115cd5b070000538455bece27")
GOLDEN_HEARTBEAT = bytes.fromhex("fd0900000009bf000000000000001208000403dc97")


@unhurried
@given(
    data=tunnel_data,
    payload_type=u16,
    system=u8,
    component=u8,
    target_system=u8,
    target_component=u8,
    sequence=u8,
    signed=st.booleans(),
    link=u8,
    timestamp=st.integers(0, 2**48 - 2),
)
def test_tunnel_is_pymavlinks_byte_for_byte(
    room: SimpleNamespace,
    data: bytes,
    payload_type: int,
    system: int,
    component: int,
    target_system: int,
    target_component: int,
    sequence: int,
    signed: bool,
    link: int,
    timestamp: int,
) -> None:
    theirs = pymav.sender(system, component, sequence, (pymav.KEY, link, timestamp) if signed else None)
    message = pymav.tunnel(data, payload_type, target_system, target_component)
    expected = bytes(message.pack(theirs))

    signer = room.signing.Signer(pymav.KEY, link, timestamp) if signed else None
    ours = room.frames.FrameWriter(system, component, signer)
    ours.sequence = sequence
    frame = ours.tunnel(data, payload_type=payload_type, target_system=target_system, target_component=target_component)
    assert frame == expected
    assert ours.sequence == (sequence + 1) % 256
    ours.sequence = sequence
    if signer is not None:
        assert signer.timestamp == timestamp + 1
        signer.timestamp = timestamp
    assert ours.message(message) == expected

    # And back.
    fields = (target_system, target_component, payload_type, data)
    [read] = room.frames.FrameReader().feed(frame)
    assert read[:4] == (common.MAVLINK_MSG_ID_TUNNEL, sequence, system, component)
    assert read.signed is signed
    assert room.tunnel.decode_tunnel(read.payload) == fields
    assert room.tunnel.tunnel_from_datagram(frame) == (system, component, *fields)


def _messages() -> st.SearchStrategy[object]:
    name = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=10).map(str.encode)
    u32, i32, i16 = st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1)
    f32 = st.floats(width=32)
    return st.one_of(
        st.builds(common.MAVLink_heartbeat_message, u8, u8, u8, u32, u8, u8),
        st.builds(common.MAVLink_global_position_int_message, u32, i32, i32, i32, i32, i16, i16, i16, u16),
        st.builds(common.MAVLink_named_value_float_message, u32, name, f32),
        st.builds(common.MAVLink_statustext_message, u8, name, u16, u8),
        st.builds(
            common.MAVLink_home_position_message,
            *(i32, i32, i32, f32, f32, f32),
            st.lists(f32, min_size=4, max_size=4),
            *(f32, f32, f32, st.integers(0, 2**64 - 1)),
        ),
    )


@unhurried
@given(message=_messages(), sequence=u8, signed=st.booleans())
def test_any_message_is_written_and_parsed_as_pymavlink_does(
    room: SimpleNamespace, message: common.MAVLink_message, sequence: int, signed: bool
) -> None:
    expected = bytes(message.pack(pymav.sender(9, 1, sequence, (pymav.KEY, 3, 1000) if signed else None)))
    writer = room.frames.FrameWriter(9, 1, room.signing.Signer(pymav.KEY, 3, 1000) if signed else None)
    writer.sequence = sequence
    assert writer.message(message) == expected

    [frame] = room.frames.FrameReader().feed(expected)
    ours, theirs = room.messages.parse(frame), common.MAVLink(None).decode(bytearray(expected))
    assert str(ours) == str(theirs)  # as text, for NaN equals nothing
    assert (ours.get_msgId(), ours.get_seq(), ours.get_srcSystem(), ours.get_srcComponent()) == (
        theirs.get_msgId(),
        sequence,
        9,
        1,
    )


def test_golden_frames(room: SimpleNamespace) -> None:
    writer = room.frames.FrameWriter(9, 42)
    writer.sequence = 7
    assert writer.tunnel(b"rass!", payload_type=33200) == GOLDEN_TUNNEL
    assert room.tunnel.tunnel_from_datagram(GOLDEN_TUNNEL) == (9, 42, 0, 0, 33200, b"rass!")
    signed = room.frames.FrameWriter(9, 42, room.signing.Signer(pymav.KEY, 1, 123456789))
    signed.sequence = 7
    assert signed.tunnel(b"rass!", payload_type=33200) == GOLDEN_TUNNEL_SIGNED
    companion = room.frames.FrameWriter(9, 191)
    assert companion.message(room.messages.companion_heartbeat()) == GOLDEN_HEARTBEAT


def test_all_that_a_component_sends_shares_one_sequence() -> None:
    writer = FrameWriter(1, 191)
    message = common.MAVLink_named_value_float_message(1, b"RAD", 2.0)
    stream = b""
    for _ in range(100):
        stream += writer.message(message) + writer.tunnel(b"x", payload_type=33200) + writer.frame(0, bytes(9))
    sequences = [frame.sequence for frame in FrameReader().feed(stream)]
    assert sequences == [number % 256 for number in range(300)]


def test_ids_may_be_changed_between_frames() -> None:
    writer = FrameWriter(0, 191)
    writer.system_id, writer.component_id = 17, 68
    [frame] = FrameReader().feed(writer.tunnel(b"x", payload_type=1))
    assert (frame.system_id, frame.component_id) == (17, 68)


def test_too_long_data_are_our_mistake() -> None:
    with pytest.raises(ValueError, match="at most 128 bytes, not 129"):
        FrameWriter(1, 191).tunnel(bytes(129), payload_type=33200)


def test_a_payload_length_beyond_128_is_malformed() -> None:
    lie = bytes((0xB0, 0x81, 0, 0, 129)) + b"x" * 128
    with pytest.raises(MalformedError, match="payload_length 129"):
        decode_tunnel(lie)
    frame = FrameWriter(1, 191).frame(385, lie)
    assert tunnel_from_datagram(frame) is None
    assert [read.payload for read in FrameReader().feed(frame)] == [lie]


def test_bytes_beyond_payload_length_do_not_count() -> None:
    payload = bytes((0xB0, 0x81, 3, 4, 2)) + b"abcdef"
    assert decode_tunnel(payload) == TunnelFields(3, 4, 33200, b"ab")
    assert tunnel_from_datagram(FrameWriter(1, 191).frame(385, payload)) == (1, 191, 3, 4, 33200, b"ab")


def test_a_tunnel_without_any_byte_is_all_zeros() -> None:
    frame = FrameWriter(1, 191).frame(385, b"")
    assert len(frame) == 12
    assert [read.payload for read in FrameReader().feed(frame)] == [b""]
    assert tunnel_from_datagram(frame) == (1, 191, 0, 0, 0, b"")


def test_fields_of_a_newer_tunnel_are_ignored() -> None:
    longer = bytes((0xB0, 0x81, 0, 0, 128)) + b"x" * 128 + b"new"
    frame = FrameWriter(1, 191).frame(385, longer)
    [read] = FrameReader().feed(frame)
    assert decode_tunnel(read.payload).payload == b"x" * 128


@given(data=st.binary(max_size=200))
def test_a_datagram_of_any_bytes_is_a_tunnel_or_none(data: bytes) -> None:
    # With a checksum of random bytes it is None; the next test has frames that are nearly right.
    assert tunnel_from_datagram(data) is None
    try:
        fields = decode_tunnel(data)
    except MalformedError:
        assert data[4] > 128
    else:
        assert len(fields.payload) <= 128


@given(data=tunnel_data, payload_type=u16, where=st.integers(0, 200), bit=st.integers(0, 7), cut=st.integers(0, 9))
def test_the_short_way_agrees_with_the_reader(data: bytes, payload_type: int, where: int, bit: int, cut: int) -> None:
    good = FrameWriter(5, 191).tunnel(data, payload_type=payload_type)
    broken = bytearray(good)
    broken[where % len(good)] ^= 1 << bit
    candidates = [good, bytes(broken), good[: len(good) - cut], good + good, good + bytes(cut), b"\0" + good]
    for candidate in candidates:
        reader = FrameReader()
        frames = reader.feed(candidate)
        whole = len(frames) == 1 and not (reader.garbage_bytes or reader.malformed or reader.pending)
        if whole:
            frame = frames[0]
            assert tunnel_from_datagram(candidate) == (
                frame.system_id,
                frame.component_id,
                *decode_tunnel(frame.payload),
            )
        else:
            assert tunnel_from_datagram(candidate) is None
