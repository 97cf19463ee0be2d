"""From any bytes to frames: whole, in pieces, behind garbage, and hostile."""

import itertools
import random
import re
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.mavlink.crc import crc16
from rass_mav.mavlink.dialect import FORMATS
from rass_mav.mavlink.frames import MAX_FALSE_STARTS, Frame, FrameReader, FrameWriter
from rass_mav.mavlink.signing import Signer
from rass_mav.mavlink.tunnel import decode_tunnel

from . import pymav

unhurried = settings(deadline=None)
plain_bytes = st.binary(max_size=60).map(lambda data: re.sub(rb"[\xfd\xfe]", b"", data))


def tunnels(count: int, *, signer: Signer | None = None, seed: int = 1) -> list[bytes]:
    """Frames with random data; magic bytes are among them."""
    generator = random.Random(seed)
    writer = FrameWriter(3, 191, signer)
    return [writer.tunnel(generator.randbytes(generator.randrange(129)), payload_type=33200) for _ in range(count)]


def unknown_frame(payload: bytes) -> bytes:
    """A whole frame of a message that the common dialect does not have (id 60000), with some checksum."""
    assert 60000 not in FORMATS
    return bytes((0xFD, len(payload), 0, 0, 0, 1, 1)) + (60000).to_bytes(3, "little") + payload + b"\x12\x34"


def feed_bytewise(reader: FrameReader, data: bytes) -> list[Frame]:
    return [frame for position in range(len(data)) for frame in reader.feed(data[position : position + 1])]


def accounted(reader: FrameReader, read: list[Frame], *, version: int = 2) -> int:
    """Bytes whose fate the reader tells, where no id is unknown."""
    around = 12 if version == 2 else 8
    in_frames = sum(around + len(frame.payload) + (13 if frame.signed else 0) for frame in read)
    return in_frames + reader.garbage_bytes + reader.pending


@pytest.mark.no_cover
@unhurried
@given(
    parts=st.lists(
        st.one_of(plain_bytes.map(lambda data: (False, data)), st.integers(0, 30).map(lambda pick: (True, pick))),
        max_size=12,
    ),
    cuts=st.lists(st.integers(0, 2000), max_size=20),
)
def test_frames_between_garbage_in_any_pieces(
    room: SimpleNamespace, parts: list[tuple[bool, bytes | int]], cuts: list[int]
) -> None:
    known = [*tunnels(15), *tunnels(16, signer=Signer(pymav.KEY, 1, 7), seed=2)]
    stream = b"".join(known[part] if is_frame else part for is_frame, part in parts)  # type: ignore[index,misc]
    sent = [known[part] for is_frame, part in parts if is_frame]  # type: ignore[index]
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    pieces = [stream[start:end] for start, end in itertools.pairwise(edges)]
    for feeding in ([stream], pieces, [stream[i : i + 1] for i in range(len(stream))]):
        reader = room.frames.FrameReader()
        read = [frame for piece in feeding for frame in reader.feed(piece)]
        assert [frame.payload for frame in read] == [frame[10 : 10 + frame[1]] for frame in sent]
        assert reader.frames == len(sent)
        assert (reader.malformed, reader.unknown, reader.pending) == (0, 0, 0)
        assert reader.garbage_bytes == len(stream) - sum(map(len, sent))


@unhurried
@given(data=st.binary(max_size=600), magic=st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x00\x00", b"\xfd\xff\x01"]))
def test_any_bytes_whole_or_bytewise_never_raise_and_read_the_same(data: bytes, magic: bytes) -> None:
    hostile = data.replace(b"\x00", magic)
    true_frame = pymav.heartbeat()
    whole, bytewise = FrameReader(), FrameReader()
    stream = hostile + true_frame
    assert whole.feed(stream) + whole.flush() == (read := feed_bytewise(bytewise, stream) + bytewise.flush())
    # A true frame behind garbage is always found, unless a frame that by chance is good reaches into it.
    assert read[-1:] == [Frame(0, 0, 1, 1, true_frame[10:-2], False)]
    for counter in ("frames", "malformed", "garbage_bytes", "unknown", "pending"):
        assert getattr(whole, counter) == getattr(bytewise, counter), counter
    if not whole.unknown:
        assert accounted(whole, read) == len(stream)


@given(data=st.lists(st.binary(max_size=400), max_size=10))
def test_what_is_kept_is_bounded(data: list[bytes]) -> None:
    reader = FrameReader()
    for piece in data:
        reader.feed(b"\xfd" + piece)
        assert reader.pending <= 279


def test_work_on_hostile_bytes_is_linear(monkeypatch: pytest.MonkeyPatch) -> None:
    # Each byte starts a candidate with a known id and the greatest length: the most work there is.
    checked = 0

    def counting(data: bytes, crc: int = 0xFFFF) -> int:
        nonlocal checked
        checked += len(data)
        return crc16(data, crc)

    # The real checksum, with a tally.
    monkeypatch.setattr("rass_mav.mavlink.frames.crc16", counting)
    hostile = b"\xfe\x21\x21\x21\x21\x21" * 500 + b"\xfd" * 3000 + b"\xfd\xff\x00\x00\x00\x00\x00\x81\x01\x00" * 300
    for feeding in ([hostile], [hostile[i : i + 1] for i in range(len(hostile))]):
        checked = 0
        reader = FrameReader()
        assert [frame for piece in feeding for frame in reader.feed(piece)] == []
        assert 0 < checked <= 280 * len(hostile)


@pytest.mark.parametrize("bytewise", [False, True])
def test_a_false_start_does_not_swallow_the_frame_behind_it(bytewise: bool) -> None:
    frame = pymav.heartbeat()
    # The header of a TUNNEL that claims 200 bytes; a second true frame brings it to its end.
    false_start = bytes.fromhex("fdc8000000 0101 810100")
    reader = FrameReader()
    stream = false_start + frame + bytes(200)
    read = feed_bytewise(reader, stream) if bytewise else reader.feed(stream)
    assert [one.message_id for one in read] == [0]
    assert reader.malformed == 1
    assert reader.garbage_bytes == len(stream) - len(frame)


def test_a_truncated_frame_costs_only_itself() -> None:
    first, second, third = tunnels(3, seed=5)
    reader = FrameReader()
    read = reader.feed(first[:-3] + second + third)
    assert [frame.sequence for frame in read] == [1, 2]
    assert reader.malformed >= 1  # random bytes in the rest of it may look like starts, too
    assert reader.garbage_bytes == len(first) - 3


def test_flush_gives_up_waiting_and_finds_what_was_behind() -> None:
    frame = pymav.heartbeat()
    reader = FrameReader()
    assert reader.feed(bytes.fromhex("fdc8000000 0101 810100") + frame) == []
    assert reader.pending == 10 + len(frame)
    assert [one.message_id for one in reader.flush()] == [0]
    assert reader.pending == 0
    assert reader.malformed == 1
    assert reader.flush() == []


@pytest.mark.parametrize("flag", [0x02, 0x03, 0x80])
def test_incompatibility_flags_that_we_do_not_know_are_not_read(flag: int) -> None:
    frame = bytearray(pymav.heartbeat())
    frame[2] = flag
    frame[-2:] = crc16(bytes(frame[1:-2]) + FORMATS[0].crc_extra).to_bytes(2, "little")
    alone, followed = FrameReader(), FrameReader()
    assert alone.feed(bytes(frame)) == []
    assert [one.sequence for one in followed.feed(bytes(frame) + pymav.heartbeat(9))] == [9]
    assert (alone.malformed, followed.malformed) == (1, 1)


def test_compatibility_flags_are_ignored() -> None:
    frame = bytearray(pymav.heartbeat())
    frame[3] = 0xFF
    frame[-2:] = crc16(bytes(frame[1:-2]) + FORMATS[0].crc_extra).to_bytes(2, "little")
    assert len(FrameReader().feed(bytes(frame))) == 1


@pytest.mark.parametrize("bytewise", [False, True])
def test_mavlink_1(bytewise: bool) -> None:
    message = common.MAVLink_named_value_float_message(77, b"RAD", 2.5)
    frame = bytes(message.pack(pymav.sender(4, 1, 200), force_mavlink1=True))
    assert frame[0] == 0xFE
    reader = FrameReader()
    stream = b"ab" + frame + pymav.heartbeat() + frame
    read = feed_bytewise(reader, stream) if bytewise else reader.feed(stream)
    assert [one.message_id for one in read] == [251, 0, 251]
    assert read[0] == Frame(251, 200, 4, 1, frame[6:-2], False, mavlink=1)
    assert reader.garbage_bytes == 2


def test_a_start_that_no_version_1_frame_can_have_is_not_waited_for() -> None:
    # 255 bytes of payload for a heartbeat.
    reader = FrameReader()
    assert len(reader.feed(b"\xfe\xff\x00\x01\x01\x00" + pymav.heartbeat())) == 1
    assert (reader.malformed, reader.pending) == (1, 0)


@pytest.mark.parametrize("bytewise", [False, True])
def test_an_unknown_message_is_counted_once_and_hides_nothing(bytewise: bool) -> None:
    frame = pymav.heartbeat()
    # Inside it are what looks like starts, and behind it a true frame.
    stream = unknown_frame(b"\xfd\xfe\xfd\x09\x00\xfe" * 5) + frame
    reader = FrameReader()
    read = feed_bytewise(reader, stream) if bytewise else reader.feed(stream)
    read += reader.flush()
    assert [one.message_id for one in read] == [0]
    assert (reader.unknown, reader.malformed, reader.garbage_bytes) == (1, 0, 0)


def test_garbage_that_looks_like_an_unknown_message_swallows_no_true_frame() -> None:
    # It claims 255 bytes, and true frames are within.
    reader = FrameReader()
    read = reader.feed(unknown_frame(bytes(255))[:12] + pymav.heartbeat(1) + pymav.heartbeat(2))
    assert [frame.sequence for frame in read] == [1, 2]
    assert reader.unknown == 1


def test_a_true_frame_ends_what_an_unknown_message_claims() -> None:
    reader = FrameReader()
    assert reader.feed(unknown_frame(bytes(200))[:50]) == []
    assert len(reader.feed(pymav.heartbeat())) == 1
    assert reader.garbage_bytes == 0
    assert reader.feed(b"abc") == []
    assert reader.garbage_bytes == 3


def test_a_stream_that_pymavlink_wrote_is_read_as_pymavlink_reads_it() -> None:
    mav = pymav.sender(1, 1)
    stream = b""
    for number in range(300):
        mav.seq = number % 256
        stream += bytes(pymav.tunnel(bytes([number % 256]) * (number % 129), 33200, 0, 0).pack(mav))
        stream += bytes(common.MAVLink_statustext_message(6, b"step %d" % number).pack(mav))
    theirs = common.MAVLink(None).parse_buffer(stream)
    reader = FrameReader()
    read = reader.feed(stream)
    assert [(frame.message_id, frame.sequence) for frame in read] == [
        (one.get_msgId(), one.get_seq()) for one in theirs
    ]
    data = [decode_tunnel(frame.payload).payload for frame in read if frame.message_id == 385]
    assert data == [bytes(one.payload[: one.payload_length]) for one in theirs if one.get_msgId() == 385]


# Each byte starts something; each start has a known id and a good length; each start has an id that nobody knows.
FLOODS = [
    b"\xfd" * 1472,
    b"\xfe\x21\x21\x21\x21\x21" * 245,
    b"\xfd\xff\x00\x00\x00\x00\x00\x81\x01\x00" * 147,
    b"\xfd\xff\x00\x00\x00\x00\x00\x60\xea\x00" * 147,
    bytes.fromhex("fdff000000000060ea00") + b"\xfd" * 1462,
]


@pytest.mark.parametrize("flood", FLOODS, ids=range(len(FLOODS)))
def test_a_datagram_has_so_many_false_starts_and_then_it_is_garbage(
    flood: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked = searched = 0

    def counting(data: bytes, crc: int = 0xFFFF) -> int:
        nonlocal checked
        checked += len(data)
        return crc16(data, crc)

    class Magic:
        """The real search, with a tally."""

        def search(self, data: bytes, position: int) -> re.Match[bytes] | None:
            nonlocal searched
            searched += 1
            return re.compile(rb"[\xfd\xfe]").search(data, position)

    monkeypatch.setattr("rass_mav.mavlink.frames.crc16", counting)
    monkeypatch.setattr("rass_mav.mavlink.frames._MAGIC", Magic())
    reader = FrameReader()
    assert reader.datagram(flood) == []
    assert searched <= MAX_FALSE_STARTS + 1
    assert checked <= MAX_FALSE_STARTS * 280 <= 8 * len(flood)
    assert reader.malformed + reader.unknown <= MAX_FALSE_STARTS
    assert reader.pending == 0
    # The next datagram is read as if nothing had been.
    assert [frame.sequence for frame in reader.datagram(pymav.heartbeat(7))] == [7]


@pytest.mark.parametrize("flood", FLOODS, ids=range(len(FLOODS)))
def test_a_stream_gives_up_no_true_frame_behind_any_garbage(flood: bytes) -> None:
    reader = FrameReader()
    read = reader.feed(flood + pymav.heartbeat(7)) + reader.flush()
    assert [frame.sequence for frame in read] == [7]


def test_a_datagram_of_unknown_messages_hides_nothing_behind_them() -> None:
    stranger = random.Random(2).randbytes(255)
    reader = FrameReader()
    read = reader.datagram(unknown_frame(stranger) * 4 + pymav.heartbeat(7))
    assert [frame.sequence for frame in read] == [7]
    assert (reader.unknown, reader.malformed, reader.garbage_bytes) == (4, 0, 0)


@given(data=st.binary(max_size=1472), magic=st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x00\x00", b"\xfd\xff\x01"]))
def test_a_datagram_keeps_nothing_and_accounts_for_all_its_bytes(data: bytes, magic: bytes) -> None:
    hostile = data.replace(b"\x00", magic)
    reader = FrameReader()
    read = reader.datagram(hostile)
    assert reader.pending == 0
    if not reader.unknown:
        assert accounted(reader, read) == len(hostile)


@given(cut=st.integers(1, 40))
def test_what_is_cut_off_at_the_end_of_a_datagram_waits_for_nothing(cut: int) -> None:
    first, second = tunnels(2, seed=5)
    reader = FrameReader()
    assert [frame.sequence for frame in reader.datagram(first + second[:-cut])] == [0]
    assert [frame.sequence for frame in reader.datagram(second)] == [1]
