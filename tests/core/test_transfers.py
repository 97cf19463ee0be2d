from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.flow import SACK_EVERY
from rass_mav.core.custody.percolation import MAX_HEAPED
from rass_mav.core.custody.transfers import MAX_OF_ONE, MAX_TRANSFERS, SILENT_ROUNDS
from rass_mav.core.datum import MAX_PAYLOAD
from rass_mav.core.messages import Accept, Chunk, Committed, Message, Offer, Report, Sack
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_ONE
from tests.extent import examples
from tests.some import some

from .build import beacon, datum, make_node, of, passed_on, talk, tries


def custodian_of(payload: bytes, node_id: int = 1, **more: Any) -> Node:
    node = make_node(node_id, **more)
    node.put(payload, 0.0)
    return node


def fit(node: Node, receiver: Node, now: float, risk: float = 0.0) -> None:
    """The sender hears that the receiver is fitter, and its risk."""
    number, told = int(now * 8) & 0xFFFF, round(65535 * risk)
    free = receiver.holdings.free()
    node.receive(
        beacon(receiver.id, number, policy=node.policy.tag, potential=POTENTIAL_ONE, free=free, risk=told), now
    )
    # And the other way round: offers of strangers are refused.
    receiver.receive(beacon(node.id, number), now)


def noise(size: int) -> bytes:
    return random.Random(size).randbytes(size)


@pytest.mark.no_cover
@pytest.mark.parametrize("size", [98, 123, 124, 246, 5000, MAX_PAYLOAD])
def test_a_large_datum_goes_over_whole(size: int) -> None:
    custodian, receiver = custodian_of(noise(size)), make_node(2)
    [id] = custodian.holdings.custody
    fit(custodian, receiver, 0.0)
    said = talk({1: custodian, 2: receiver}, custodian.step(0.0), 0.0)
    chunks = of(Chunk, said)
    assert len(chunks) == -(-size // 123)
    assert id not in custodian.holdings.custody
    taken = some(receiver.store.get(id))
    assert taken.payload == noise(size)
    assert taken.hops == 1


def bad_network(custodian: Node, receiver: Node, rng: random.Random, loss: float, steps: int, *, dead: range) -> None:
    """Steps of both nodes; what they say is lost, doubled and reordered. In `dead` steps nothing arrives at all."""
    for turn in range(steps):
        now = float(turn)
        fit(custodian, receiver, now)
        queue: list[Message] = custodian.step(now) + receiver.step(now)
        for _ in range(4000):
            if not queue:
                break
            m = queue.pop(rng.randrange(min(len(queue), 8)))
            if turn in dead or rng.random() < loss:
                continue
            for _ in range(2 if rng.random() < loss else 1):
                if isinstance(m, (Offer, Chunk)):
                    queue += receiver.receive(m, now)
                elif isinstance(m, (Accept, Sack, Committed)):
                    queue += custodian.receive(m, now)
        if not custodian.holdings.custody:
            return


@settings(max_examples=examples(30), deadline=None)
@given(st.integers(98, 6000), st.integers(0, 1 << 32))
@example(739, 795)
@example(247, 20)
def test_it_arrives_over_a_network_that_loses_doubles_and_reorders(size: int, seed: int) -> None:
    custodian, receiver = custodian_of(noise(size)), make_node(2)
    [id] = custodian.holdings.custody
    with tries(50):
        bad_network(custodian, receiver, random.Random(seed), 0.3, 80, dead=range(0))
    taken = some(receiver.store.get(id))
    assert taken.payload == noise(size)
    assert id not in custodian.holdings.custody


@pytest.mark.parametrize("silence", [2, 3, 8])
def test_it_is_taken_up_again_after_an_interruption(silence: int) -> None:
    custodian, receiver = custodian_of(noise(60000)), make_node(2)
    [id] = custodian.holdings.custody
    rng = random.Random(3)
    with tries(50):
        bad_network(custodian, receiver, rng, 0.4, 90, dead=range(1, 1 + silence))
    taken = some(receiver.store.get(id))
    assert taken.intact


def test_two_custodians_of_the_same_datum_to_one_receiver() -> None:
    d = datum(payload=noise(3000))
    nodes = {1: make_node(1), 2: make_node(2), 3: make_node(3)}
    messages: list[Message] = []
    for custodian in (nodes[1], nodes[2]):
        custodian.custody_store.keep(d)
        fit(custodian, nodes[3], 0.0)
        messages += custodian.step(0.0)
    talk(nodes, messages, 0.0)
    assert list(nodes[3].holdings.custody) == [d.id]
    assert len(nodes[1].holdings.custody) == len(nodes[2].holdings.custody) == 0


def test_a_silent_neighbour_blocks_no_other() -> None:
    custodian, deaf, receiver = custodian_of(noise(300)), make_node(2), make_node(3)
    for size in range(301, 321):
        custodian.put(noise(size), 0.0)
    for turn in range(4):
        now = float(turn)
        for other in (deaf, receiver):
            fit(custodian, other, now)
        talk({1: custodian, 3: receiver}, custodian.step(now), now)
    assert len(custodian.holdings.large[2]) <= MAX_OF_ONE
    assert len(receiver.holdings.custody) >= 2


def offered(sender: int, size: int = 5000) -> Offer:
    return Offer(sender, 2, 1, datum(sender).id, 0, 0.0, 0, 5, size, 100)


def test_data_of_one_origin_leave_places_for_others() -> None:
    receiver = make_node(2)
    for sender in range(10, 20):
        receiver.receive(beacon(sender), 0.0)
    of_one = [offered(sender)._replace(id=datum(9, sender).id) for sender in range(10, 19)]
    answers = [receiver.receive(offer, 0.0)[0] for offer in of_one]
    assert len(of(Accept, answers)) == MAX_OF_ONE
    assert of(Accept, receiver.receive(offered(19), 0.0))


@pytest.mark.parametrize("bound", [{}, {"capacity_bytes": 10000}])
def test_a_transfer_that_stands_still_gives_way_to_another(bound: dict[str, Any]) -> None:
    """Also one whose sender repeats its offer, or a chunk, again and again: who makes no headway is silent."""
    receiver, liars, honest = make_node(2, **bound), range(10, 10 + MAX_TRANSFERS), 5
    for s in (*liars, honest):
        receiver.receive(beacon(s), 0.0)
    handles = {s: a.handle for s in liars for a in of(Accept, receiver.receive(offered(s), 0.0))}
    alive = min(handles)
    for s, handle in handles.items():
        receiver.receive(Chunk(2, handle, 3, False, bytes(100)), 0.1)
        receiver.receive(Chunk(2, handle, 4 if s == alive else 3, False, bytes(100)), 1.3)
        receiver.receive(offered(s), 1.3)
    assert of(Accept, receiver.receive(offered(honest, 4000), 1.4))
    # One of them had to go, and not the one that had come on.
    still = [s for s in handles if of(Sack, receiver.receive(Chunk(2, handles[s], 9, True, b""), 1.4))]
    assert len(still) == len(handles) - 1
    assert alive in still


def sending(size: int, **more: Any) -> tuple[Node, Offer]:
    """A node that has offered a datum to node 1."""
    custodian = custodian_of(noise(size), 2, **more)
    fit(custodian, make_node(1), 0.0)
    [offer] = of(Offer, custodian.step(0.0))
    return custodian, offer


def test_what_was_said_falsely_of_chunks_that_are_missing_is_made_good_by_the_next_answer_to_a_probe() -> None:
    custodian, offer = sending(20 * 123)
    custodian.receive(Accept(1, 2, offer.number, 7, 0), 0.0)
    # Only the last chunk has arrived.
    for lie in (Sack(1, 2, 7, 19, 0), Sack(1, 2, 7, 19, 1)):
        assert custodian.receive(lie, 0.0) == []
    custodian.receive(Sack(1, 2, 7, 0, 1 << 18), 0.1)
    assert of(Offer, custodian.tend(2.0)) == [offer]
    again = custodian.receive(Accept(1, 2, offer.number, 7, 0, 1 << 18), 2.1)
    assert [c.position for c in of(Chunk, again)] == list(range(2 * SACK_EVERY))


@pytest.mark.parametrize("answers", ["accept", "sack", "all but the last", "nothing"])
@tries(4)
def test_a_transfer_that_makes_no_headway_is_cancelled(answers: str) -> None:
    custodian, offer = sending(20 * 123)
    tried = set()
    for turn in range(1, 30):
        now = float(turn)
        fit(custodian, make_node(1), now)
        for said in of(Offer, custodian.step(now)):
            tried.add(said.number)
            if answers == "accept":
                custodian.receive(Accept(1, 2, said.number, 7, 0), now)
            elif answers != "nothing":
                custodian.receive(Accept(1, 2, said.number, 7, 0), now)
                custodian.receive(Sack(1, 2, 7, 1 if answers == "sack" else 19, 0), now)
    # It was offered anew, and could have been to another.
    assert len(tried) >= 3
    assert offer.id in custodian.holdings.custody


def test_transfers_under_way_are_bounded() -> None:
    receiver = make_node(2)
    for s in range(30, 50):
        receiver.receive(beacon(s), 0.0)
    answers = [receiver.receive(offered(s), 0.0)[0] for s in range(30, 49)]
    assert len(of(Accept, answers)) == MAX_TRANSFERS
    assert of(Committed, receiver.receive(offered(49), 1.0))[0].refused == (1,)
    # Silent ones make room.
    receiver.step(4.0)
    receiver.receive(beacon(49, 1), 4.0)
    assert of(Accept, receiver.receive(offered(49), 4.0))


small = st.integers(0, 3)
u16 = st.integers(0, 0xFFFF)
size = st.integers(1, 0xFFFFFFFF)
lies = st.one_of(
    st.builds(
        lambda s, n, q, c, z, k: Offer(s, 2, n, datum(9, q).id, 0, 0.0, 255, c, z, k),
        small, small, small, size, size, st.integers(1, 123),
    ),
    st.builds(Accept, small, st.just(2), st.integers(0, 0xFFFFFFFF), small, u16),
    st.builds(Chunk, st.just(2), u16, u16, st.booleans(), st.binary(max_size=123)),
    st.builds(
        Sack, small, st.just(2), small, u16, st.integers(0, (1 << 256) - 1), st.integers(0, 3),
        st.lists(st.builds(Report, small, u16, st.integers(0, (1 << 64) - 1)), max_size=3).map(tuple),
    ),
)  # fmt: skip


@pytest.mark.no_cover
@settings(max_examples=examples(150), deadline=None)
@given(st.lists(lies, max_size=30))
def test_lies_never_crash_and_never_cost_the_datum(messages: list[Message]) -> None:
    node = custodian_of(noise(1000), 2)
    fit(node, make_node(1), 0.0)
    [offer] = of(Offer, node.step(0.0))
    node.receive(Accept(1, 2, offer.number, 1, 0), 0.0)
    for message in messages:
        for answer in node.receive(message, 0.0):
            # Aim chunks at transfers that were opened.
            if isinstance(answer, Accept):
                node.receive(Chunk(2, answer.handle, 0, True, b"x"), 0.0)
    assert len(node.holdings.custody) >= 1
    assert offer.id in node.holdings.custody


@pytest.mark.parametrize(
    ("risk", "there", "most"),
    [(0.0, 0.0, MAX_HEAPED), (0.3, 0.0, 5), (0.3, 0.2, 5), (0.3, 0.3, MAX_HEAPED), (0.3, 0.5, MAX_HEAPED)],
)
def test_a_relay_that_has_not_passed_on_what_it_took_is_given_no_more_large_data_except_to_save_them(
    risk: float, there: float, most: int
) -> None:
    """Where the relay is no safer, more data there save nothing, and keep the air from those that move on."""
    custodian, relay = make_node(1, mirror=True, risk=risk, immediate=True), make_node(2, mirror=True)
    ids = [custodian.put(noise(300 + n), 0.0) for n in range(5)]
    for step in range(4):
        fit(custodian, relay, float(step), there)
        talk({1: custodian, 2: relay}, custodian.step(float(step)), float(step))
    given = [id for id in ids if id in relay.holdings.custody]
    assert len(given) == most
    if most > MAX_HEAPED:
        return
    # A base took one of them.
    moved = passed_on(2, 1, given[0])
    talk({1: custodian, 2: relay}, custodian.receive(moved, 4.0) + custodian.forward(4.0), 4.0)
    assert sum(id in relay.holdings.custody for id in ids) > MAX_HEAPED


def test_no_other_transfer_begins_while_one_that_goes_on_takes_the_link_for_turns() -> None:
    """On a slow radio all would wait for each other, and be given up for lack of progress."""
    custodian, first, second = custodian_of(noise(20_000)), make_node(2), make_node(3)
    fit(custodian, first, 0.0)
    [offer] = of(Offer, custodian.step(0.0))
    [accept] = of(Accept, first.receive(offer, 0.0))
    chunks = of(Chunk, custodian.receive(accept, 0.9))
    custodian.put(noise(300), 0.9)
    begun = []
    for turn in range(1, 12):
        now = float(turn)
        fit(custodian, first, now)
        fit(custodian, second, now)
        # A chunk leaves the radio in each turn, and later none.
        if turn < 6:
            for sack in of(Sack, first.receive(chunks.pop(0)._replace(poll=True), now)):
                custodian.receive(sack, now)
        begun += [turn for offer in of(Offer, custodian.step(now)) if offer.id.sequence == 1]
    assert begun
    assert 5 < begun[0] <= 5 + 2 * SILENT_ROUNDS


def test_what_is_on_its_way_has_its_place_in_the_store_so_nothing_is_refused_when_it_is_whole() -> None:
    """Two senders, and one place."""
    custodians = {id: custodian_of(noise(300 + id), id) for id in (1, 3)}
    receiver = make_node(2, capacity_items=2)
    receiver.put(b"one place is taken", 0.0)
    for custodian in custodians.values():
        fit(custodian, receiver, 0.0)
    said = talk({**custodians, 2: receiver}, [m for custodian in custodians.values() for m in custodian.step(0.0)], 0.0)
    assert len(of(Offer, said)) == 2
    assert len(of(Accept, said)) == 1
    assert len(receiver.holdings.custody) == 2


@pytest.mark.parametrize(
    "forge",
    [
        lambda handle: [Chunk(3, handle, index, False, bytes(123)) for index in range(3)],
        lambda handle: [Chunk(3, handle, 2, True, bytes(123)), Chunk(3, handle, 2, True, b"")],
        lambda handle: [Chunk(3, handle, 99, True, bytes(123)), Chunk(3, handle, 0, True, bytes(122))],
    ],
    ids=["wrong bytes", "one wrong chunk", "wrong index and size"],
)
@pytest.mark.parametrize("when", [0, 2, 24])
def test_whoever_captures_a_handle_hurts_no_other_transfer(forge: Callable[[int], list[Message]], when: int) -> None:
    """Two senders to one receiver. A third node knows the handle of one, before its chunk of this index comes."""
    custodians = {id: custodian_of(noise(3000 + id), id) for id in (1, 2)}
    receiver = make_node(3)
    accepts: dict[int, Accept] = {}
    for id, custodian in custodians.items():
        fit(custodian, receiver, 0.0)
        [offer] = of(Offer, custodian.step(0.0))
        [accepts[id]] = of(Accept, receiver.receive(offer, 0.0))
    chunks = {id: custodian.receive(accepts[id], 0.0) for id, custodian in custodians.items()}
    answers: list[Message] = []
    for index in range(max(map(len, chunks.values()))):
        if index == when:
            answers += [a for false in forge(accepts[1].handle) for a in receiver.receive(false, 0.0)]
        for of_custodian in chunks.values():
            answers += [a for chunk in of_custodian[index : index + 1] for a in receiver.receive(chunk, 0.0)]
    talk({**custodians, 3: receiver}, answers, 0.0)
    [other] = [id for id in receiver.holdings.custody if id.origin == 2]
    assert other not in custodians[2].holdings.custody
    assert receiver.custody_store.corrupt_received <= 1
    for turn in range(1, 4):
        now = float(turn)
        for custodian in custodians.values():
            fit(custodian, receiver, now)
        talk({**custodians, 3: receiver}, [m for custodian in custodians.values() for m in custodian.step(now)], now)
    taken = {id.origin: datum.payload for id in receiver.holdings.custody if (datum := receiver.store.get(id))}
    assert taken == {id: noise(3000 + id) for id in custodians}
    assert not custodians[1].holdings.custody


def test_a_receiver_that_reports_nothing_again_and_again_is_not_sent_it_all_the_time() -> None:
    custodian, receiver = custodian_of(noise(300)), make_node(2)
    fit(custodian, receiver, 0.0)
    [offer] = of(Offer, custodian.step(0.0))
    said, sent = custodian.receive(Accept(2, 1, offer.number, 77, 0, 0), 0.0), 0
    for turn in range(1, 4):
        now, before = float(turn), sent
        for _ in range(1000):
            chunks = of(Chunk, said)
            sent += len(chunks)
            asked = [chunk for chunk in chunks if chunk.poll]
            if not asked:
                break
            question = 0 if asked[-1].data else asked[-1].position
            said = custodian.receive(Sack(2, 1, 77, 0, 0, question), now - 0.5)
        assert sent - before < 250
        fit(custodian, receiver, now)
        said = custodian.step(now)
    # It does not give up at once: it may be the link.
    assert of(Chunk, said)
