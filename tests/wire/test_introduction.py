"""Introductions on the wire: golden vectors, a round trip, and no other error than `MalformedError`."""

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.trust.keys.certificate import CERTIFICATE_SIZE
from rass_mav.wire import MAX_TUNNEL, decode
from rass_mav.wire.codec import ForeignError
from rass_mav.wire.introduction import (
    ASKED_BESIDE,
    CERTIFICATE_BYTES,
    MAX_ASKED,
    MAX_PROOFS,
    Introduction,
    Whereabouts,
    decode_introduction,
    encode_introduction,
    is_introduction,
)
from tests.trust.test_words import SEVEN

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"
NONCE = 0x1122334455667788
WHERE = Whereabouts(0x0A0B0C0D00000005, 70004, bytes(range(0xB0, 0xB8)), bytes(range(0xC0, 0xC8)))
SAMPLES = {
    "introduction-question": Introduction(3, asked=(7, 8), wants=True, nonce=NONCE),
    "introduction-proofs": Introduction(7, whereabouts=WHERE, proofs=((3, bytes(range(8))), (8, bytes(8)))),
    "introduction-certificate": Introduction(7, SEVEN.certificate.pack(), asked=(3,), nonce=NONCE),
}

ids = st.integers(0, 65534)
numbers = st.integers(0, 2**64 - 1)
keys = st.binary(min_size=8, max_size=8)
wheres = st.builds(Whereabouts, numbers, st.integers(0, 2**32 - 1), keys, keys)


@st.composite
def introductions(draw: st.DrawFn) -> Introduction:
    certificate = draw(st.just(b"") | st.binary(min_size=CERTIFICATE_BYTES, max_size=CERTIFICATE_BYTES))
    asked = tuple(draw(st.lists(ids, max_size=ASKED_BESIDE if certificate else MAX_ASKED)))
    proofs = tuple(draw(st.lists(st.tuples(ids, keys), max_size=0 if certificate else MAX_PROOFS)))
    return Introduction(
        draw(ids), certificate, asked, draw(st.booleans()), draw(numbers) if asked else 0,
        draw(wheres) if proofs else Whereabouts(), proofs,
    )  # fmt: skip


@pytest.mark.parametrize("name", SAMPLES)
def test_the_page_shows_these_bytes(name: str) -> None:
    assert f"| `{name}` | `{encode_introduction(SAMPLES[name]).hex()}` |" in PROTOCOL.read_text(encoding="utf-8")


def test_the_wire_has_room_for_a_certificate() -> None:
    assert CERTIFICATE_BYTES == CERTIFICATE_SIZE


@given(introduction=introductions())
def test_what_is_encoded_is_decoded(introduction: Introduction) -> None:
    payload = encode_introduction(introduction)
    assert is_introduction(payload)
    assert len(payload) <= MAX_TUNNEL
    assert decode_introduction(payload) == introduction
    # What follows is of a later version.
    assert decode_introduction(payload + b"more") == introduction


@given(data=st.binary(max_size=126))
def test_any_bytes_are_an_introduction_or_malformed(data: bytes) -> None:
    with suppress(MalformedError):
        encode_introduction(decode_introduction(encode_introduction(Introduction(1))[:2] + data))


@given(introduction=introductions(), length=st.integers(2, 127))
def test_an_introduction_that_is_cut_off_is_malformed(introduction: Introduction, length: int) -> None:
    payload = encode_introduction(introduction)
    if length < len(payload):
        with pytest.raises(MalformedError):
            decode_introduction(payload[:length])


def test_too_much_is_not_sent() -> None:
    with pytest.raises(ValueError, match="too much"):
        encode_introduction(Introduction(1, bytes(CERTIFICATE_BYTES), proofs=((3, bytes(8)),)))


def test_a_node_without_keys_does_not_know_introductions() -> None:
    with pytest.raises(ForeignError):
        decode(encode_introduction(SAMPLES["introduction-question"]), 0.0)
