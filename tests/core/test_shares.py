"""When space is nearly used up, what is left is for those that have less than an equal share."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.handovers import MAX_ACCEPTED, HandoverNumbers
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Committed, Data, Handover
from rass_mav.core.node import Node
from rass_mav.core.seals import ContentHashes
from rass_mav.core.shares import LAST_PART, greediest, is_fair, is_last_part
from rass_mav.errors import StoreFullError
from tests.extent import examples

from .books import check_node
from .build import beacon, datum, make_node, of, passed_on

CAPACITY = 40


def hand_over(node: Node, custodian: int, number: int, origin: int, sequence: int, payload: bytes = b"x") -> bool:
    """Whether the node took it."""
    data = Data(custodian, node.id, (Handover(number, datum(origin, sequence, payload)),))
    [answer] = of(Committed, node.receive(data, 0.0))
    return bool(answer.committed)


def full_of(custodian: int) -> tuple[Node, int]:
    """A node that one neighbour has given all that it took."""
    node = make_node(1, mirror=True, capacity_items=CAPACITY)
    taken = sum(hand_over(node, custodian, 1 + n, 100 + n, 0) for n in range(2 * CAPACITY))
    check_node(node)
    return node, taken


def test_a_single_custodian_gets_all_but_the_last_part() -> None:
    _, taken = full_of(7)
    assert taken == CAPACITY - CAPACITY // LAST_PART


def test_the_last_part_is_for_own_data_and_for_others() -> None:
    node, taken = full_of(7)
    assert hand_over(node, 8, 1, 500, 0)
    for _ in range(CAPACITY - taken - 1):
        node.put(b"own", 0.0)
    with pytest.raises(StoreFullError):
        node.put(b"own", 0.0)
    check_node(node)


def test_the_same_holds_for_an_origin_whoever_gives() -> None:
    node = make_node(1, mirror=True, capacity_items=CAPACITY)
    taken = sum(hand_over(node, 10 + n, 1, 9, n) for n in range(2 * CAPACITY))
    assert taken == CAPACITY - CAPACITY // LAST_PART
    assert hand_over(node, 10, 2, 500, 0)


def test_the_same_holds_for_bytes() -> None:
    node = make_node(1, mirror=True, capacity_items=None, capacity_bytes=8000)
    sizes = [90 for n in range(200) if hand_over(node, 7, 1 + n, 100 + n, 0, bytes(90))]
    assert 7000 - 90 <= sum(sizes) <= 7000
    assert hand_over(node, 8, 1, 500, 0, bytes(90))
    check_node(node)


def test_where_receipts_are_off_whoever_comes_first_is_served() -> None:
    node = make_node(1, receipts=False, capacity_items=CAPACITY)
    assert sum(hand_over(node, 7, 1 + n, 100 + n, 0) for n in range(CAPACITY)) == CAPACITY


@pytest.mark.no_cover
@settings(max_examples=examples(40), deadline=None)
@given(st.integers(0, 1 << 32))
def test_nobody_is_refused_while_there_is_space_nor_one_with_less_than_its_share_while_there_is_any(seed: int) -> None:
    rng, node = random.Random(seed), make_node(1, mirror=True, capacity_items=CAPACITY)
    custodians = range(7, 7 + rng.randint(1, 6))
    weights = [rng.choice([1, 1, 20]) for _ in custodians]
    for n in range(2 * CAPACITY):
        held = len(node.holdings.custody)
        if rng.random() < 0.1:
            if held < CAPACITY:
                node.put(b"own", 0.0)
            continue
        [custodian] = rng.choices(custodians, weights)
        has = sum(h.received_from == custodian for h in node.holdings.custody.values())
        taken = hand_over(node, custodian, 1 + n, 100 + n, 0)
        assert taken or held >= CAPACITY - CAPACITY // LAST_PART
        # This node is one of those that share.
        assert taken or held == CAPACITY or has >= CAPACITY // (len(custodians) + 1)
        check_node(node)


def test_replicas_of_who_has_most_go_first() -> None:
    node = make_node(1, mirror=True, capacity_items=CAPACITY)
    node.receive(beacon(3, free=1000, potential=1 << 24), 0.0)
    for n in range(30):
        assert hand_over(node, 8 if n < 5 else 7, 1 + n, 100 + n, 0)
    for n in range(30):
        holding = node.holdings.custody[DatumId(100 + n, 77, 0)]
        node.custody_store.give_away(holding, 3)
        node.receive(passed_on(3, 1, holding.id), 0.0)
    for _ in range(30):
        node.put(b"own", 0.0)
    # Those of 8 are older, but fewer.
    assert {h.received_from for h in node.holdings.passed_on.values()} == {7, 8}
    assert sum(h.received_from == 8 for h in node.holdings.passed_on.values()) == 5
    check_node(node)


def test_a_flood_of_hand_overs_pushes_out_no_numbers_of_others() -> None:
    numbers = HandoverNumbers(ContentHashes())
    numbers.accept(7, 1, DatumId(1, 1, 1), 5)
    for n in range(2 * MAX_ACCEPTED):
        numbers.accept(8, n, DatumId(2, 1, n), 5)
    assert numbers.has_accepted(7, 1, DatumId(1, 1, 1), 5)
    assert sum(numbers.has_accepted(8, n, DatumId(2, 1, n), 5) for n in range(2 * MAX_ACCEPTED)) == MAX_ACCEPTED - 1


@given(st.dictionaries(st.integers(), st.integers(1, 50), min_size=1), st.integers(1, 200))
def test_somebody_has_at_least_an_equal_share_when_all_is_used(counts: dict[int, int], places: int) -> None:
    most = counts[greediest(counts)]
    assert most == max(counts.values())
    if sum(counts.values()) >= places:
        assert not is_fair(most, places, len(counts))
    assert is_last_part(places, places)
