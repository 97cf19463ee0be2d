from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import Message, Put
from rass_mav.core.node import Node
from rass_mav.core.replica import wins
from rass_mav.errors import StoreFullError

from .build import beacon, datum, make_node, of
from .durable import DurableStore

writes = st.lists(st.tuples(st.integers(1, 3), st.integers(1, 3)), min_size=1, max_size=5, unique=True)


def put(lamport: int, writer: int, sequence: int = 0) -> Put:
    return Put(7, lamport, writer, datum(sequence=sequence, payload=bytes([lamport, writer])))


def merged(puts: list[Put]) -> bytes:
    node = make_node(1, policy="stigmergy")
    for p in puts:
        node.receive(p, 0.0)
    held = node.store.get(datum().id)
    assert held is not None
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
    nodes = [make_node(i, policy="stigmergy") for i in range(4)]
    ids = [node.put(bytes([i]), 0.0) for i, node in enumerate(nodes)]
    for turn in range(8):
        said: list[list[Message]] = [node.step(float(turn)) for node in nodes]
        for i, messages in enumerate(said):
            for j in (i - 1, i + 1):
                if 0 <= j < len(nodes):
                    for m in messages:
                        nodes[j].receive(m, float(turn))
    for node in nodes:
        assert set(node.inventory) == set(ids)
    assert of(Put, nodes[0].step(9.0)) == []


def rewritten(node: Node) -> Put:
    id = next(iter(node.inventory))
    node.rewrite(id, b"new", 1.0)
    node.receive(beacon(2), 1.0)
    [said] = of(Put, node.step(1.0))
    assert isinstance(said, Put)
    return said


def test_a_rewrite_wins_over_what_it_replaces() -> None:
    node = make_node(1, policy="stigmergy")
    node.receive(put(4, 9), 0.0)
    said = rewritten(node)
    assert (said.lamport, said.writer, said.datum.payload) == (5, 1, b"new")
    assert said.datum.intact


def test_the_timestamp_stays_within_its_16_bits() -> None:
    node = make_node(1, policy="stigmergy")
    node.receive(Put(7, 0xFFFF, 9, datum()), 0.0)
    assert rewritten(node).lamport == 0xFFFF


def test_without_room_a_neighbours_entry_is_refused_and_the_own_one_is_overflow() -> None:
    node = make_node(1, policy="stigmergy", capacity_items=1)
    node.receive(put(1, 9), 0.0)
    node.receive(put(1, 9, sequence=1), 0.0)
    assert len(node.inventory) == 1
    assert node.refused == 1
    with pytest.raises(StoreFullError):
        node.put(b"own", 0.0)
    assert node.store.counters()["overflow"] == 1


def test_a_longer_version_of_a_held_entry_that_does_not_fit_is_refused() -> None:
    for bound in ({"store": DurableStore(1, quota_bytes=10)}, {"capacity_bytes": 10}):
        node = make_node(1, policy="stigmergy", inline_bytes=8, **bound)
        node.receive(Put(7, 1, 9, datum(payload=b"12345678")), 0.0)
        node.receive(Put(7, 2, 9, datum(payload=b"123456789012")), 0.0)
        held = node.store.get(datum().id)
        assert held is not None
        assert held.payload == b"12345678"
        assert node.refused == 1
        node.receive(Put(7, 3, 9, datum(payload=b"1234567890")), 0.0)
        assert node.inventory.bytes == 10
