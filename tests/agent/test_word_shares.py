"""What a captured drone brings of the ground's word, true or false, displaces only what it has brought itself."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.mavlink.frames import Stream
from rass_mav.trust.route_proofs import MAX_BASES, UNNAMED_AT_ONCE, UNNAMED_TURNS
from rass_mav.trust.sessions import UNPROVEN
from rass_mav.trust.statement_signatures import MAX_HELD, in_turn
from rass_mav.wire.attestation import Anchor, Ask, Signed, StatementSignature, body_of, decode_attestation, encode_ask

from .ground_net import BASE_ATTESTATION
from .test_route_proofs import Base, Drone
from .test_statement_signatures import LIFE, drone, heard, receipt, statements, vouched

#: The captured drone's own stream. Those that it has invented count as one.
OWN: Stream = (66, 191, 0)
THIEVES = (OWN, UNPROVEN)
HONEST: tuple[Stream, ...] = tuple((number, 191, 0) for number in range(1, 5))


def old_anchor(life: int) -> Signed:
    """A true one, of a base that had another store then."""
    anchor = Anchor(1, life, 0, 0, bytes(8))
    body = body_of(anchor)
    return Signed(body[1], anchor, body, BASE_ATTESTATION.anchor(body))


# -- anchors -----------------------------------------------------------------------------------------------------------


def flying() -> tuple[Base, Drone]:
    base, drone = Base(), Drone()
    for now in range(1, 4):
        beacon = base.beacon()
        drone.learns(base)
        drone.node.routing.hear(drone.hears(beacon), float(now))
    return base, drone


def test_old_anchors_do_not_push_out_the_base_that_is_announced() -> None:
    base, drone = flying()
    for life in range(1, 5 * MAX_BASES):
        drone.announced.learn(old_anchor(life), OWN, drone.node)
        assert len(drone.announced.bases) <= MAX_BASES
        beacon = base.beacon()
        drone.learns(base)
        assert drone.takes(beacon), life


def test_old_anchors_are_not_relayed_without_end() -> None:
    _, drone = flying()
    for _ in range(10):
        drone.announced.turn()
    sent = 0
    for turn in range(60):
        for life in range(3):
            drone.announced.learn(old_anchor(3 * turn + life + 1), OWN, drone.node)
        sent += len(drone.announced.turn()[0])
    assert sent <= UNNAMED_AT_ONCE + 60 / UNNAMED_TURNS + 1


def test_a_new_base_is_asked_for_whoever_invents_others() -> None:
    base, drone = Base(), Drone()
    true, source = base.beacon(), (1, base.store.life)
    for turn in range(5):
        for life in range(200):
            for thief in THIEVES:
                drone.takes(true._replace(base=9, base_life=1000 * turn + life, hops=3), thief)
        drone.takes(true, HONEST[0])
        if source in drone.announced.turn()[1]:
            return
    pytest.fail("it was not asked for")


@pytest.mark.no_cover
def test_false_claims_do_not_use_up_what_true_ones_need() -> None:
    """A hundred in each turn, as dear as they may be, for as long as it takes to use up all that was saved."""
    base, drone = Base(), Drone()
    for turn in range(400):
        for ahead in (60, 20, 4, 4, 4, 4):
            for thief in THIEVES:
                number = base.number + ahead & 0xFFFF
                assert not drone.takes(base.beacon(base.number)._replace(route_number=number, proof=bytes(8)), thief)
        true = base.beacon()
        drone.learns(base)
        assert drone.takes(true, HONEST[turn % 4]), turn
        drone.announced.turn()


# -- statements and statement signatures -------------------------------------------------------------------------------


@pytest.mark.no_cover
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32))
def test_junk_displaces_no_statement_of_others(seed: int) -> None:
    word, rng = drone(), random.Random(seed)
    true = {}
    for number in range(3 * MAX_HELD):
        if not number % 37:
            message = receipt(number)
            true[message] = rng.choice(HONEST)
            heard(word, message, true[message])
        heard(word, receipt(5000 + rng.randrange(2000), rng.randrange(100)), rng.choice(THIEVES))
    assert word.statement_signatures.disagreement() == ""
    assert true.keys() <= {held.message for wait in word.statement_signatures.waiting.values() for held in wait.held}


def test_forgeries_of_a_statement_do_not_keep_out_the_true_one() -> None:
    word = drone()
    for number in range(50):
        for thief in THIEVES:
            assert not heard(word, receipt(5, number + 1), thief)
    assert not heard(word, receipt(5), HONEST[0])
    word.hear(vouched(receipt(5)).payload, HONEST[1])
    assert statements(word) == [receipt(5)]


def test_the_statement_signature_of_a_true_statement_is_asked_for_beside_junk() -> None:
    word = drone()
    for number in range(MAX_HELD):
        heard(word, receipt(5000 + number), THIEVES[number % 2])
    heard(word, receipt(5), HONEST[0])
    asked = [p for _ in range(10) for p in word.turn(())[0]]
    assert any((1, LIFE, 5) in ask.statements for p in asked if isinstance(ask := decode_attestation(p), Ask))


def test_statement_signatures_of_others_are_verified_beside_junk() -> None:
    word, rng = drone(), random.Random(1)
    for serial in range(40):
        for _ in range(50):
            for thief in THIEVES:
                junk = body_of(StatementSignature(1, LIFE, rng.randrange(9000, 9999), 0, (bytes(8),))) + rng.randbytes(
                    64
                )
                word.hear(junk, thief)
        for number, stream in enumerate(HONEST[:2]):
            word.hear(vouched(receipt(2 * serial + number)).payload, stream)
        word.released()
        assert heard(word, receipt(2 * serial))
        assert heard(word, receipt(2 * serial + 1))


def test_who_asks_for_much_keeps_nobody_from_being_answered() -> None:
    word = drone()
    for serial in range(100):
        word.statement_signatures.learn(vouched(receipt(serial)), OWN, set)
    gossip = word.statement_signatures.gossip
    while gossip.news:
        word.turn(())
    sent = []
    for turn in range(60):
        for serial in range(0, 99, 9):
            word.hear(encode_ask(Ask((), tuple((1, LIFE, serial + i) for i in range(9)))), OWN)
        if turn == 30:
            # What others ask for too counts for them.
            word.hear(encode_ask(Ask((), ((1, LIFE, 50), (1, LIFE, 99)))), HONEST[0])
        new = word.turn(())[0]
        sent += new if turn >= 30 else []
    assert {vouched(receipt(serial)).payload for serial in (50, 99)} <= {*sent[:20]}


def test_nobody_silences_the_relay_of_a_statement_signature_alone() -> None:
    """A captured drone is two quota holders."""
    for streams, relayed in ((THIEVES, True), (HONEST[2:], False)):
        word = drone()
        word.statement_signatures.gossip.period = 6
        word.hear(vouched(receipt(1)).payload, HONEST[0])
        word.released()
        for _ in range(5):
            for stream in (*streams, HONEST[0]):
                word.hear(vouched(receipt(1)).payload, stream)
        sent = [p for _ in range(6) for p in word.turn(())[0]]
        assert (vouched(receipt(1)).payload in sent) == relayed


@given(st.dictionaries(st.integers(0, 5), st.lists(st.integers(), min_size=1, max_size=20)), st.integers(1, 12))
def test_turns_are_shared(waiting: dict[int, list[int]], most: int) -> None:
    brought = {(number, 191, 0): [(number, i) for i in range(len(some))] for number, some in waiting.items()}
    chosen = in_turn(brought, most, random.Random(1))
    assert len(chosen) == len(set(chosen)) == min(most, sum(map(len, brought.values())))
    counts = {number: sum(owner == number for owner, _ in chosen) for number in waiting}
    for number, some in waiting.items():
        # Who has got less than another one has no more to get.
        assert counts[number] == len(some) or counts[number] >= max(counts.values()) - 1
