"""Signatures: as pymavlink makes them, and none of the ways to cheat."""

from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.reader import FrameReader
from rass_mav.mavlink.signing import (
    MAX_STREAMS,
    NEW_STREAM_WINDOW,
    Signer,
    Verifier,
    signing_timestamp,
)

from . import pymav

OTHER_KEY = bytes(32)
START = 1_000_000_000


def signed_frame(timestamp: int, *, key: bytes = pymav.KEY, link: int = 0, system: int = 1) -> bytes:
    return FrameWriter(system, 191, Signer(key, link, timestamp)).tunnel(b"data", payload_type=33200)


def tampered(frame: bytes) -> bytes:
    """The last bit of the signature flipped: the checksum is still good."""
    return frame[:-1] + bytes((frame[-1] ^ 1,))


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
    writer = room.frames.FrameWriter(2, 191, room.signing.Signer(pymav.KEY, link, timestamp))
    reader = room.reader.FrameReader(room.signing.Verifier(pymav.KEY))
    for _ in range(count):
        message = pymav.tunnel(data, 33200, 0, 0)
        expected = bytes(message.pack(theirs))
        theirs.seq = (theirs.seq + 1) % 256
        assert writer.tunnel(data, payload_type=33200) == expected
        assert [frame.signed for frame in reader.feed(expected)] == [True]
    receiver = pymav.sender(9, 1, 0, (pymav.KEY, 0, timestamp))
    assert receiver.decode(bytearray(writer.tunnel(data, payload_type=33200))).get_signed()


def test_a_forged_frame_does_not_lock_out_the_true_sender() -> None:
    reader = FrameReader(Verifier(pymav.KEY))
    assert len(reader.feed(signed_frame(START))) == 1
    # The same stream, far in the future, with another key.
    assert reader.feed(signed_frame(2**48 - 1, key=OTHER_KEY)) == []
    assert reader.feed(tampered(signed_frame(2**47))) == []
    assert len(reader.feed(signed_frame(START + 1))) == 1
    assert (reader.frames, reader.rejected, reader.malformed) == (2, 2, 0)
    assert reader.verifier is not None
    assert (reader.verifier.forged, reader.verifier.replayed) == (2, 0)


def test_a_forged_first_frame_does_not_claim_the_stream() -> None:
    reader = FrameReader(Verifier(pymav.KEY))
    assert reader.feed(tampered(signed_frame(START + 1000))) == []
    assert len(reader.feed(signed_frame(START))) == 1


@given(position=st.integers(0, 1000), bit=st.integers(0, 7))
def test_no_bit_can_be_changed(position: int, bit: int) -> None:
    frame = bytearray(signed_frame(START))
    frame[position % len(frame)] ^= 1 << bit
    reader = FrameReader(Verifier(pymav.KEY))
    assert reader.feed(bytes(frame)) + reader.flush() == []


def test_a_frame_is_accepted_once() -> None:
    reader = FrameReader(Verifier(pymav.KEY))
    first, second = signed_frame(START), signed_frame(START + 1)
    assert len(reader.feed(first + second)) == 2
    assert reader.feed(second + first + second) == []
    assert reader.rejected == 3
    assert reader.verifier is not None
    assert reader.verifier.replayed == 3


def test_links_and_systems_are_streams_of_their_own() -> None:
    reader = FrameReader(Verifier(pymav.KEY))
    stream = signed_frame(START) + signed_frame(START, link=1) + signed_frame(START, system=2)
    assert len(reader.feed(stream)) == 3


def test_a_new_stream_may_be_a_minute_old_and_no_more() -> None:
    now_unix = 1_800_000_000.0
    verifier = Verifier(pymav.KEY)
    verifier.set_time(now_unix)
    limit = signing_timestamp(now_unix - 60.0)
    assert not verifier.verify(signed_frame(limit - 1))
    assert verifier.verify(signed_frame(limit))
    # A stream that is known may fall behind: only its own last timestamp counts.
    verifier.set_time(now_unix + 600.0)
    assert verifier.verify(signed_frame(limit + 1))


def test_the_clock_follows_genuine_frames_only() -> None:
    verifier = Verifier(pymav.KEY)
    assert not verifier.verify(signed_frame(2**40, key=OTHER_KEY))
    assert verifier.clock == 0
    assert verifier.verify(signed_frame(START))
    assert verifier.clock == START
    # So a replay to somebody who has no clock is refused as soon as somebody true was heard.
    assert not verifier.verify(signed_frame(START - NEW_STREAM_WINDOW - 1, system=7))


def test_unsigned_frames_pass_only_where_allowed() -> None:
    unsigned = pymav.heartbeat()
    strict, open_ = FrameReader(Verifier(pymav.KEY)), FrameReader(Verifier(pymav.KEY, accept_unsigned=True))
    assert strict.feed(unsigned) == []
    assert strict.rejected == 1
    assert [frame.signed for frame in open_.feed(unsigned + signed_frame(START))] == [False, True]
    # A bad signature is not the same as none.
    assert open_.feed(tampered(signed_frame(START + 1))) == []
    assert open_.rejected == 1


def test_without_a_verifier_signatures_are_not_looked_at() -> None:
    assert [frame.signed for frame in FrameReader().feed(signed_frame(START, key=OTHER_KEY))] == [True]


def test_streams_are_bounded_and_forgetting_one_opens_no_door_to_replays() -> None:
    verifier = Verifier(pymav.KEY)
    streams = [(system, link) for system in range(1, 250) for link in range(5)]
    first, *others = streams[: MAX_STREAMS + 2]
    old = signed_frame(START, system=first[0], link=first[1])
    assert verifier.verify(old)
    recent = START + NEW_STREAM_WINDOW
    for system, link in others[: MAX_STREAMS - 1]:
        assert verifier.verify(signed_frame(recent, system=system, link=link))
    extra, refused = others[MAX_STREAMS - 1 :]
    # The table is full. A stream exactly a minute behind could still be played again if it were forgotten.
    assert not verifier.verify(signed_frame(recent, system=extra[0], link=extra[1]))
    # One over a minute behind makes room for one more, but not for two.
    recent += 1
    assert verifier.verify(signed_frame(recent, system=others[0][0], link=others[0][1]))
    assert verifier.verify(signed_frame(recent, system=extra[0], link=extra[1]))
    assert not verifier.verify(signed_frame(recent, system=refused[0], link=refused[1]))
    assert not verifier.verify(old)
    assert verifier.verify(signed_frame(recent + 1, system=extra[0], link=extra[1]))


def test_the_signers_time_never_falls() -> None:
    signer = Signer(pymav.KEY, 0, START)
    signer.set_time(0.0)
    assert signer.timestamp == START
    signer.set_time(1_800_000_000.0)
    assert signer.timestamp == signing_timestamp(1_800_000_000.0)
    signer.raise_to(START)
    assert signer.timestamp == signing_timestamp(1_800_000_000.0)
    signer.raise_to(signer.timestamp + 5)
    FrameWriter(1, 1, signer).tunnel(b"", payload_type=1)
    assert signer.timestamp == signing_timestamp(1_800_000_000.0) + 6


def test_timestamps_count_10_us_from_2015() -> None:
    assert signing_timestamp(1_420_070_400.0) == 0
    assert signing_timestamp(1_420_070_401.0) == 100_000
    assert signing_timestamp(0.0) == 0


@pytest.mark.parametrize(
    ("key", "link", "timestamp"), [(b"short", 0, 0), (pymav.KEY, 256, 0), (pymav.KEY, -1, 0), (pymav.KEY, 0, 1 << 48)]
)
def test_a_signer_out_of_range_is_our_mistake(key: bytes, link: int, timestamp: int) -> None:
    with pytest.raises(ValueError, match=r"key|range|48 bits"):
        Signer(key, link, timestamp)


def test_a_verifier_wants_a_whole_key() -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        Verifier(b"short")
