"""Key updates and key summaries on the wire: golden vectors, round trips, and no other error than `MalformedError`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ForgedError, MalformedError
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.key_updates import (
    KEY_UPDATE_SIZE,
    REVOCATION_SIZE,
    KeyUpdate,
    KeyUpdateOpener,
    key_updates_in,
    key_updates_text,
    write_key_update,
)
from rass_mav.trust.keys.secret import Purpose, Secret
from rass_mav.wire import MAX_TUNNEL, decode
from rass_mav.wire.codec import ForeignError
from rass_mav.wire.introduction import is_introduction
from rass_mav.wire.key_updates import (
    MAX_NAMED,
    KeySummary,
    decode_key_summary,
    enclose,
    enclosed,
    encode_key_summary,
    is_about_keys,
    is_key_update,
)

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"
GROUND = Ground(Secret(bytes(range(32))), number=2, serials={7: 2, 8: 1}, revoked=frozenset({8}))
STRANGER = Ground(Secret(bytes(32)), number=2, serials={7: 2, 8: 1}, revoked=frozenset({8}))
SEVEN, EIGHT = write_key_update(GROUND, 7), write_key_update(GROUND, 8)
SAMPLES = {
    "key-update": enclose(SEVEN.pack()),
    "key-update-revoked": enclose(EIGHT.pack()),
    "key-summary": encode_key_summary(KeySummary(9, 1, 2, 0xB4BF064E)),
    "key-summary-named": encode_key_summary(KeySummary(9, 1, 2, 0xB4BF064E, 0, 65534, {7: 4, 8: 3})),
}

words = st.integers(0, 2**32 - 1)
ids = st.integers(0, 65535)
key_summaries = st.builds(
    KeySummary, ids, words, words, words, ids, ids, st.dictionaries(ids, st.integers(0, 255), max_size=MAX_NAMED)
)
key_updates = st.builds(
    KeyUpdate,
    words,
    ids,
    words,
    st.just(b"") | st.binary(min_size=48, max_size=48),
    st.binary(min_size=64, max_size=64),
)


@pytest.mark.parametrize("name", SAMPLES)
def test_golden_vectors_are_those_of_the_protocol(name: str) -> None:
    assert f"| `{name}` | `{SAMPLES[name].hex()}` |" in PROTOCOL.read_text(encoding="utf-8")


@given(key_summary=key_summaries)
def test_a_roll_that_is_encoded_is_decoded(key_summary: KeySummary) -> None:
    payload = encode_key_summary(key_summary)
    assert is_about_keys(payload)
    assert not is_key_update(payload)
    assert len(payload) <= MAX_TUNNEL
    assert decode_key_summary(payload) == key_summary
    # Fields may be appended.
    assert decode_key_summary((payload + b"more")[:MAX_TUNNEL]) == key_summary


@given(key_update=key_updates)
def test_a_key_update_that_is_packed_is_unpacked(key_update: KeyUpdate) -> None:
    payload = enclose(key_update.pack())
    assert is_about_keys(payload)
    assert is_key_update(payload)
    assert len(payload) in (2 + KEY_UPDATE_SIZE, 2 + REVOCATION_SIZE)
    assert len(payload) + 3 <= MAX_TUNNEL
    assert KeyUpdate.unpack(enclosed(payload)) == key_update
    assert KeyUpdate.unpack(enclosed(payload) + b"more") == key_update


@given(data=st.binary(max_size=126))
def test_any_bytes_are_a_key_update_and_a_roll_or_malformed(data: bytes) -> None:
    with suppress(MalformedError):
        KeyUpdate.unpack(data)
    with suppress(MalformedError):
        decode_key_summary(SAMPLES["key-summary"][:2] + data)


@given(payload=st.sampled_from(sorted(SAMPLES)), length=st.integers(2, 127))
def test_what_is_cut_off_is_malformed(payload: str, length: int) -> None:
    whole = SAMPLES[payload]
    if length < len(whole):
        with pytest.raises(MalformedError):
            KeyUpdate.unpack(enclosed(whole[:length])) if is_key_update(whole) else decode_key_summary(whole[:length])


def test_a_node_without_keys_does_not_know_them_and_they_are_no_introductions() -> None:
    for payload in SAMPLES.values():
        with pytest.raises(ForeignError):
            decode(payload, 0.0)
        assert not is_introduction(payload)
    for payload in (b"\x3f\x10", b"\x3f", b"", b"\x2f\xf9", b"\x1f\xf8"):
        assert not is_about_keys(payload)


# -- what is in a key update -------------------------------------------------------------------------------------------


def test_a_key_update_opens_for_its_drone_alone_and_everybody_sees_who_has_written_it() -> None:
    assert KeyUpdateOpener(GROUND.node(7, 2)).open(SEVEN) == GROUND.link_key(2)
    for other in (GROUND.node(7, 1), GROUND.node(8, 1), GROUND.node(1), STRANGER.node(7, 2)):
        with pytest.raises(ForgedError, match="not written to this drone"):
            KeyUpdateOpener(other).open(SEVEN)
    for key_update in (SEVEN, EIGHT):
        key_update.verify(GROUND.public)
        with pytest.raises(ForgedError):
            key_update.verify(STRANGER.public)
    assert GROUND.link_key(2).key.reveal() not in SEVEN.pack()
    assert (EIGHT.sealed, EIGHT.last_revoked, SEVEN.last_revoked) == (b"", 1, 1)


def test_whoever_writes_a_key_update_again_writes_the_same() -> None:
    """So the same key and nonce never seal two contents, whatever becomes of the other drones."""
    changed = replace(GROUND, serials={**GROUND.serials, 9: 1}, revoked=frozenset())
    assert write_key_update(changed, 7) == SEVEN
    assert write_key_update(replace(GROUND, number=3), 7).sealed != SEVEN.sealed


@given(bit=st.integers(0, 8 * KEY_UPDATE_SIZE - 1))
def test_an_altered_key_update_is_noticed(bit: int) -> None:
    packed = SEVEN.pack()
    altered = bytearray(packed)
    altered[bit // 8] ^= 1 << bit % 8
    try:
        key_update = KeyUpdate.unpack(bytes(altered))
    except MalformedError:
        return
    with pytest.raises(ForgedError):
        key_update.verify(GROUND.public)
    if bit < 8 * (KEY_UPDATE_SIZE - 64) and key_update.sealed and key_update[1:3] == SEVEN[1:3]:
        with pytest.raises(ForgedError):
            KeyUpdateOpener(GROUND.node(7, 2)).open(key_update)


def test_another_word_of_the_ground_is_no_key_update() -> None:
    with pytest.raises(ForgedError):
        SEVEN._replace(signature=GROUND.sign(Purpose.CERTIFICATE, SEVEN.body)).verify(GROUND.public)


def test_the_later_the_higher_and_a_revocation_above_a_key() -> None:
    ranks = [
        write_key_update(ground, 7).rank
        for ground in (
            GROUND,
            replace(GROUND, revoked=frozenset({7})),
            replace(GROUND, serials={7: 3}),
            replace(GROUND, number=3, serials={7: 1}),
        )
    ]
    assert ranks == sorted(set(ranks))


# -- on disk -----------------------------------------------------------------------------------------------------------

PACKED = [SEVEN.pack(), EIGHT.pack()]
FILE = key_updates_text(PACKED).encode()


def test_what_was_kept_is_read() -> None:
    assert key_updates_in(FILE, GROUND.public) == PACKED
    assert key_updates_in(key_updates_text([]).encode(), GROUND.public) == []
    assert key_updates_in(FILE, STRANGER.public) == []


@given(at=st.integers(0, len(FILE) - 2), other=st.integers(0, 255))
def test_damage_to_the_file_is_noticed(at: int, other: int) -> None:
    if FILE[at] == other:
        return
    with pytest.raises(MalformedError):
        key_updates_in(FILE[:at] + bytes([other]) + FILE[at + 1 :], GROUND.public)


@pytest.mark.parametrize("data", [b"", b"\n", FILE[:-30], b"rass letters 2" + FILE[14:], FILE * 2, b"\xff" * 40])
def test_what_is_no_file_of_key_updates(data: bytes) -> None:
    with pytest.raises(MalformedError):
        key_updates_in(data, GROUND.public)
