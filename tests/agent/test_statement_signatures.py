"""Statements for which the ground has vouched: core hears these and no others, and they reach everybody."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.core.messages import Message, Receipt, ReceiptEntry, SequenceMark
from rass_mav.core.news.statements import make_receipt, make_sequence_mark
from rass_mav.lab.medium.air import open_datagram
from rass_mav.mavlink.frames import Stream
from rass_mav.store.memory import MemoryStore
from rass_mav.trust.attestations import MAX_OF_STREAM, MAX_STREAMS, MAX_VERIFIED, Attestations
from rass_mav.trust.statement_signatures import LATEST, MAX_HELD, MAX_KNOWN, StatementSignatures, hash_of
from rass_mav.wire import decode, encode
from rass_mav.wire.attestation import (
    STATEMENT_SIGNATURE,
    Ask,
    Signed,
    StatementSignature,
    body_of,
    decode_attestation,
    encode_ask,
    is_attestation,
)
from tests.keyed import keyed
from tests.some import some

from .ground_net import BASE_ATTESTATION, DRONE_ATTESTATION, GroundNet, attestations_of, member
from .picture import picture

LIFE = 1001
STREAM, OTHER = (9, 191, 0), (2, 191, 0)


def receipt(serial: int, *numbers: int, base: int = 1, life: int = LIFE) -> Receipt:
    entries = [ReceiptEntry(2, 1002, number, 1, 0, False) for number in numbers or (0,)]
    return make_receipt(base, life, serial, entries)


def payload(message: Message) -> bytes:
    return encode(message, 0.0)[0]


def vouched(*messages: Receipt, salt: int = 7) -> Signed:
    """With the signature of the ground."""
    base, life, first = messages[0][:3]
    body = body_of(StatementSignature(base, life, first, salt, tuple(hash_of(payload(m), salt) for m in messages)))
    signed = decode_attestation(body + BASE_ATTESTATION.vouch(body))
    assert isinstance(signed, Signed)
    return signed


def drone() -> Attestations:
    return Attestations(7, DRONE_ATTESTATION, MemoryStore(7), random.Random(7))


def heard(attestations: Attestations, message: Message, stream: Stream = STREAM) -> bool:
    return attestations.admit(message, payload(message), stream, None) is not None


def statements(attestations: Attestations) -> list[Message]:
    """Those that core may hear now, as their base sent them."""
    return [decode(encode(message, 0.0)[0], 0.0) for message, _ in attestations.released()]


# -- one node ----------------------------------------------------------------------------------------------------------


def test_a_statement_waits_for_its_statement_signature() -> None:
    word, message = drone(), receipt(5)
    for stream in (STREAM, STREAM, OTHER):
        assert not heard(word, message, stream)
    word.hear(vouched(message).payload, STREAM)
    assert word.released() == [(message._replace(senders=(STREAM, OTHER)), None)], "each sender counts once"
    assert heard(word, message)
    assert (word.verified, word.statement_signatures.held) == (1, 0)
    # It is known by its hashes from now on.
    word.hear(vouched(message).payload, STREAM)
    assert word.released() == []
    assert word.verified == 1


def test_a_statement_signature_may_come_first_and_is_for_its_statements_only() -> None:
    word = drone()
    first, second = receipt(5, 1), receipt(6, 2)
    word.hear(vouched(first, second).payload, STREAM)
    assert word.released() == []
    assert heard(word, second)
    assert heard(word, first)
    for other in (receipt(5, 2), receipt(6, 1)):
        assert not heard(word, other)
    assert word.statement_signatures.forged == 2
    for other in (receipt(4, 1), receipt(7, 2), receipt(5, 1, base=2), receipt(5, 1, life=2)):
        assert not heard(word, other)
    assert word.statement_signatures.held == 4


def test_the_true_one_of_two_is_heard() -> None:
    word = drone()
    forged, true = receipt(5, 0, 1, 2), receipt(5, 0)
    assert not heard(word, forged)
    assert word.admit(true, payload(true), OTHER, None) is None
    word.hear(vouched(true).payload, STREAM)
    assert statements(word) == [true]
    assert word.statement_signatures.forged == 1


def test_what_waits_and_what_is_verified_is_bounded() -> None:
    word = drone()
    true = [receipt(serial) for serial in range(20)]
    for message in true:
        assert not heard(word, message, (1, 1, 1))
    for serial in range(3000):
        heard(word, receipt(1000 + serial % 700, serial))
        junk = body_of(StatementSignature(1, LIFE, serial, 0, (bytes(8),)))
        word.hear(junk + bytes(64), (serial % 90, 191, serial % 7))
    assert word.statement_signatures.held == MAX_HELD
    assert sum(map(len, word.queue.values())) <= MAX_STREAMS * MAX_OF_STREAM
    assert all(not heard(word, message) for message in true)
    assert {wait.held[0].message for wait in word.statement_signatures.waiting.values()} >= set(true), (
        "of another stream"
    )
    word.released()
    assert word.verified == MAX_VERIFIED


def test_junk_of_one_drone_does_not_keep_out_what_others_send() -> None:
    word, waits = drone(), []
    for serial in range(40):
        for _ in range(100):
            word.hear(body_of(StatementSignature(1, LIFE, 1000, 0, (bytes(8),))) + random.randbytes(64), STREAM)
        message = receipt(serial)
        heard(word, message, (1, 1, 1))
        word.hear(vouched(message).payload, (1, 1, 1))
        waits.append(statements(word) == [message])
    assert all(waits)


def test_nobody_is_answered_who_asks_too_often() -> None:
    word = drone()
    for serial in range(0, 200):
        word.statement_signatures.learn(vouched(receipt(serial)), STREAM, set)
    for _ in range(10):
        word.turn(())
    sent = 0
    for _ in range(30):
        for serial in range(0, 190, 9):
            word.hear(encode_ask(Ask((), tuple((1, LIFE, serial + i) for i in range(9)))), STREAM)
        assert word.statement_signatures.disagreement() == ""
        sent += len(word.turn(())[0])
    assert 20 < sent <= 30 + 1


def test_a_statement_signature_is_asked_for_a_few_times() -> None:
    word = drone()
    assert not heard(word, receipt(5))
    asked = [turn for turn in range(300) for p in word.turn(())[0] if p == encode_ask(Ask((), ((1, LIFE, 5),)))]
    assert len(asked) == 4
    assert word.statement_signatures.held == 0


def test_what_is_known_is_bounded_and_what_lives_stays() -> None:
    statement_signatures = StatementSignatures((7, 7), DRONE_ATTESTATION, random.Random(1))
    lives = {(1, LIFE, serial) for serial in range(0, MAX_KNOWN + 500, 10)}
    for serial in range(MAX_KNOWN + 500):
        body = body_of(StatementSignature(1, LIFE, serial, 0, (bytes(8),)))
        signed = decode_attestation(body + bytes(64))
        assert isinstance(signed, Signed)
        statement_signatures.learn(signed, STREAM, lambda: lives)
    assert len(statement_signatures.signatures) <= MAX_KNOWN
    assert lives <= statement_signatures.signatures.keys()
    assert sum(statement not in lives for statement in statement_signatures.signatures) >= LATEST // 2


# -- between nodes -----------------------------------------------------------------------------------------------------


def flying(drones: int = 2, **sections: object) -> GroundNet:
    net = GroundNet(drones, **sections)
    net.steps(10)
    return net


def measures(net: GroundNet, count: int = 3) -> None:
    for agent in net.agents[1:]:
        for _ in range(count):
            agent.measure(net.now)


def test_receipts_arrive_and_end_replicas() -> None:
    net = flying()
    measures(net)
    net.steps(40)
    assert net.known(0) == net.known(1) == net.known(2) != set()
    for agent in net.agents[1:]:
        assert len(list(agent.store.ids())) <= 1


@pytest.mark.no_cover
def test_a_drone_that_starts_again_learns_all_statements_with_their_statement_signatures() -> None:
    net = flying()
    for _ in range(6):
        measures(net)
        net.steps(12)
    net.steps(30)
    net.restart(1)
    net.steps(150)
    assert net.known(1) == net.known(2) == net.known(0) != set()


@pytest.mark.no_cover
def test_a_base_that_starts_again_is_believed() -> None:
    net = flying(data={"interval_steps": 1000})
    for _ in range(3):
        measures(net)
        net.steps(20)
        net.restart(0)
        net.steps(15)
        route = some(net.agents[1].node.routing.route)
        assert (route.base, route.hops) == (1, 1)
    measures(net)
    net.steps(100)
    assert net.known(0) == net.known(1) == net.known(2) != set()
    assert len(list(net.agents[1].store.ids())) <= 1


@pytest.mark.no_cover
def test_an_open_base_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    net = flying()
    known = net.known(1) | net.known(2)
    base, turn = keyed(net.agents[0]), Attestations.turn

    def says_nothing(some: Attestations, messages: Sequence[Message]) -> tuple[list[bytes], list[Message]]:
        return ([], list(messages)) if some is base.attestations else turn(some, messages)

    monkeypatch.setattr(Attestations, "turn", says_nothing)
    net.steps(40)
    for agent in net.agents[1:]:
        assert agent.node.routing.route is None
    measures(net)
    net.steps(40)
    assert net.known(1) | net.known(2) <= known
    assert len(list(net.agents[1].store.ids())) >= 3


def state(agent: Agent) -> object:
    """What a false word may not change."""
    return picture([agent.node.routing.route, agent.node.receipts, agent.node.holdings, agent.store, agent.node.alarms])


def forgeries(net: GroundNet) -> dict[str, Callable[[random.Random], bytes]]:
    """What the last agent sends, which is in wrong hands; each with its own chance."""
    base, life = 1, net.agents[0].store.life
    ids = [id for agent in net.agents for id in agent.store.ids()]
    entries = [ReceiptEntry(*id, 1, 0, False) for id in ids[:5]]

    def false_receipt(rng: random.Random) -> Receipt:
        return make_receipt(base, life, rng.randrange(64), entries)

    def signed(body: bytes, rng: random.Random) -> bytes:
        return body + rng.randbytes(64)

    return {
        "receipt": lambda rng: payload(false_receipt(rng)),
        "lost": lambda rng: payload(make_receipt(base, life, rng.randrange(64), [entries[0]._replace(lost=True)])),
        "given": lambda rng: payload(make_sequence_mark(2, net.agents[1].store.epoch, 0)),
        "voucher": lambda rng: signed(
            body_of(StatementSignature(base, life, rng.randrange(64), 1, (hash_of(payload(false_receipt(rng)), 1),))),
            rng,
        ),
    }


@pytest.mark.no_cover
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), kinds=st.lists(st.integers(0, 3), min_size=1, max_size=12))
def test_no_forged_word_changes_a_node(seed: int, kinds: list[int]) -> None:
    rng = random.Random(seed)
    net = flying(3)
    measures(net)
    net.steps(2)
    makers = list(forgeries(net).values())
    assert any(agent.node.receipts.identities() or list(agent.store.ids()) for agent in net.agents)
    before = [state(agent) for agent in net.agents[:-1]]
    for kind in kinds:
        net.send(3, makers[kind](rng))
    for agent in net.agents[:-1]:
        assert attestations_of(agent).released() == []
    assert [state(agent) for agent in net.agents[:-1]] == before


@pytest.mark.no_cover
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_no_true_word_that_is_changed_or_cut_off_changes_a_node(data: st.DataObject) -> None:
    net = flying(3)
    measures(net)
    # The drones miss what the base says of it, and the thief does not.
    true: list[bytes] = []
    for _ in range(12):
        net.now += 1.0
        true += [net.agents[0].peers.leaving(outgoing).frame for outgoing in net.agents[0].step(net.now)]
    words = [o[3] for frame in true if (o := open_datagram(frame, 0.0)) is not None and is_attestation(o[3])]
    words += [vouched(receipt(90, 0)).payload]
    chosen = bytearray(data.draw(st.sampled_from(words)))
    if data.draw(st.booleans()):
        bit = data.draw(st.integers(16, 8 * len(chosen) - 1))
        chosen[bit >> 3] ^= 1 << (bit & 7)
    else:
        del chosen[data.draw(st.integers(2, len(chosen) - 1)) :]
    agent = net.agents[1]
    before, word = state(agent), attestations_of(agent)
    known = (
        len(word.statement_signatures.signatures),
        {source: list(base.chains) for source, base in word.routes.bases.items()},
    )
    net.send(3, bytes(chosen))
    if chosen[1] == STATEMENT_SIGNATURE:
        net.send(3, payload(receipt(90, 0)))
    assert word.released() == []
    assert state(agent) == before
    assert known == (
        len(word.statement_signatures.signatures),
        {source: list(base.chains) for source, base in word.routes.bases.items()},
    )


def test_a_vouched_statement_that_hits_a_fault_ends_no_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame waits with it, so that the guard drops it like any other."""
    agent = member(3, forgiving=True)
    net = GroundNet(1, agent)
    net.steps(12)
    net.send(1, payload(receipt(90)))
    net.send(1, vouched(receipt(90)).payload)

    def fault(message: Message, now: float) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(type(agent.node), "receive", fault)
    agent.step(net.now + 1.0)
    assert agent.guard.faults == 1


@pytest.mark.no_cover
def test_nothing_of_given_is_left() -> None:
    net = flying()
    measures(net)
    net.steps(40)
    base = net.agents[0]
    message = make_receipt(1, base.store.life, 77, [ReceiptEntry(2, net.agents[1].store.epoch, 0, 900, 0, False)])
    # The ground says so, although the drone has not made as many: it believes it, and denies nothing.
    net.agents[1].node.receive(message, net.now)
    assert all(not isinstance(m, SequenceMark) for _ in range(30) for m in net.agents[1].node.step(net.now))
