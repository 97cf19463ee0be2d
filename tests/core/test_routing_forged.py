"""A routing table hears anything at all: it stays bounded, and no single beacon is worth more than it may be."""

from __future__ import annotations

import random
from math import isfinite
from unittest.mock import patch

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import NO_ROUTE, Beacon, Route
from rass_mav.core.routes import table as routing_table
from rass_mav.core.routes.costs import CostRules
from rass_mav.core.routes.neighbours import MOST_TURN_S
from rass_mav.core.routes.ranks import ByCost, ByHops
from rass_mav.core.routes.table import MAX_BASES, RoutingTable
from tests.extent import examples

from .build import beacon, node_settings
from .routing_harness import Swarm

MOST = 6
SOME = st.sampled_from([0, 1, 2, 3, 5, 50, 60])
U16 = SOME | st.integers(0, 0xFFFF)
U32 = SOME | st.integers(0, 0xFFFFFFFF)
ANY = st.builds(
    Beacon, sender=SOME | st.integers(0, 0xFFFE), life=U32, number=U16, flags=st.integers(0, 255), base=U16,
    base_life=U32, route_number=U16, hops=st.integers(0, 4) | st.integers(0, 255), wanted_base=U16, wanted_number=U16,
    risk=U16, free=U16, policy=st.just(7) | U16, potential=U32, statements_hash=U32, turn=U16,
)  # fmt: skip
#: What is heard, how the clock goes on, and what the node does then.
MOMENTS = st.lists(
    st.tuples(ANY, st.sampled_from([0.0, 0.3, 1.0, 5.0, 1e6, -1.0, -1e5]), st.sampled_from(["", "turn", "quiet turn"])),
    max_size=60,
)


@pytest.mark.no_cover
@patch.object(routing_table, "MAX_HOPS", 9)
@pytest.mark.parametrize("kind", ["hops", "costs"])
@pytest.mark.parametrize("base", [False, True])
@given(moments=MOMENTS)
def test_whatever_is_heard_the_table_is_in_order(
    kind: str, base: bool, moments: list[tuple[Beacon, float, str]]
) -> None:
    rank = ByHops() if kind == "hops" else ByCost(CostRules(7, 100.0, 0.8, 3))
    table = RoutingTable(node_settings(5, base=base, max_neighbours=MOST), 55, rank)
    if base:
        table.announce(1)
    now = 0.0
    for heard, passed, event in moments:
        now += passed
        if heard.sender != 5:
            table.hear(heard, now)
        if event:
            table.update(now)
        if event == "turn":
            table.announced(now)
        neighbours = table.neighbours
        assert len(neighbours) <= MOST
        assert len(neighbours.candidates) <= MOST
        assert len(table.feasible) <= MAX_BASES
        assert all(n.turn_s <= MOST_TURN_S and n.id == n.beacon.sender == id for id, n in neighbours.items())
        if event:
            assert table.next_hop is None or table.next_hop in neighbours
            assert base or table.route is None or (0 < table.route.hops <= 9 and table.route.base != 5)
            assert table.longest_s <= table.lifetime_s * MOST_TURN_S
            assert base or 0 < table.metric <= rank.no_way
            assert isfinite(table.longest_turn_s)
            assert 0 <= table.distance <= NO_ROUTE


def table(most: int = 8) -> RoutingTable:
    return RoutingTable(node_settings(5, max_neighbours=most), 55, ByHops())


def test_in_a_table_that_is_half_full_only_who_is_heard_twice_finds_a_place() -> None:
    routing = table()
    for id in range(10, 14):
        assert routing.hear(beacon(id, 1), 0.0)
    assert not routing.hear(beacon(20, 1), 0.0)
    assert not routing.hear(beacon(20, 1), 0.1), "the same beacon twice"
    assert not routing.hear(beacon(20, 0), 0.2), "an older one"
    assert routing.hear(beacon(20, 3), 1.0)
    assert not routing.hear(beacon(21, 1), 1.0)
    assert not routing.hear(beacon(21, 2, life=9), 2.0), "another node of that name"
    assert not routing.hear(beacon(22, 1), 2.0)
    assert not routing.hear(beacon(22, 2), 5.6), "too long ago"
    assert routing.hear(beacon(22, 3), 6.0)


def test_who_was_heard_once_is_given_up_first() -> None:
    routing = table(4)
    near = Route(0, 9, 1, 0)
    routing.hear(beacon(10, 1, near, potential=9), 0.0)
    routing.hear(beacon(11, 1, near, potential=9), 0.0)
    for id in (20, 21, 22):
        routing.hear(beacon(id, 1), 0.0)
        assert routing.hear(beacon(id, 2), 1.0)
    assert len(routing.neighbours) == 4
    assert {20, 21, 22} <= set(routing.neighbours)


def test_a_turn_that_was_said_once_does_not_count() -> None:
    routing = table()
    routing.hear(beacon(1, 1)._replace(turn=0xFFFF), 0.0)
    routing.update(0.0)
    assert routing.longest_s == 3.5
    routing.update(4.0)
    assert not routing.neighbours
    routing.hear(beacon(1, 2)._replace(turn=0xFFFF), 100.0)
    routing.update(100.0)
    assert routing.longest_s == 3.5 * MOST_TURN_S


def test_a_neighbour_whose_newest_beacon_was_made_up_is_heard_again_with_the_second_of_its_own() -> None:
    routing = table()
    routing.hear(beacon(1, 10), 0.0)
    routing.hear(beacon(1, 41, Route(0, 9, 1, 0)), 0.5)
    assert not routing.hear(beacon(1, 11), 1.0)
    assert not routing.hear(beacon(1, 11), 1.1)
    assert routing.hear(beacon(1, 12), 2.0)
    assert routing.hear(beacon(1, 13), 3.0)
    routing.update(3.0)
    assert routing.next_hop is None


@pytest.mark.no_cover
@settings(max_examples=examples(30), deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.integers(0, 1 << 32), st.sampled_from(["rass", "survival"]), st.data())
def test_after_one_made_up_beacon_everybody_finds_the_way_again(seed: int, policy: str, data: st.DataObject) -> None:
    """It may be in anybody's name, and say anything. There may be a cycle as long as it is believed, and no longer."""
    rng = random.Random(seed)
    swarm = Swarm(rng, 8, 1, seq_period=2, policies=(policy,))
    swarm.links = {frozenset((i, i + 1)) for i in range(7)} | {frozenset((2, 6))}
    for _ in range(12):
        swarm.turn()
    sender = data.draw(st.integers(0, 9))
    life = swarm.nodes[sender].store.life if sender < 8 and data.draw(st.booleans()) else data.draw(U32)
    base = data.draw(st.sampled_from([0, sender]) | U16)
    made_up = data.draw(ANY)._replace(sender=sender, life=life, base=base)
    if data.draw(st.booleans()):
        made_up = made_up._replace(base_life=swarm.nodes[0].store.life)
    for hearer, node in swarm.nodes.items():
        if hearer != sender and rng.random() < 0.5:
            node.receive(made_up, swarm.now)
    patient, swarm.check = swarm.check, lambda: None  # type: ignore[method-assign]
    for _ in range(80):
        swarm.turn()
    swarm.check = patient  # type: ignore[method-assign]
    for _ in range(6):
        swarm.turn()
    assert set(swarm.hops()) == set(range(8))
    assert all(node.routing.route is not None and node.routing.route.base == 0 for node in swarm.nodes.values())
