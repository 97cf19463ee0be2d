"""Terms of data: what travels, who leaves first, and what expires."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import (
    MOST_PRIORITY,
    MOST_TTL_S,
    TERMS,
    TERMS_SIZE,
    USUAL,
    Datum,
    DatumId,
    Fate,
    Terms,
    make_datum,
    parted,
    terms_of,
)
from rass_mav.core.messages import Committed, Data, Put
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.core.store import StoredInfo, info_of
from rass_mav.errors import DatumError
from tests.some import some

from .books import check_node
from .build import beacon, data, datum, make_node, make_stigmergy_node, of
from .durable import DurableStore
from .replica_net import CHAIN, RISKS, Net

terms = st.builds(Terms, st.integers(0, MOST_PRIORITY), st.none() | st.integers(1, MOST_TTL_S))


def with_terms(terms: Terms, sequence: int = 0, *, origin: int = 9, created: float = 0.0) -> Datum:
    return make_datum(DatumId(origin, 77, sequence), TERMS, created, terms.pack() + b"reading")


# -- the bytes ---------------------------------------------------------------------------------------------------------


@given(terms, st.integers(0, 63), st.binary(min_size=1, max_size=50))
def test_terms_are_read_as_they_were_given(terms: Terms, kind: int, content: bytes) -> None:
    packed = terms.pack()
    kind |= TERMS if packed else 0
    assert terms_of(kind, packed + content) == terms
    assert parted(kind, packed + content) == (packed, content)
    assert (packed == b"") is (terms == USUAL)


@given(st.integers(0, 255), st.binary(max_size=10))
def test_any_payload_has_terms(kind: int, payload: bytes) -> None:
    priority, ttl_s = terms_of(kind, payload)
    assert 0 <= priority <= MOST_PRIORITY
    assert ttl_s is None or 1 <= ttl_s <= MOST_TTL_S
    if not kind & TERMS or len(payload) < TERMS_SIZE:
        assert (priority, ttl_s) == USUAL
    assert b"".join(parted(kind, payload)) == payload


@pytest.mark.parametrize("wrong", [Terms(-1), Terms(10), Terms(ttl_s=0), Terms(ttl_s=MOST_TTL_S + 1)])
def test_terms_out_of_range_create_nothing(wrong: Terms) -> None:
    node = make_node(1)
    with pytest.raises(DatumError):
        node.put(b"x", 0.0, terms=wrong)
    assert node.store.assigned == 0


def test_a_datum_without_terms_has_the_bytes_that_it_always_had() -> None:
    node = make_node(1)
    stored = node.store.get(node.put(b"reading", 5.0, 1, USUAL))
    assert stored == make_datum(DatumId(1, 1001, 0), 1, 5.0, b"reading")


def test_terms_count_for_the_largest_size_and_kinds_have_six_bits() -> None:
    node, few = make_node(1, capacity_bytes=None), Terms(7)
    content = bytes(node.most_put - TERMS_SIZE)
    with pytest.raises(DatumError, match="a datum holds 1 to"):
        node.put(content + b"x", 0.0, terms=few)
    stored = some(node.store.get(node.put(content, 0.0, 63, few)))
    assert (stored.kind, len(stored.payload)) == (63 | TERMS, node.most_bytes)
    with pytest.raises(DatumError, match="a kind is 0 to 63, got 64"):
        node.put(b"x", 0.0, TERMS)


# -- who leaves first --------------------------------------------------------------------------------------------------


def left(node: Node, number: int = 1, now: float = 1.0, *, free: int = 50) -> list[int]:
    """The sequences of what leaves in a turn, in its order, after a beacon of a fitter neighbour that answers all."""
    node.receive(beacon(2, number, policy=node.policy.tag, potential=POTENTIAL_ONE, free=free), now)
    gone = []
    for message in of(Data, node.step(now)):
        gone += [handover.datum.id.sequence for handover in message.handovers]
        pairs = tuple((handover.number, handover.datum.crc) for handover in message.handovers)
        node.receive(Committed(2, 1, pairs, ()), now)
    check_node(node)
    return gone


@pytest.mark.no_cover
@given(st.lists(st.integers(0, MOST_PRIORITY), min_size=1, max_size=40), st.integers(1, 7), st.integers(0, 40))
def test_no_datum_waits_for_more_than_twice_as_many_as_without_priorities(
    priorities: list[int], bandwidth: int, flood: int
) -> None:
    """Also while somebody hands over ever more data of the highest priority."""
    node = make_node(1, bandwidth_items=bandwidth, capacity_items=None)
    for priority in priorities:
        node.put(b"x", 0.0, terms=Terms(priority))
    gone: list[tuple[int, int]] = []
    for turn in range(1, 100):
        now = float(turn)
        if turn <= flood:
            urgent = [with_terms(Terms(9), 100 * turn + each, created=now) for each in range(bandwidth)]
            node.receive(data(3, 1, *((1 + each.id.sequence, each) for each in urgent)), now)
        gone += [(sequence, len(gone)) for sequence in left(node, turn, now)]
    before = {sequence: place for place, (sequence, _) in enumerate(gone) if sequence < len(priorities)}
    assert sorted(before) == list(range(len(priorities)))
    assert all(place <= 2 * sequence + 1 for sequence, place in before.items())


@pytest.mark.parametrize("size", [10, 500])
def test_urgent_data_overtake_on_all_of_their_way(size: int) -> None:
    """One datum leaves a node in a step, or one large one is on its way at a time."""
    net = Net(RISKS, CHAIN, bandwidth_items=1)
    net.step()
    slow = [net.put(1, bytes(size)) for _ in range(8)]
    urgent = net.nodes[1].put(bytes(size), net.now, terms=Terms(9))
    arrived: list[DatumId] = []
    while len(arrived) < 9:
        net.step()
        arrived += [id for id in net.nodes[3].holdings.custody if id not in arrived]
    assert arrived.index(urgent) <= 1
    assert [id for id in arrived if id != urgent] == slow


@pytest.mark.no_cover
@given(st.data())
def test_the_indexes_hold_whatever_happens(choices: st.DataObject) -> None:
    node = make_node(1, capacity_items=12, bandwidth_items=3, mirror=True, overhear=True, lifetime_s=40.0)
    rng = random.Random(choices.draw(st.integers(0, 1000)))
    for turn in range(1, 60):
        now = float(turn)
        given_terms = Terms(rng.randrange(10), rng.choice([None, 1, 5, 20]))
        item = with_terms(given_terms, rng.randrange(30), origin=5, created=now - rng.randrange(10))
        node.receive(beacon(3, turn), now)
        target = rng.choice([1, 1, 4])
        node.receive(data(3, target, (turn, item))._replace(replica=rng.random() < 0.3), now)
        left(node, turn, now, free=rng.randrange(3))


# -- lifetimes ---------------------------------------------------------------------------------------------------------


def test_a_datum_expires_by_its_own_lifetime_or_that_of_the_node() -> None:
    for lifetime_s, ttl_s, ends in ((None, 5, 5), (3.0, 5, 3), (9.0, 5, 5), (9.0, None, 9)):
        node = make_node(1, lifetime_s=lifetime_s)
        id = node.put(b"x", 0.0, terms=Terms(9, ttl_s))
        node.step(float(ends))
        assert id in node.holdings.custody
        node.step(ends + 0.1)
        assert id not in node.holdings
        assert dict(node.store.losses()) == {id: Fate.EXPIRED}
        check_node(node)


@pytest.mark.no_cover
@given(st.lists(st.tuples(st.none() | st.integers(1, 30), st.integers(0, 20)), max_size=30))
def test_each_expires_at_its_time(born: list[tuple[int | None, int]]) -> None:
    node = make_node(1, capacity_items=None)
    ends = {}
    for now in range(60):
        for ttl_s, at in born:
            if at == now:
                ends[node.put(b"x", float(now), terms=Terms(ttl_s=ttl_s))] = None if ttl_s is None else now + ttl_s
        node.step(now + 0.5)
        assert set(node.holdings.custody) == {id for id, end in ends.items() if end is None or now + 0.5 <= end}
        check_node(node)


def test_a_base_keeps_what_has_arrived_and_takes_what_is_late() -> None:
    base = make_node(1, base=True, lifetime_s=5.0)
    base.receive(data(2, 1, (7, with_terms(Terms(ttl_s=5))), (8, with_terms(Terms(ttl_s=5), 1))), 3.0)
    base.step(100.0)
    late = with_terms(Terms(ttl_s=5), 2)
    assert base.receive(data(2, 1, (9, late)), 100.0) == [Committed(1, 2, ((9, late.crc),), ())]
    base.step(200.0)
    assert [info.id.sequence for info in base.store.held()] == [0, 1, 2]
    assert base.store.counters().get("expired", 0) == 0


def test_a_restart_finds_terms_and_order() -> None:
    store = DurableStore(1001)
    node = make_node(1, store=store)
    ids = [node.put(b"x", 0.0, terms=Terms(*each)) for each in ((4, None), (9, 50), (0, 5), (9, None))]
    store.commit()
    again = make_node(1, store=store.crashed(), bandwidth_items=1)
    assert [h.terms for h in again.holdings.custody.values()] == [(4, None), (9, 50), (0, 5), (9, None)]
    check_node(again)
    again.step(10.0)
    assert list(again.holdings.custody) == [ids[0], ids[1], ids[3]]


def test_a_flipped_bit_in_the_lifetime_is_a_corrupt_copy_not_an_expired_one() -> None:
    """After a restart the lifetime is what the disk says. The replica at a neighbour can still be had."""
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)])
    net.step()
    long = Terms(ttl_s=(1 << 20) + 1)
    id = net.nodes[1].put(b"x", net.now, terms=long)
    net.step(3)
    assert net.replicas(id) == [2]
    net.stores[1].flip_bit(id, 8 + 20)
    assert next(info.terms for info in net.stores[1].held()) == Terms(ttl_s=1)
    net.start(1, scrub_items=0)
    net.step(30)
    assert (id, Fate.EXPIRED) not in net.book.fates
    assert (id, Fate.CORRUPTED) in net.book.fates
    assert net.custody(id)
    stored = some(net.stores[net.custody(id)[0]].get(id))
    assert stored.terms == long


def test_under_stigmergy_lifetimes_hold_and_priorities_mean_nothing() -> None:
    node = make_stigmergy_node(1)
    for turn, each in enumerate(((4, None), (0, 3), (9, None))):
        node.put(bytes([turn]), 0.0, terms=Terms(*each))
    node.receive(beacon(2), 0.5)
    assert [put.datum.id.sequence for put in of(Put, node.step(1.0))] == [0, 1, 2]
    node.receive(Put(2, 1, 9, with_terms(Terms(ttl_s=5))), 1.0)
    node.step(4.0)
    assert [id.sequence for id in node.holdings.custody] == [0, 2, 0]
    node.step(6.0)
    assert [id.sequence for id in node.holdings.custody] == [0, 2]
    assert node.store.counters()["expired"] == 2


@given(terms)
def test_what_a_store_tells_of_a_datum_has_its_terms(given_terms: Terms) -> None:
    item = with_terms(given_terms) if given_terms.pack() else datum()
    info = info_of(item)
    assert info == StoredInfo(item.id, item.kind, 0.0, 0, item.crc, len(item.payload), False, given_terms)
