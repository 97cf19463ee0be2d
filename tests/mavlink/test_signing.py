"""Signatures: as pymavlink makes and takes them, and no other passes."""

from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.mavlink.frames import TUNNEL_ID, FrameReader, FrameWriter
from rass_mav.mavlink.messages import HEARTBEAT
from rass_mav.mavlink.signing import MAX_TIMESTAMP, SignatureCheck, Signer, SigningKey

from . import pymav

OTHER_KEY = bytes(32)
NEW_KEY = bytes(range(32))
START = 1_000_000_000


def checked(key: bytes = pymav.KEY) -> FrameReader:
    """A reader that wants a signature of every message."""
    return FrameReader(SignatureCheck(SigningKey(key), lambda _: True))


def refused(reader: FrameReader) -> tuple[int, int]:
    assert reader.check is not None
    return reader.check.unsigned, reader.check.forged


def signed_frame(timestamp: int = START, *, key: bytes = pymav.KEY, link: int = 0, system: int = 1) -> bytes:
    return FrameWriter(system, 191, Signer(key, link, timestamp)).tunnel(b"data", payload_type=33200)


@settings(deadline=None)
@given(
    data=st.binary(max_size=128),
    link=st.integers(0, 255),
    timestamp=st.integers(0, 2**48 - 10),
    count=st.integers(1, 4),
)
def test_pymavlink_takes_our_signatures_and_we_take_its(
    room: SimpleNamespace, data: bytes, link: int, timestamp: int, count: int
) -> None:
    theirs = pymav.sender(2, 191, 0, (pymav.KEY, link, timestamp))
    theirs.robust_parsing = True
    keys = room.signing.SigningKey(pymav.KEY)
    writer = room.frames.FrameWriter(2, 191, keys.signer(link, timestamp))
    reader = room.frames.FrameReader(room.signing.SignatureCheck(keys, lambda _: True))
    for number in range(count):
        message = pymav.tunnel(data, 33200, 0, 0)
        expected = bytes(message.pack(theirs))
        theirs.seq = (theirs.seq + 1) % 256
        assert writer.tunnel(data, payload_type=33200) == expected
        [frame] = reader.feed(expected)
        assert (frame.signed, frame.stream, frame.timestamp) == (True, (2, 191, link), timestamp + number)
    receiver = pymav.sender(9, 1, 0, (pymav.KEY, 0, timestamp))
    assert receiver.decode(bytearray(writer.tunnel(data, payload_type=33200))).get_signed()


def test_pymavlink_takes_a_whole_conversation_in_order_and_nothing_twice() -> None:
    writer = FrameWriter(2, 191, Signer(pymav.KEY, 5, START))
    receiver = pymav.sender(9, 1, 0, (pymav.KEY, 0, 0))
    frames = [writer.tunnel(bytes([number]), payload_type=33200) for number in range(100)]
    assert all(receiver.decode(bytearray(frame)).get_signed() for frame in frames)
    with pytest.raises(Exception, match="Invalid signature"):
        receiver.decode(bytearray(frames[-1]))


@pytest.mark.parametrize("frame", [signed_frame(key=OTHER_KEY), signed_frame(2**48 - 1, key=OTHER_KEY)])
def test_a_stranger_s_signature_is_refused(frame: bytes) -> None:
    reader = checked()
    assert reader.feed(frame) == reader.datagram(frame) == []
    assert refused(reader) == (0, 2)
    assert (reader.frames, reader.malformed) == (0, 0)


@given(position=st.integers(0, 1000), bit=st.integers(0, 7))
def test_no_bit_can_be_changed(position: int, bit: int) -> None:
    frame = bytearray(signed_frame())
    frame[position % len(frame)] ^= 1 << bit
    reader = checked()
    assert reader.feed(bytes(frame)) + reader.flush() + reader.datagram(bytes(frame)) == []


def test_the_key_can_change_between_frames() -> None:
    told: list[bytes] = []
    reader = FrameReader(SignatureCheck(SigningKey(pymav.KEY), lambda _: True, told.append))
    old, new = signed_frame(), signed_frame(key=NEW_KEY)
    assert len(reader.feed(old + new)) == 1
    assert told == [new]
    assert reader.check is not None
    reader.check.key = SigningKey(NEW_KEY)
    assert len(reader.feed(old + new)) == 1
    assert told == [new, old]
    assert refused(reader) == (0, 2)
    signer = SigningKey(pymav.KEY).signer(0, START)
    writer = FrameWriter(1, 191, signer)
    assert writer.tunnel(b"data", payload_type=33200) == old
    SigningKey(NEW_KEY).give_to(signer)
    writer.sequence = 0
    assert writer.tunnel(b"data", payload_type=33200) == signed_frame(START + 1, key=NEW_KEY)


def test_unsigned_frames_pass_only_where_no_signature_is_needed() -> None:
    heartbeat, tunnel = pymav.heartbeat(), FrameWriter(1, 191).tunnel(b"data", payload_type=33200)
    reader = FrameReader(SignatureCheck(SigningKey(pymav.KEY), lambda message_id: message_id == TUNNEL_ID))
    assert [frame.message_id for frame in reader.feed(heartbeat + tunnel + signed_frame())] == [HEARTBEAT, TUNNEL_ID]
    assert refused(reader) == (1, 0)
    assert checked().feed(heartbeat) == []


def test_a_message_with_an_unknown_id_never_comes_through_whoever_signs_it() -> None:
    frame = bytearray(signed_frame())
    frame[7:10] = (0xFFFFFF).to_bytes(3, "little")
    for key in (pymav.KEY, OTHER_KEY):
        signer = Signer(key, 0, START)
        reader = checked()
        assert reader.feed(signer.sign(bytes(frame[:-13]))) + reader.flush() == []
        assert reader.unknown == 1


def test_without_a_check_signatures_are_not_looked_at() -> None:
    assert [frame.signed for frame in FrameReader().feed(signed_frame(key=OTHER_KEY))] == [True]


def test_the_signer_s_timestamp_never_falls() -> None:
    signer = Signer(pymav.KEY, 0, START)
    signer.raise_to(START - 1)
    assert signer.timestamp == START
    signer.raise_to(START + 5)
    FrameWriter(1, 1, signer).tunnel(b"", payload_type=1)
    assert signer.timestamp == START + 6


def test_the_last_timestamp_can_be_used_and_none_after_it() -> None:
    signer = Signer(pymav.KEY, 0, MAX_TIMESTAMP)
    signer.sign(b"frame")
    with pytest.raises(OverflowError):
        signer.sign(b"frame")
    with pytest.raises(ValueError, match="48 bits"):
        signer.raise_to(MAX_TIMESTAMP + 1)


@pytest.mark.parametrize(
    ("key", "link", "timestamp"), [(b"short", 0, 0), (pymav.KEY, 256, 0), (pymav.KEY, -1, 0), (pymav.KEY, 0, 1 << 48)]
)
def test_a_signer_out_of_range_is_our_mistake(key: bytes, link: int, timestamp: int) -> None:
    with pytest.raises(ValueError, match=r"key|range|48 bits"):
        Signer(key, link, timestamp)


def test_keys_are_whole_and_hidden() -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        SigningKey(b"short")
    assert pymav.KEY.hex() not in repr(SigningKey(pymav.KEY)) + repr(Signer(pymav.KEY, 0, 0))
    assert repr(pymav.KEY) not in repr(SigningKey(pymav.KEY))
