"""Key updates: who can open one, who has written it, and what of them is kept on disk."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import ForgedError, MalformedError
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.key_updates import (
    KEY_UPDATE_SIZE,
    KeyUpdate,
    KeyUpdateOpener,
    key_updates_in,
    key_updates_text,
    write_key_update,
)
from rass_mav.trust.keys.secret import Purpose, Secret

GROUND = Ground(Secret(bytes(range(32))), number=2, serials={7: 2, 8: 1}, revoked=frozenset({8}))
STRANGER = Ground(Secret(bytes(32)), number=2, serials={7: 2, 8: 1}, revoked=frozenset({8}))
SEVEN, EIGHT = write_key_update(GROUND, 7), write_key_update(GROUND, 8)

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
