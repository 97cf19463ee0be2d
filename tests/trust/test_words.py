"""Certificates, sealed data and tags: who can make them, who can read them, and how they look on the wire."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ForgedError, MalformedError
from rass_mav.trust.keys import sealing
from rass_mav.trust.keys.certificate import CERTIFICATE_SIZE, Certificate, GroundPublic, agreed
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.pairs import TAG_SIZE, Pair
from rass_mav.trust.keys.sealing import KEPT_KEYS, LATER_SERIALS, SEAL_SIZE, Opener, Sealer
from rass_mav.trust.keys.secret import Purpose, Secret
from rass_mav.wire import MAX_TUNNEL

GROUND = Ground(Secret(bytes(range(32))), number=2, serials={7: 2})
STRANGER = Ground(Secret(bytes(32)), serials={7: 2})
SEVEN, EIGHT, BASE = GROUND.node(7, 2), GROUND.node(8, 1), GROUND.node(1)
OPENER = Opener(GROUND)

nodes = st.integers(0, 65534)
numbers = st.integers(0, (1 << 32) - 1)
kinds = st.integers(0, 255)
secrets = st.binary(min_size=32, max_size=32).map(Secret)


def flipped(data: bytes, bit: int) -> bytes:
    return (int.from_bytes(data, "big") ^ 1 << bit % (8 * len(data))).to_bytes(len(data), "big")


# -- golden vectors: what must not change while swarms have keys -------------------------------------------------------


def test_the_keys_of_a_mission() -> None:
    assert GROUND.public == GroundPublic(
        bytes.fromhex("00f324aac5eaf279f6f0fe1567b70441001a285b7f4d9c6e55fbab252bc54623"),
        bytes.fromhex("cad6263bfefc67c60596121261dd97b6ed12cb8724b5cb750b2b05453c8b5d42"),
    )
    assert GROUND.public.mission == "b4598a8b"
    assert [(link.number, link.key.reveal().hex()) for link in (SEVEN.link, GROUND.link_key(1))] == [
        (2, "3b88f523a5cccee2f4a0368986d30cfac44ee2946e9c9917b8aaf3427a7c160a"),
        (1, "6c7db5facb62d684913dcef1cc4b3cfe6838fe93ab4d35148ec6c8d8eee4ad44"),
    ]
    assert SEVEN.secret.reveal().hex() == "517e3d1f1f7d7ed14b5d332bf3eb48e3d0f142edb55701e1a571fd5b9f1c29ce"


def test_a_certificate() -> None:
    assert SEVEN.certificate.pack().hex() == (
        "0700020000002e28031c2baab17551472db17aa0dbce4593478152d026fe5e5d7b99cf3b2155"
        "c3ea31ebb4032d608075729878a7f0b13bbd23d35e7b79898ed910d7409295fc"
        "42a7c7f88d2277fb81f1aca3dca797da91143e0788ec98613af3397ce7838000"
    )


def test_a_sealed_datum() -> None:
    assert (
        Sealer(SEVEN, 0xCAFEBABE, 0).seal(5, 1, b"42.0 uSv/h").hex()
        == "226deaa0c41d07a9ab9b9fa6e1992b7aa18d7f9d88d45824cf63"
    )


def test_a_sealed_datum_with_terms() -> None:
    terms = bytes.fromhex("04805101")
    sealed = Sealer(SEVEN, 0xCAFEBABE, 0).seal(5, 0x41, b"42.0 uSv/h", terms)
    assert sealed.hex() == "226deaa0c41d07a9ab9b26af3b7396515a404c5c8a9b6f434457"
    assert OPENER.open((7, 0xCAFEBABE, 5), 0x41, sealed, terms) == b"42.0 uSv/h"


def test_a_tag() -> None:
    assert Pair(SEVEN, EIGHT.certificate).tag(7, b"committed").hex() == "fc6e9ec833ed8789"
    assert Pair(EIGHT, SEVEN.certificate).tag(7, b"committed").hex() == "bef6bf43979d0263"


# -- certificates ------------------------------------------------------------------------------------------------------


@given(nodes, numbers, secrets)
def test_a_certificate_is_read_as_it_was_issued(node_id: int, serial: int, secret: Secret) -> None:
    ground = Ground(secret)
    certificate = ground.node(node_id, serial).certificate
    assert (certificate.node_id, certificate.serial) == (node_id, serial)
    packed = certificate.pack()
    assert len(packed) == CERTIFICATE_SIZE == 102 <= MAX_TUNNEL
    assert Certificate.unpack(packed, ground.public) == certificate


@given(st.integers(0, 8 * CERTIFICATE_SIZE - 1))
def test_no_bit_of_a_certificate_can_be_changed(bit: int) -> None:
    with pytest.raises(ForgedError):
        Certificate.unpack(flipped(SEVEN.certificate.pack(), bit), GROUND.public)


@given(st.binary(max_size=2 * CERTIFICATE_SIZE))
def test_any_bytes_as_a_certificate(data: bytes) -> None:
    with pytest.raises((ForgedError, MalformedError)):
        Certificate.unpack(data, GROUND.public)


def test_a_certificate_of_another_mission() -> None:
    with pytest.raises(ForgedError):
        Certificate.unpack(STRANGER.node(7, 2).certificate.pack(), GROUND.public)


def test_a_signature_for_one_purpose_is_none_for_another() -> None:
    signature = GROUND.sign(Purpose.CERTIFICATE, b"words")
    GROUND.public.verify(Purpose.CERTIFICATE, b"words", signature)
    for purpose, data in ((Purpose.MISSION, b"words"), (Purpose.CERTIFICATE, b"word")):
        with pytest.raises(ForgedError):
            GROUND.public.verify(purpose, data, signature)


def test_purposes_fit_and_differ_when_they_are_filled_up() -> None:
    assert all(len(purpose) <= 16 for purpose in Purpose)
    assert len({purpose.ljust(16, b"\0") for purpose in Purpose}) == len(Purpose)


def test_drones_of_one_id_and_missions_have_nothing_in_common() -> None:
    ids = [(7, 0), (7, 1), (7, 2), (8, 1), (263, 1)]
    held = [ground.node(*id).secret.reveal() for ground in (GROUND, STRANGER) for id in ids]
    held += [ground.secret.derive(purpose).reveal() for ground in (GROUND, STRANGER) for purpose in Purpose]
    held += [ground.node(7, 1).link.key.reveal() for ground in (GROUND, STRANGER)]
    assert len(set(held)) == len(held)


def test_a_public_key_on_which_everybody_agrees_is_refused() -> None:
    with pytest.raises(ForgedError):
        agreed(SEVEN.secret, bytes(32))


# -- sealed data -------------------------------------------------------------------------------------------------------


@given(nodes, st.integers(0, LATER_SERIALS), numbers, numbers, kinds, st.binary(max_size=300), secrets)
def test_the_ground_reads_what_a_node_has_sealed(
    origin: int, serial: int, epoch: int, sequence: int, kind: int, payload: bytes, secret: Secret
) -> None:
    ground = Ground(secret, serials={origin: 1})
    sealed = Sealer(ground.node(origin, serial), epoch, 0).seal(sequence, kind, payload)
    assert len(sealed) == len(payload) + SEAL_SIZE == len(payload) + 16
    assert Opener(ground).open((origin, epoch, sequence), kind, sealed) == payload
    if len(payload) >= 8:
        assert payload not in sealed


@given(st.data())
def test_nothing_of_a_sealed_datum_can_be_changed(data: st.DataObject) -> None:
    id, kind = (7, 5, 6), 1
    beside = data.draw(st.binary(max_size=4))
    sealed = Sealer(SEVEN, 5, 6).seal(6, kind, b"payload", beside)
    what = data.draw(st.sampled_from(["origin", "epoch", "sequence", "kind", "bytes", "beside"]))
    if what == "beside":
        beside = data.draw(st.binary(max_size=5).filter(lambda other: other != beside))
    elif what == "bytes":
        sealed = flipped(sealed, data.draw(st.integers(0, 8 * len(sealed) - 1)))
    elif what == "kind":
        kind = data.draw(kinds.filter(lambda other: other != 1))
    else:
        place = ("origin", "epoch", "sequence").index(what)
        other = data.draw((nodes if place == 0 else numbers).filter(lambda number: number != id[place]))
        id = (id[0] if place else other, other if place == 1 else id[1], other if place == 2 else id[2])
    with pytest.raises(ForgedError):
        OPENER.open(id, kind, sealed, beside)


@given(numbers, numbers, numbers, kinds, st.binary(max_size=100))
def test_any_bytes_as_a_sealed_datum(origin: int, epoch: int, sequence: int, kind: int, data: bytes) -> None:
    with pytest.raises((ForgedError, MalformedError)):
        OPENER.open((origin % 65536, epoch, sequence), kind, data)


def test_another_node_cannot_seal_for_an_origin() -> None:
    """A captured drone has its own secret and everything public. It may claim any id."""
    for captured in (EIGHT, STRANGER.node(7, 2), replace(EIGHT, certificate=SEVEN.certificate)):
        claims = replace(captured, certificate=captured.certificate._replace(node_id=7, serial=2))
        with pytest.raises(ForgedError):
            OPENER.open((7, 5, 6), 1, Sealer(claims, 5, 6).seal(6, 1, b"payload"))


def test_another_node_cannot_open() -> None:
    """What a drone could agree on with the origin is not what seals its data."""
    sealed = Sealer(SEVEN, 5, 6).seal(6, 1, b"payload")
    with pytest.raises(ForgedError):
        Opener(Ground(EIGHT.secret)).open((7, 5, 6), 1, sealed)
    with pytest.raises(ForgedError):
        Opener(STRANGER).open((7, 5, 6), 1, sealed)


def test_data_of_a_drone_that_was_replaced_and_of_later_ones_are_read() -> None:
    for serial in range(2 + LATER_SERIALS + 1):
        sealed = Sealer(GROUND.node(7, serial), 5, 0).seal(0, 1, b"payload")
        assert OPENER.open((7, 5, 0), 1, sealed) == b"payload"
    sealed = Sealer(GROUND.node(7, 2 + LATER_SERIALS + 1), 5, 0).seal(0, 1, b"payload")
    with pytest.raises(ForgedError):
        OPENER.open((7, 5, 0), 1, sealed)


@pytest.mark.no_cover
def test_invented_origins_cost_little_and_push_out_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """To agree on a key is the work: whoever may invent origins causes it once for each datum at most."""
    work = 0

    def counted(*given: Any) -> Secret:
        nonlocal work
        work += 1
        return agreed(*given)

    monkeypatch.setattr(sealing, "agreed", counted)
    opener = Opener(GROUND)
    true = Sealer(SEVEN, 5, 6).seal(6, 1, b"payload")
    assert opener.open((7, 5, 6), 1, true) == b"payload"
    before = work
    for origin in range(100, 100 + KEPT_KEYS + 10):
        with pytest.raises(ForgedError):
            opener.open((origin, 5, 6), 1, bytes(40))
    assert work <= before + KEPT_KEYS + 10
    before = work
    assert opener.open((7, 5, 6), 1, true) == b"payload"
    assert work == before
    # The data of any base are read, those of a drone only if the file names it.
    assert opener.open((1, 5, 6), 1, Sealer(BASE, 5, 6).seal(6, 1, b"payload")) == b"payload"
    with pytest.raises(ForgedError):
        opener.open((8, 5, 6), 1, Sealer(EIGHT, 5, 6).seal(6, 1, b"payload"))


@given(st.lists(st.integers(0, 20), max_size=20), st.integers(0, 10))
def test_nothing_is_sealed_twice_under_one_id(sequences: list[int], first: int) -> None:
    sealer = Sealer(SEVEN, 5, first)
    sealed: set[int] = set()
    for sequence in sequences:
        if sequence < first or any(sequence <= other for other in sealed):
            with pytest.raises(ValueError, match=f"^7-00000005-{sequence} would be sealed a second time$"):
                sealer.seal(sequence, 1, b"payload")
        else:
            sealer.seal(sequence, 1, b"payload")
            sealed.add(sequence)


# -- words between two nodes -------------------------------------------------------------------------------------------


@given(nodes, numbers, nodes, numbers, kinds, st.binary(max_size=100), secrets)
def test_two_nodes_hear_each_other(
    a: int, serial_a: int, b: int, serial_b: int, kind: int, data: bytes, secret: Secret
) -> None:
    ground = Ground(secret)
    one, other = ground.node(a, serial_a), ground.node(b, serial_b)
    if a == b:
        with pytest.raises(ForgedError):
            Pair(one, other.certificate)
        return
    here, there = Pair(one, other.certificate), Pair(other, one.certificate)
    tag = here.tag(kind, data)
    assert len(tag) == TAG_SIZE == 8
    assert there.made(kind, data, tag)
    assert here.made(kind, data, there.tag(kind, data))
    assert not here.made(kind, data, tag), "its own words"


@given(st.data(), kinds, st.binary(min_size=1, max_size=100))
def test_a_tag_fits_nothing_else(data: st.DataObject, kind: int, said: bytes) -> None:
    here, there = Pair(SEVEN, EIGHT.certificate), Pair(EIGHT, SEVEN.certificate)
    tag = here.tag(kind, said)
    bits = data.draw(st.integers(0, 8 * len(said) - 1)), data.draw(st.integers(0, 8 * TAG_SIZE - 1))
    others = [
        ((kind + 1) % 256, said, tag), (kind, flipped(said, bits[0]), tag), (kind, said, flipped(tag, bits[1])),
        (kind, said, tag[:-1]), (kind, said, b""),
    ]  # fmt: skip
    for other in others:
        assert not there.made(*other)


def test_a_third_node_of_the_mission_cannot_speak_for_another() -> None:
    """Nine is captured. It has the certificates of all."""
    nine = GROUND.node(9, 1)
    claims = replace(nine, certificate=SEVEN.certificate)
    hears = Pair(EIGHT, SEVEN.certificate)
    for pair in (Pair(nine, EIGHT.certificate), Pair(claims, EIGHT.certificate)):
        assert not hears.made(7, b"committed", pair.tag(7, b"committed"))


def test_a_base_is_a_node_like_the_others() -> None:
    assert Pair(SEVEN, BASE.certificate).made(7, b"arrived", Pair(BASE, SEVEN.certificate).tag(7, b"arrived"))
    assert BASE.certificate.serial == 0
