from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import Datum
from rass_mav.core.messages import (
    BROADCAST,
    Beacon,
    Chunk,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionReport,
    Distance,
    Handover,
    Message,
    Offer,
    Put,
)
from rass_mav.errors import MalformedError
from rass_mav.wire import MAX_TUNNEL, decode, encode, target_of
from rass_mav.wire.codec import ANSWERS, DISTANCE, KEY, MOTION, PROOF, UPDATES, VERSION, ForeignError

from .samples import HELLO, NOW, SAMPLES, any_message, by_type
from .version_1 import VERSION_1

DOCS = Path(__file__).parents[2] / "docs"


def golden() -> dict[str, bytes]:
    """name -> bytes, from the tables of golden vectors in the documents."""
    protocol, policies = (next(DOCS.rglob(name)).read_text(encoding="utf-8") for name in ("protocol.md", "policies.md"))
    text = protocol.split("## Golden vectors")[1] + policies.split("## Virtual stigmergy")[1]
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
        assert isinstance(message, (Data, Committed, DeletionReport, CopyStatuses))
        assert same(message, joined(parts))


def told(messages: Sequence[Message]) -> list[tuple[int, ...]]:
    """What all answers among the messages, and on them, tell: sender, target, number, and the CRC if it is
    committed."""
    answers = [m for m in messages if isinstance(m, Committed)]
    answers += [answer for m in messages if isinstance(m, Beacon) for answer in m.answers]
    rows = [(a.sender, a.target, *done) for a in answers for done in a.committed]
    return sorted([*rows, *[(a.sender, a.target, number) for a in answers for number in a.refused]])


def joined(parts: Sequence[Message]) -> Message:
    """One message from the frames that it had to be split over."""
    first, *others = parts
    fields: list[Any] = list(first)
    for other in others:
        for i, field in enumerate(other):
            if isinstance(field, tuple) and not isinstance(field, Distance):
                fields[i] += field
    return type(first)(*fields)


def test_many_hand_overs_fill_as_few_frames_as_possible() -> None:
    small = HELLO._replace(payload=b"x" * 35)
    frames = encode(Data(1, 2, tuple(Handover(n + 1, small) for n in range(5))), NOW)
    decoded = [decode(frame, NOW) for frame in frames]
    assert [len(m.handovers) for m in decoded if isinstance(m, Data)] == [2, 2, 1]


def test_the_beacon_is_small() -> None:
    beacons = [m for m in SAMPLES.values() if isinstance(m, Beacon)]
    blocks = [10 * sum(map(bool, (m.moves, m.proof, m.key))) + 6 * bool(m.updates) for m in beacons]
    answers = [2 * bool(m.answers) + 12 * len(m.answers) for m in beacons]
    sizes = [43 + sum(both) for both in zip(blocks, answers, strict=True)]
    assert [len(encode(m, NOW)[0]) for m in beacons] == sizes
    assert max(len(encode(m._replace(answers=()), NOW)[0]) for m in beacons) <= 74


def sealed(beacon: bytes, extra: bytes = b"") -> bytes:
    """The bytes of a beacon of a later version of the format, with more behind it: the checksum covers all of it."""
    end = beacon[41:] + extra
    return beacon[:37] + zlib.crc32(end, zlib.crc32(beacon[:37])).to_bytes(4, "little") + end


def block(kind: int, content: bytes) -> bytes:
    return bytes((kind, len(content))) + content


#: Blocks of kinds that this version does not know: a later one may append them.
unknown_blocks = st.builds(
    block,
    st.integers(0, 255).filter(lambda kind: kind not in (ANSWERS, DISTANCE, MOTION, PROOF, KEY, UPDATES)),
    st.binary(max_size=30),
)
later = st.lists(unknown_blocks, min_size=1, max_size=2).map(b"".join)


@given(by_type[Beacon], later)
def test_unknown_blocks_of_a_beacon_are_ignored_but_belong_to_its_checksum(beacon: Message, extra: bytes) -> None:
    [payload] = encode(beacon, NOW)
    assert sealed(payload) == payload
    assert decode(sealed(payload, extra), NOW) == beacon
    with pytest.raises(MalformedError):
        decode(payload + extra, NOW)


@given(by_type[Data], later)
def test_unknown_blocks_of_data_are_ignored(data: Message, extra: bytes) -> None:
    for frame in encode(data, NOW):
        if frame[0] == SAMPLE_DATA[0]:
            assert decode(frame + extra, NOW) == decode(frame, NOW)


SAMPLE_DATA = encode(SAMPLES["data"], NOW)[0]
SAMPLE_BEACON = encode(SAMPLES["beacon-drone"], NOW)[0]


@pytest.mark.parametrize("extra", [b"\x09", b"\x09\x01", block(9, b"four")[:-1], block(ANSWERS, b"\x02\x00\x01"),
                                   block(ANSWERS, b"\x02\x00\x01\x00\x04\x03\x02\x01"),
                                   block(ANSWERS, b"\x02\x00\xff\xff") + block(9, bytes(80))])  # fmt: skip
def test_a_truncated_block_is_malformed(extra: bytes) -> None:
    """So is an answer that does not end where its block does: it reads nothing behind it."""
    for payload in (SAMPLE_DATA + extra, sealed(SAMPLE_BEACON, extra)):
        with pytest.raises(MalformedError):
            decode(payload, NOW)


@given(later)
def test_answers_are_found_among_other_blocks(other: bytes) -> None:
    message = SAMPLES["beacon-answers"]
    assert isinstance(message, Beacon)
    [payload], [bare] = encode(message, NOW), encode(message._replace(answers=()), NOW)
    moved = payload[: len(bare)] + other + payload[len(bare) :]
    assert same(decode(sealed(moved), NOW), message)


@pytest.mark.parametrize("custodians", [1, 2, 9])
def test_a_beacon_repeats_as_many_answers_as_fit(custodians: int) -> None:
    """Also if they are all for one neighbour. The others are left out: it is one frame."""
    beacon = SAMPLES["beacon-drone"]
    assert isinstance(beacon, Beacon)
    answers = tuple([Committed(3, to, tuple((10 * to + n, n) for n in range(10)), ()) for to in range(custodians)])
    [payload] = encode(beacon._replace(answers=answers), NOW)
    assert MAX_TUNNEL - 12 - 12 < len(payload) <= MAX_TUNNEL - 12, "a message authentication code fits behind it"
    heard = decode(payload, NOW)
    repeated = told([heard])
    assert len(repeated) == 8
    assert set(repeated) < set(told(answers))


@given(by_type[Beacon], later, st.data())
def test_no_flipped_bit_in_a_beacon_goes_unseen(beacon: Message, extra: bytes, draw: st.DataObject) -> None:
    payload = bytearray(sealed(encode(beacon, NOW)[0], extra))
    bit = draw.draw(st.integers(0, len(payload) * 8 - 1))
    payload[bit >> 3] ^= 1 << (bit & 7)
    if bit >= 8:
        with pytest.raises(MalformedError):
            decode(bytes(payload), NOW)
    elif understood(bytes(payload)):
        # The first byte says another type now; what the bytes mean as such a message is for that one's rules.
        assert not isinstance(decode(bytes(payload), NOW), Beacon)


@given(by_type[Beacon], st.integers(1, 42))
def test_a_beacon_whose_end_is_zeros_is_none(beacon: Message, size: int) -> None:
    """As when the length in the frame is damaged, and zeros are restored that never were there."""
    [payload] = encode(beacon, NOW)
    damaged = payload[:size].ljust(len(payload), b"\0")
    if damaged != payload:
        with pytest.raises(MalformedError):
            decode(damaged, NOW)


@pytest.mark.parametrize(
    "message",
    [
        Committed(2, 3, tuple((n, n) for n in range(40)), tuple(range(60))),
        Committed(2, 3, (), tuple(range(60))),
        CopyStatuses(2, 3, (CopyStatusEntry(HELLO.id, CopyStatus.AGAIN),) * 40),
    ],
)
def test_where_custody_ends_there_is_room_for_a_code_that_proves_who_said_so(message: Message) -> None:
    lengths = [len(frame) for frame in encode(message, NOW)]
    assert max(lengths) <= MAX_TUNNEL - 12
    assert max(lengths) > MAX_TUNNEL - 12 - 11, "not more than that is given away"


@given(any_message, st.binary(min_size=1, max_size=20))
def test_appended_fields_are_ignored(message: Message, extra: bytes) -> None:
    if isinstance(message, Chunk | Beacon | Data):
        return  # A chunk's data reach to the end of the frame; what is behind the other two has a form.
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


@given(st.sampled_from([bytes([VERSION << 4 | kind]) for kind in range(1, 15)]), st.binary(max_size=126))
def test_any_bytes_behind_a_good_head(head: bytes, rest: bytes) -> None:
    payload = head + rest
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
    end = 5 if isinstance(SAMPLES[name], Chunk) else len(frame)
    # And replicas without their block are those of a custodian.
    sample = SAMPLES[name]
    bare = len(encode(sample._replace(distance=None), NOW)[0]) if isinstance(sample, Data) else end
    for size in {*range(end)} - {bare}:
        with pytest.raises(MalformedError):
            decode(frame[:size], NOW)


@pytest.mark.parametrize("head", [0x01, 0x11, 0x21, 0x31, 0xF1, 0x40, 0x4F])
def test_other_versions_and_types_are_foreign(head: int) -> None:
    for size in (0, 1, 2, 127):
        with pytest.raises(ForeignError) as raised:
            decode(bytes([head]) + bytes(size), NOW)
        assert raised.value.version == head >> 4


def test_who_speaks_another_version_is_known_where_the_message_says_so() -> None:
    for name, payload in VERSION_1.items():
        with pytest.raises(ForeignError) as raised:
            decode(payload, NOW)
        nameless = name in ("chunk", "chunk-poll", "receipt", "receipt-span")
        sender = None if nameless else SAMPLES[name].sender  # type: ignore[union-attr]
        assert (raised.value.version, raised.value.sender) == (1, sender), name
    for nobody in (b"\x11", b"\x11\x03", b"\x11\xff\xff" + bytes(40), b"\x1e\x03\x00", b"\x1f\x03\x00"):
        with pytest.raises(ForeignError) as raised:
            decode(nobody, NOW)
        assert raised.value.sender is None


def test_the_first_version_takes_nothing_of_this_one() -> None:
    """It reads on only if the high four bits of the first byte are its own."""
    its_own = {payload[0] >> 4 for payload in VERSION_1.values()}
    assert its_own.isdisjoint(encode(message, NOW)[0][0] >> 4 for message in SAMPLES.values())


def test_the_target_can_be_told_without_decoding() -> None:
    for name, message in SAMPLES.items():
        frame = encode(message, NOW)[0]
        named = BROADCAST if isinstance(message, Chunk) else getattr(message, "target", BROADCAST)
        assert target_of(frame) == named, name
        assert target_of(frame[:4]) == target_of(b"") == target_of(b"\xff" + frame[1:]) == BROADCAST


@pytest.mark.parametrize(
    ("name", "offset", "bad"),
    [("offer", 29, b"\0\0\0\0"), ("offer", 33, b"\0"), ("offer", 33, b"\x7c"), ("data", 30, b"\0"),
     ("sack", 9, b"\x21"), ("put", 27, b"\0")],
)  # fmt: skip
def test_impossible_values_are_malformed(name: str, offset: int, bad: bytes) -> None:
    frame = encode(SAMPLES[name], NOW)[0]
    with pytest.raises(MalformedError):
        decode((frame[:offset] + bad + frame[offset + len(bad) :]).ljust(128, b"\0"), NOW)


def test_a_beacon_from_everybody_is_malformed() -> None:
    frame = encode(SAMPLES["beacon-drone"], NOW)[0]
    with pytest.raises(MalformedError, match="broadcast id"):
        decode(sealed(frame[:1] + b"\xff\xff" + frame[3:]), NOW)


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
    too_large = HELLO._replace(payload=bytes(98))
    with pytest.raises(ValueError, match="does not fit one frame"):
        encode(Data(1, 2, ((1, too_large),)), NOW)  # type: ignore[arg-type]


def test_ages_are_relative_to_each_ones_clock_and_bounded() -> None:
    [frame] = encode(SAMPLES["data"], NOW)
    there = decode(frame, 5.0)
    assert isinstance(there, Data)
    assert there.handovers[0].datum.created == 3.5


OLDEST_MS = 0x7FFFFFFF


@pytest.mark.parametrize(
    ("age_s", "at_least", "says"),
    [
        (-9.0, False, (0, False)),
        (-9.0, True, (0, True)),
        (0.0, True, (0, True)),
        (1.5, True, (1500, True)),
        ((OLDEST_MS - 1) / 1000, False, (OLDEST_MS - 1, False)),
        (OLDEST_MS / 1000, False, (OLDEST_MS, True)),
        (1e9, False, (OLDEST_MS, True)),
        (1e9, True, (OLDEST_MS, True)),
    ],
)
def test_ages_at_their_bounds(age_s: float, at_least: bool, says: tuple[int, bool]) -> None:
    datum = HELLO._replace(created=NOW - age_s, at_least=at_least)
    offer = SAMPLES["offer"]
    assert isinstance(offer, Offer)
    data, put, offered = (
        decode(encode(message, NOW)[0], NOW)
        for message in (
            Data(3, 2, (Handover(1, datum),)),
            Put(3, 2, 4, datum),
            offer._replace(created=datum.created, at_least=at_least),
        )
    )
    assert isinstance(data, Data)
    assert isinstance(put, Put)
    assert isinstance(offered, Offer)
    for back in (data.handovers[0].datum, put.datum, offered):
        assert (round((NOW - back.created) * 1000), back.at_least) == says


@pytest.mark.parametrize(("name", "offset"), [("data", 20), ("offer", 19), ("put", 17)])
def test_the_oldest_age_means_at_least_even_without_the_bit(name: str, offset: int) -> None:
    frame = encode(SAMPLES[name], NOW)[0]
    back = decode(frame[:offset] + OLDEST_MS.to_bytes(4, "little") + frame[offset + 4 :], NOW)
    datum = back.handovers[0].datum if isinstance(back, Data) else back.datum if isinstance(back, Put) else back
    assert isinstance(datum, Offer | Datum)
    assert datum.at_least
    assert datum.created == NOW - OLDEST_MS / 1000
