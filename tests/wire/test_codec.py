from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import (
    BROADCAST,
    Beacon,
    Chunk,
    Committed,
    Data,
    Handover,
    LossNote,
    Message,
    PassedOn,
    Words,
)
from rass_mav.errors import MalformedError
from rass_mav.wire import INLINE_BYTES, MAX_TUNNEL, decode, encode, target_of
from rass_mav.wire.codec import VERSION, ForeignError

from .samples import HELLO, NOW, SAMPLES, any_message

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"


def golden() -> dict[str, bytes]:
    """name -> bytes, from the table of golden vectors in the document."""
    text = PROTOCOL.read_text(encoding="utf-8").split("## Golden vectors")[1]
    return {m[1]: bytes.fromhex(m[2]) for m in re.finditer(r"^\| `([a-z-]+)` \| `([0-9a-f ]+)` \|", text, re.M)}


def same(a: Message, b: Message | None) -> bool:
    """Equal, but for moments, which agree to the millisecond."""
    if type(a) is not type(b):
        return False
    return _rounded(a) == _rounded(b)


def _rounded(value: object) -> object:
    if isinstance(value, tuple):
        return tuple(_rounded(v) for v in value)
    return round(value, 3) if isinstance(value, float) else value


def test_every_sample_has_a_golden_vector_and_every_vector_a_sample() -> None:
    assert golden().keys() == SAMPLES.keys()


@pytest.mark.parametrize("name", SAMPLES)
def test_golden_vectors(name: str) -> None:
    assert encode(SAMPLES[name], NOW) == [golden()[name]]
    assert same(SAMPLES[name], decode(golden()[name], NOW))


@given(any_message)
def test_round_trip(message: Message) -> None:
    frames = encode(message, NOW)
    assert all(len(frame) <= MAX_TUNNEL for frame in frames)
    parts = [decode(frame, NOW) for frame in frames]
    if len(parts) == 1:
        assert same(message, parts[0])
    else:
        assert isinstance(message, (Data, Committed, LossNote, PassedOn, Words))
        assert same(message, joined(parts))


def joined(parts: list[Message]) -> Message:
    """One message from the frames that it had to be split over."""
    first, *others = parts
    fields: list[Any] = list(first)
    for other in others:
        for i, field in enumerate(other):
            if isinstance(field, tuple):
                fields[i] += field
    return type(first)(*fields)


def test_many_hand_overs_fill_as_few_frames_as_possible() -> None:
    small = HELLO._replace(payload=b"x" * 35)
    frames = encode(Data(1, 2, tuple(Handover(n + 1, small) for n in range(5))), NOW)
    decoded = [decode(frame, NOW) for frame in frames]
    assert [len(m.handovers) for m in decoded if isinstance(m, Data)] == [2, 2, 1]


def test_the_beacon_is_small() -> None:
    assert all(len(encode(m, NOW)[0]) <= 40 for m in SAMPLES.values() if isinstance(m, Beacon))


@given(any_message, st.binary(min_size=1, max_size=20))
def test_appended_fields_are_ignored(message: Message, extra: bytes) -> None:
    if isinstance(message, Chunk):
        return  # A chunk's data reach to the end of the frame; see the document.
    if isinstance(message, Beacon) and not message.turn:
        message = message._replace(turn=1)  # it is left out where it is 0, and what follows would be taken for it
    for frame in encode(message, NOW):
        assert decode(frame + extra, NOW) == decode(frame, NOW)


def understood(payload: bytes) -> bool:
    """Whether the bytes are a message; nothing but `MalformedError` may say that they are not."""
    try:
        return decode(payload, NOW) is not None
    except MalformedError:
        return False


@given(st.binary(max_size=140))
def test_any_bytes_are_a_message_or_malformed(payload: bytes) -> None:
    if understood(payload):
        assert payload[0] >> 4 == VERSION


@given(st.sampled_from(range(1, 15)), st.binary(max_size=127))
def test_any_bytes_behind_a_good_head(kind: int, rest: bytes) -> None:
    payload = bytes([VERSION << 4 | kind]) + rest
    if understood(payload):
        message = decode(payload, NOW)
        assert message is not None
        # What was understood can be said again.
        assert encode(message, NOW)


@given(any_message, st.data())
def test_flipped_bits(message: Message, draw: st.DataObject) -> None:
    frame = bytearray(encode(message, NOW)[0])
    for bit in draw.draw(st.sets(st.integers(0, len(frame) * 8 - 1), min_size=1, max_size=4)):
        frame[bit >> 3] ^= 1 << (bit & 7)
    understood(bytes(frame))


@pytest.mark.parametrize("name", SAMPLES)
def test_truncated_messages_are_malformed(name: str) -> None:
    frame = encode(SAMPLES[name], NOW)[0]
    # A chunk may be cut anywhere behind its head and only gets shorter: its receiver knows how long it must be.
    # A beacon without a turn is whole.
    end = 5 if isinstance(SAMPLES[name], Chunk) else 37 if isinstance(SAMPLES[name], Beacon) else len(frame)
    for size in range(end):
        with pytest.raises(MalformedError):
            decode(frame[:size], NOW)


@pytest.mark.parametrize("head", [0x01, 0x21, 0xF1, 0x10, 0x1F])
def test_other_versions_and_types_are_foreign(head: int) -> None:
    with pytest.raises(ForeignError):
        decode(bytes([head]) + bytes(127), NOW)


def test_the_target_can_be_told_without_decoding() -> None:
    for name, message in SAMPLES.items():
        frame = encode(message, NOW)[0]
        named = BROADCAST if isinstance(message, Chunk) else getattr(message, "target", BROADCAST)
        assert target_of(frame) == named, name
        assert target_of(frame[:4]) == target_of(b"") == target_of(b"\xff" + frame[1:]) == BROADCAST


@pytest.mark.parametrize(
    ("name", "offset", "bad"),
    [("offer", 29, b"\0\0\0\0"), ("offer", 33, b"\0"), ("offer", 33, b"\x7c"), ("data", 30, b"\0"),
     ("sack", 9, b"\x21"), ("put", 27, b"\0"), ("beacon-drone", 1, b"\xff\xff")],
)  # fmt: skip
def test_impossible_values_are_malformed(name: str, offset: int, bad: bytes) -> None:
    frame = encode(SAMPLES[name], NOW)[0]
    with pytest.raises(MalformedError):
        decode((frame[:offset] + bad + frame[offset + len(bad) :]).ljust(128, b"\0"), NOW)


@pytest.mark.parametrize("name", SAMPLES)
def test_the_same_bytes_say_the_same_whenever_they_are_heard_but_for_ages(name: str) -> None:
    payload = golden()[name]
    for now in (NOW, NOW + 5.0, NOW):
        message = decode(payload, now)
        assert message is not None
        assert message == decode(bytes(bytearray(payload)), now)
        [again] = encode(message, now)
        assert again == payload


def test_what_does_not_go_whole_is_our_bug() -> None:
    too_large = HELLO._replace(payload=bytes(INLINE_BYTES + 1))
    with pytest.raises(ValueError, match="does not go whole"):
        encode(Data(1, 2, ((1, too_large),)), NOW)  # type: ignore[arg-type]


def test_ages_are_relative_to_each_ones_clock_and_bounded() -> None:
    [frame] = encode(SAMPLES["data"], NOW)
    there = decode(frame, 5.0)
    assert isinstance(there, Data)
    assert there.handovers[0].datum.created == 3.5
    future = Data(3, 2, ((1, HELLO._replace(created=NOW + 9)), (2, HELLO._replace(created=-1e9))))  # type: ignore[arg-type]
    [frame] = encode(future, NOW)
    back = decode(frame, NOW)
    assert isinstance(back, Data)
    assert [h.datum.created for h in back.handovers] == [NOW, NOW - 0xFFFFFFFF / 1000]
