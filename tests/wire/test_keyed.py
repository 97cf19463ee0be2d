"""What nodes with keys say about links and keys, and what the ground signs: golden vectors, round trips, and no other
error than `MalformedError`. One suite for all kinds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import MalformedError
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.certificate import CERTIFICATE_SIZE
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.key_updates import KeyUpdate
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.statement_signatures import hash_of
from rass_mav.wire import MAX_TUNNEL, decode, encode
from rass_mav.wire.attestation import (
    ANCHOR,
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
)  # fmt: skip
from rass_mav.wire.codec import VERSION, ForeignError
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
)  # fmt: skip
from rass_mav.wire.key_updates import (
    KeyRequest,
    decode_key_request,
    enclose,
    enclosed,
    encode_key_request,
    is_about_keys,
    is_key_update,
)  # fmt: skip
from tests.trust.test_words import SEVEN

from .kinds import beside, examples, type_of
from .samples import NOW, SAMPLES
from .test_key_updates import EIGHT as REVOKED
from .test_key_updates import SEVEN as UPDATE

GROUND = Ground(Secret(bytes(range(32))))
WORD = Attestation(Keyring(GROUND.node(1), GROUND))
BASE = (1, 0x0BADF00D)
NONCE = 0x1122334455667788
WHERE = Whereabouts(0x0A0B0C0D00000005, 70004, bytes(range(0xB0, 0xB8)), bytes(range(0xC0, 0xC8)))


def statement_signature() -> bytes:
    """For the statements `receipt` and `receipt-lost` of the page, with serials 513 and 514."""
    hashes = tuple(hash_of(encode(SAMPLES[name], NOW)[0], 0x01020304) for name in ("receipt", "receipt-lost"))
    body = body_of(StatementSignature(*BASE, 513, 0x01020304, hashes))
    return body + WORD.vouch(body)


def anchor() -> bytes:
    """Of a chain whose end is a0a1...a7."""
    body = body_of(Anchor(*BASE, 7, 40, bytes(range(0xA0, 0xA8))))
    return body + WORD.anchor(body)


#: All that the page shows.
GOLDEN = {
    "introduction-question": encode_introduction(Introduction(3, asked=(7, 8), wants=True, nonce=NONCE)),
    "introduction-proofs": encode_introduction(
        Introduction(7, whereabouts=WHERE, proofs=((3, bytes(range(8))), (8, bytes(8))))
    ),
    "introduction-certificate": encode_introduction(Introduction(7, SEVEN.certificate.pack(), asked=(3,), nonce=NONCE)),
    "statement-signature": statement_signature(),
    "anchor": anchor(),
    "ask": encode_ask(Ask((BASE,), ((*BASE, 513), (*BASE, 515)))),
    "key-update": enclose(UPDATE.pack()),
    "key-update-revoked": enclose(REVOKED.pack()),
    "key-request": encode_key_request(KeyRequest(9, 1, 1)),
}

u8, u16, u32, u64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))
ids = st.integers(0, 65534)
eight, signatures = st.binary(min_size=8, max_size=8), st.binary(min_size=64, max_size=64)
wheres = st.builds(Whereabouts, u64, u32, eight, eight)


@st.composite
def introductions(draw: st.DrawFn) -> Introduction:
    certificate = draw(st.just(b"") | st.binary(min_size=CERTIFICATE_BYTES, max_size=CERTIFICATE_BYTES))
    asked = tuple(draw(st.lists(ids, max_size=ASKED_BESIDE if certificate else MAX_ASKED)))
    proofs = tuple(draw(st.lists(st.tuples(ids, eight), max_size=0 if certificate else MAX_PROOFS)))
    return Introduction(
        draw(ids), certificate, asked, draw(st.booleans()), draw(u64) if asked else 0,
        draw(wheres) if proofs else Whereabouts(), proofs,
    )  # fmt: skip


hashes = st.lists(eight, min_size=1, max_size=MAX_VOUCHED).map(tuple)


def signed(kind: int, contents: st.SearchStrategy[Any]) -> st.SearchStrategy[Signed]:
    """What the ground has signed."""
    return st.builds(
        lambda content, signature: Signed(kind, content, body_of(content), signature), contents, signatures
    )


class Kind(NamedTuple):
    drawn: st.SearchStrategy[Any]
    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]
    is_one: Callable[[bytes], bool]


KINDS = {
    "Introduction": Kind(introductions(), encode_introduction, decode_introduction, is_introduction),
    "Statement signature": Kind(
        signed(STATEMENT_SIGNATURE, st.builds(StatementSignature, u16, u32, u32, u32, hashes)),
        lambda one: one.payload, decode_attestation, is_attestation,
    ),
    "Anchor": Kind(
        signed(ANCHOR, st.builds(Anchor, u16, u32, u32, u16, eight)), lambda one: one.payload, decode_attestation,
        is_attestation,
    ),
    "Ask": Kind(
        st.builds(
            Ask,
            st.lists(st.tuples(u16, u32), max_size=MAX_BASES_ASKED).map(tuple),
            st.lists(st.tuples(u16, u32, u32), max_size=MAX_STATEMENTS_ASKED).map(tuple),
        ),
        encode_ask, decode_attestation, is_attestation,
    ),
    "Key update": Kind(
        st.builds(KeyUpdate, u32, u16, u32, st.just(b"") | st.binary(min_size=48, max_size=48), signatures),
        lambda one: enclose(one.pack()), lambda payload: KeyUpdate.unpack(enclosed(payload)), is_key_update,
    ),
    "Key request": Kind(
        st.builds(KeyRequest, u16, u32, u32),
        encode_key_request, decode_key_request, lambda payload: is_about_keys(payload) and not is_key_update(payload),
    ),
}  # fmt: skip
EVERY_KIND = pytest.mark.parametrize("name", KINDS)


def test_the_page_shows_these_bytes() -> None:
    assert {name: payload for name, payload in examples().items() if type_of(payload) in beside()} == GOLDEN
    assert KINDS.keys() == set(beside().values())


@pytest.mark.no_cover
@EVERY_KIND
@given(data=st.data())
def test_what_is_encoded_is_decoded_and_malformed_if_it_is_cut_off(name: str, data: st.DataObject) -> None:
    kind = KINDS[name]
    value = data.draw(kind.drawn)
    payload = kind.encode(value)
    assert len(payload) <= MAX_TUNNEL
    assert [other for other in KINDS.values() if other.is_one(payload)] == [
        other for other in KINDS.values() if other.is_one is kind.is_one
    ]
    assert kind.decode(payload) == value
    # What follows is of a later version.
    assert kind.decode(payload + b"more") == value
    with pytest.raises(MalformedError):
        kind.decode(payload[: data.draw(st.integers(2, len(payload) - 1))])
    # A node without keys does not know it.
    with pytest.raises(ForeignError):
        decode(payload, NOW)


@EVERY_KIND
@given(behind=st.binary(max_size=126))
def test_any_bytes_are_one_or_malformed(name: str, behind: bytes) -> None:
    kind = KINDS[name]
    [number] = [number for number, title in beside().items() if title == name]
    with suppress(MalformedError):
        kind.encode(kind.decode(bytes((VERSION << 4 | 15, number)) + behind))


def test_what_is_none_of_them() -> None:
    for payload in (b"\x4f\x10", b"\x4f", b"", b"\x3f\xf9", b"\x1f\xf8"):
        assert not any(kind.is_one(payload) for kind in KINDS.values())


def test_the_ground_has_signed_the_golden_vectors() -> None:
    drone = Attestation(Keyring(GROUND.node(7, 2), None))
    for name, is_signed in (("statement-signature", drone.vouches), ("anchor", drone.anchors)):
        one = decode_attestation(GOLDEN[name])
        assert isinstance(one, Signed)
        assert is_signed(one.body, one.signature)
        # The one is not the other.
        assert not (drone.anchors if one.kind == STATEMENT_SIGNATURE else drone.vouches)(one.body, one.signature)


def test_the_wire_has_room_for_a_certificate_and_no_proofs_beside_it() -> None:
    assert CERTIFICATE_BYTES == CERTIFICATE_SIZE
    with pytest.raises(ValueError, match="too much"):
        encode_introduction(Introduction(1, bytes(CERTIFICATE_BYTES), proofs=((3, bytes(8)),)))
