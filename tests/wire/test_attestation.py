"""The ground's word on the wire: golden vectors, a round trip, and no other error than `MalformedError`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import Ground, NodeKeys
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.statement_signatures import hash_of
from rass_mav.wire import MAX_TUNNEL, decode, encode
from rass_mav.wire.attestation import (
    MAX_BASES_ASKED,
    MAX_STATEMENTS_ASKED,
    MAX_VOUCHED,
    STATEMENT_SIGNATURE,
    Anchor,
    Ask,
    Signed,
    StatementSignature,
    body_of,
    decode_attestation,
    encode_ask,
    is_attestation,
)
from rass_mav.wire.codec import ForeignError

from .samples import NOW, SAMPLES

PROTOCOL = Path(__file__).parents[2] / "docs" / "protocol.md"
GROUND = Ground(Secret(bytes(range(32))))
KEYS: NodeKeys = GROUND.node(1)
WORD = Attestation(Keyring(KEYS, GROUND))
BASE = (1, 0x0BADF00D)


def statement_signature() -> bytes:
    """For the statements `receipt` and `receipt-lost` of the page, with serials 513 and 514."""
    hashes = tuple(hash_of(encode(SAMPLES[name], NOW)[0], 0x01020304) for name in ("receipt", "receipt-lost"))
    body = body_of(StatementSignature(*BASE, 513, 0x01020304, hashes))
    return body + WORD.vouch(body)


def anchor() -> bytes:
    """Of a chain whose end is a0a1...a7."""
    body = body_of(Anchor(*BASE, 7, 40, bytes(range(0xA0, 0xA8))))
    return body + WORD.anchor(body)


GOLDEN = {
    "statement-signature": statement_signature(),
    "anchor": anchor(),
    "ask": encode_ask(Ask((BASE,), ((*BASE, 513), (*BASE, 515)))),
}

u16, u32 = st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)
eight, signatures = st.binary(min_size=8, max_size=8), st.binary(min_size=64, max_size=64)
statement_signatures = st.builds(
    StatementSignature, u16, u32, u32, u32, st.lists(eight, min_size=1, max_size=MAX_VOUCHED).map(tuple)
)
anchors = st.builds(Anchor, u16, u32, u32, u16, eight)
asks = st.builds(
    Ask,
    st.lists(st.tuples(u16, u32), max_size=MAX_BASES_ASKED).map(tuple),
    st.lists(st.tuples(u16, u32, u32), max_size=MAX_STATEMENTS_ASKED).map(tuple),
)


@pytest.mark.parametrize("name", GOLDEN)
def test_the_page_shows_these_bytes(name: str) -> None:
    assert f"| `{name}` | `{GOLDEN[name].hex()}` |" in PROTOCOL.read_text(encoding="utf-8")


def test_the_ground_has_signed_the_golden_vectors() -> None:
    drone = Attestation(Keyring(GROUND.node(7, 2), None))
    for name, is_signed in (("statement-signature", drone.vouches), ("anchor", drone.anchors)):
        signed = decode_attestation(GOLDEN[name])
        assert isinstance(signed, Signed)
        assert is_signed(signed.body, signed.signature)
        # The one is not the other.
        assert not (drone.anchors if signed.kind == STATEMENT_SIGNATURE else drone.vouches)(
            signed.body, signed.signature
        )


@given(content=statement_signatures | anchors, signature=signatures)
def test_what_is_signed_is_decoded(content: StatementSignature | Anchor, signature: bytes) -> None:
    payload = body_of(content) + signature
    assert is_attestation(payload)
    assert len(payload) <= MAX_TUNNEL
    signed = decode_attestation(payload + b"more")
    assert isinstance(signed, Signed)
    assert (signed.content, signed.signature, signed.payload) == (content, signature, payload)
    for size in range(2, len(payload)):
        with pytest.raises(MalformedError):
            decode_attestation(payload[:size])


@given(ask=asks)
def test_what_is_asked_is_decoded(ask: Ask) -> None:
    payload = encode_ask(ask)
    assert is_attestation(payload)
    assert len(payload) <= MAX_TUNNEL
    assert decode_attestation(payload + b"more") == ask


@given(kind=st.sampled_from([payload[1] for payload in GOLDEN.values()]), data=st.binary(max_size=126))
def test_any_bytes_are_a_word_or_malformed(kind: int, data: bytes) -> None:
    with suppress(MalformedError):
        decode_attestation(bytes((0x2F, kind)) + data)


def test_a_node_without_keys_ignores_them() -> None:
    for payload in GOLDEN.values():
        with pytest.raises(ForeignError):
            decode(payload, NOW)
