"""What must hold for the routes of many nodes together, over a bad network."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.routes.announcements import newer
from rass_mav.core.routes.ranks import CHANGE_OVER_HOPS
from tests.extent import examples

from .routing_harness import NEIGHBOUR_STEPS, Swarm, rough_times

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


@settings(max_examples=examples(30), deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.integers(0, 1 << 32))
def test_no_cycles_ever_and_the_right_hop_counts_once_the_network_heals(seed: int) -> None:
    swarm = rough_times(seed)
    for _ in range(60):
        swarm.turn()
    swarm.check()
    if swarm.seq_period:
        nearest, found = swarm.distances(), swarm.hops()
        assert set(found) == set(nearest)
        # Between bases a node stays with its own for a detour of less than CHANGE_OVER_HOPS.
        detour = CHANGE_OVER_HOPS - 1 if len(swarm.bases) > 1 else 0
        assert all(nearest[i] <= found[i] <= nearest[i] + detour for i in nearest), (nearest, found)
    else:
        # Without periodical numbers a node asks for one only when it has no route at all, so it may keep a detour.
        assert set(swarm.hops()) == set(swarm.distances())


def line(size: int, **more: Any) -> Swarm:
    """Node 0 is the base; 0 - 1 - 2 - ..."""
    swarm = Swarm(random.Random(1), size, 1, **more)
    swarm.links = {frozenset((i, i + 1)) for i in range(size - 1)}
    for _ in range(2 * size):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(size)}
    return swarm


@pytest.mark.parametrize("size", [3, 12])
def test_routes_to_a_vanished_base_die_out_in_hops_plus_lifetime_steps(size: int) -> None:
    swarm = line(size)
    # A ring at the far end, where Alg. 2 as written would count to infinity.
    swarm.links.add(frozenset((size - 1, 1)))
    swarm.kill(0)
    for _ in range(size + NEIGHBOUR_STEPS + 2):
        swarm.turn()
        assert max(swarm.hops().values(), default=0) <= size
    assert swarm.hops() == {}


def test_a_cut_link_is_routed_around_although_the_way_is_longer() -> None:
    # Without a periodical new number: the request does it.
    swarm = line(6, seq_period=0)
    swarm.links |= {frozenset((0, 5))}
    swarm.links -= {frozenset((0, 1))}
    for _ in range(30):
        swarm.turn()
    assert swarm.hops() == {0: 0, 5: 1, 4: 2, 3: 3, 2: 4, 1: 5}


def test_a_base_killed_and_restarted_goes_on_with_higher_numbers() -> None:
    swarm = line(5)
    before = swarm.nodes[0].routing.number
    swarm.kill(0)
    swarm.start(0)
    swarm.turn()
    assert newer(swarm.nodes[0].routing.number, before)
    for _ in range(10):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(5)}


def test_a_wiped_base_is_another_base() -> None:
    swarm = line(5)
    old = swarm.nodes[0].store.epoch
    swarm.wipe(0)
    for _ in range(NEIGHBOUR_STEPS + 3):
        swarm.turn()
    swarm.start(0)
    for _ in range(12):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(5)}
    route = swarm.nodes[4].routing.route
    assert route is not None
    assert route.base_life == swarm.nodes[0].store.epoch != old
