from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import Committed, Message, Offer, Put
from rass_mav.core.stigmergy import wins
from rass_mav.errors import StoreFullError
from tests.some import some

from .build import data, datum, make_stigmergy_node, of
from .durable import DurableStore

writes = st.lists(st.tuples(st.integers(1, 3), st.integers(1, 3)), min_size=1, max_size=5, unique=True)


def put(lamport: int, writer: int, sequence: int = 0) -> Put:
    return Put(7, lamport, writer, datum(sequence=sequence, payload=bytes([lamport, writer])))


def merged(puts: list[Put]) -> bytes:
    node = make_stigmergy_node(1)
    for p in puts:
        node.receive(p, 0.0)
    held = some(node.store.get(datum().id))
    return held.payload


@given(writes, st.randoms())
def test_the_order_and_the_doubling_of_writes_do_not_matter(versions: list[tuple[int, int]], rng: object) -> None:
    puts = [put(*v) for v in versions]
    shuffled = puts + puts[:2]
    rng.shuffle(shuffled)  # type: ignore[attr-defined]
    assert merged(puts) == merged(shuffled) == bytes(max(versions))


def test_the_later_timestamp_wins_and_between_equals_the_higher_robot() -> None:
    assert wins(2, 1, 1, 9)
    assert wins(2, 5, 2, 4)
    for a, b in itertools.product(range(3), repeat=2):
        assert not wins(a, b, a, b)


def test_a_line_of_nodes_converges() -> None:
    nodes = [make_stigmergy_node(i) for i in range(4)]
    ids = [node.put(bytes([i]), 0.0) for i, node in enumerate(nodes)]
    for turn in range(8):
        said: list[list[Message]] = [node.step(float(turn)) for node in nodes]
        for i, messages in enumerate(said):
            for j in (i - 1, i + 1):
                if 0 <= j < len(nodes):
                    for m in messages:
                        nodes[j].receive(m, float(turn))
    for node in nodes:
        assert set(node.holdings.custody) == set(ids)
    assert of(Put, nodes[0].step(9.0)) == []


def test_without_room_a_neighbours_entry_is_refused_and_the_own_one_is_overflow() -> None:
    node = make_stigmergy_node(1, capacity_items=1)
    node.receive(put(1, 9), 0.0)
    node.receive(put(1, 9, sequence=1), 0.0)
    assert len(node.holdings.custody) == 1
    assert node.refused == 1
    with pytest.raises(StoreFullError):
        node.put(b"own", 0.0)
    assert node.store.counters()["overflow"] == 1


def test_a_longer_version_of_a_held_entry_that_does_not_fit_is_refused() -> None:
    for bound in ({"store": DurableStore(1, quota_bytes=10)}, {"capacity_bytes": 10}):
        node = make_stigmergy_node(1, **bound)
        node.receive(Put(7, 1, 9, datum(payload=b"12345678")), 0.0)
        node.receive(Put(7, 2, 9, datum(payload=b"123456789012")), 0.0)
        held = some(node.store.get(datum().id))
        assert held.payload == b"12345678"
        assert node.refused == 1
        node.receive(Put(7, 3, 9, datum(payload=b"1234567890")), 0.0)
        assert node.holdings.custody_bytes == 10


def test_custody_is_refused_for_nobody_here_would_move_the_data_on() -> None:
    node = make_stigmergy_node(1)
    assert node.receive(data(2, 1, (7, datum()), (0, datum(sequence=1))), 0.0) == [Committed(1, 2, (), (7,))]
    offer = Offer(2, 1, 8, datum().id, 0, 0.0, 0, 0, 500, 100)
    assert node.receive(offer, 0.0) == [Committed(1, 2, (), (8,))]
    assert len(node.holdings) == 0
