"""Challenges on the wire: golden vectors, a round trip, and no other error than `MalformedError`."""

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.wire import MAX_TUNNEL, decode
from rass_mav.wire.challenge import (
    MAX_ANSWERED,
    MAX_ASKED,
    Asked,
    Challenge,
    decode_challenge,
    encode_challenge,
    is_challenge,
)
from rass_mav.wire.codec import ForeignError

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"
NONCE = 0x1122334455667788
SAMPLES = {
    "challenge": Challenge((Asked((7, 191, 0x5E), 0), Asked((8, 191, 0x21), 0x0102030405)), NONCE),
    "challenge-answers": Challenge(answered=(NONCE, 0x99AABBCCDDEEFF00)),
    "challenge-both": Challenge((Asked((7, 191, 0x5E), 16777216),), NONCE, (0x99AABBCCDDEEFF00,)),
}

bytes_ = st.integers(0, 255)
challenges = st.builds(
    lambda asked, nonce, answered: Challenge(tuple(asked), nonce if asked else 0, tuple(answered)),
    st.lists(st.builds(Asked, st.tuples(bytes_, bytes_, bytes_), st.integers(0, 2**48 - 1)), max_size=MAX_ASKED),
    st.integers(0, 2**64 - 1),
    st.lists(st.integers(0, 2**64 - 1), max_size=MAX_ANSWERED),
)


@pytest.mark.parametrize("name", SAMPLES)
def test_the_page_shows_these_bytes(name: str) -> None:
    assert f"| `{name}` | `{encode_challenge(SAMPLES[name]).hex()}` |" in PROTOCOL.read_text(encoding="utf-8")


@given(challenge=challenges)
def test_what_is_encoded_is_decoded(challenge: Challenge) -> None:
    payload = encode_challenge(challenge)
    assert is_challenge(payload)
    assert len(payload) <= MAX_TUNNEL
    assert decode_challenge(payload) == challenge
    # What follows is of a later version.
    assert decode_challenge(payload + b"more") == challenge


@given(data=st.binary(max_size=126))
def test_any_bytes_are_a_challenge_or_malformed(data: bytes) -> None:
    with suppress(MalformedError):
        decode_challenge(encode_challenge(Challenge())[:2] + data)


@given(challenge=challenges, length=st.integers(2, 127))
def test_a_challenge_that_is_cut_off_is_malformed(challenge: Challenge, length: int) -> None:
    payload = encode_challenge(challenge)
    if length < len(payload):
        with pytest.raises(MalformedError):
            decode_challenge(payload[:length])


def test_a_node_without_keys_does_not_know_challenges() -> None:
    payload = encode_challenge(SAMPLES["challenge"])
    with pytest.raises(ForeignError):
        decode(payload, 0.0)
    assert not is_challenge(b"\x2f\x10")
    assert not is_challenge(b"")
