"""Survival routing: costs to the base, and shelter where there is none."""

from __future__ import annotations

import heapq
import random

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.routes.announcements import ANNOUNCEMENTS_CLAIMED, newer
from rass_mav.core.routes.costs import COST_ONE, NO_COST
from rass_mav.core.routes.table import HOLD_LIFETIMES
from rass_mav.policy.settings import PolicySettings
from tests.extent import examples

from .build import make_node
from .durable import DurableStore
from .routing_harness import NEIGHBOUR_STEPS, Swarm, rough_times

ONLY = [Phase.explicit, Phase.reuse, Phase.generate]
SURVIVAL = PolicySettings(name="survival").make()
#: Turns until nobody remembers an announcement.
FORGOTTEN = int(HOLD_LIFETIMES * (NEIGHBOUR_STEPS + 0.5)) + 1


def toll(risk: float) -> int:
    return SURVIVAL.potential(1, risk, 1)


def cheapest(swarm: Swarm) -> dict[int, int]:
    """Dijkstra from the bases, over nodes that are alive: cost from each node, its own toll included."""
    found: dict[int, int] = {}
    queue = [(0, base) for base in swarm.bases if base in swarm.nodes]
    while queue:
        cost, at = heapq.heappop(queue)
        if at in found:
            continue
        found[at] = cost
        for other in swarm.nodes:
            if other not in found and frozenset((at, other)) in swarm.links:
                heapq.heappush(queue, (cost + toll(swarm.risks[other]), other))
    return found


def costs(swarm: Swarm) -> dict[int, int]:
    return {
        i: 0 if i in swarm.bases else n.routing.metric for i, n in swarm.nodes.items() if n.routing.route is not None
    }


@pytest.mark.parametrize(("risk", "cost"), [(0.0, 0.05), (0.5, 0.05 + 0.693147), (1.0, 0.05 + 6.907755)])
def test_the_toll_by_hand(risk: float, cost: float) -> None:
    assert toll(risk) == pytest.approx(cost * COST_ONE, abs=1)


@given(st.floats(0, 1), st.floats(0, 1))
def test_more_risk_never_costs_less(a: float, b: float) -> None:
    low, high = sorted((a, b))
    assert 1 <= toll(low) <= toll(high) < NO_COST


@pytest.mark.no_cover
@settings(max_examples=examples(30), deadline=None, phases=ONLY)
@given(st.integers(0, 1 << 32))
def test_no_cycles_ever_and_the_cheapest_ways_once_the_network_heals(seed: int) -> None:
    swarm = rough_times(seed, ("survival",))
    for _ in range(60):
        swarm.turn()
    swarm.check()
    best, found = cheapest(swarm), costs(swarm)
    assert set(found) == set(best)
    if swarm.seq_period and len(swarm.bases) == 1:
        assert found == best


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None, phases=ONLY)
@given(st.integers(0, 1 << 32))
def test_no_cycles_in_a_swarm_of_two_policies(seed: int) -> None:
    swarm = rough_times(seed, ("survival", "rass", "rass"))
    for _ in range(30):
        swarm.turn()


@pytest.mark.no_cover
@settings(max_examples=examples(30), deadline=None, phases=ONLY)
@given(st.integers(0, 1 << 32))
def test_no_cycles_where_the_base_comes_and_goes_and_risks_change(seed: int) -> None:
    rng = random.Random(seed)
    size = rng.randint(4, 10)
    swarm = Swarm(rng, size, 1, seq_period=2, policies=("survival",))
    swarm.random_links(rng.choice([0.3, 0.6]))
    swarm.loss = rng.choice([0.0, 0.3])
    for turn in range(120):
        if turn % 25 == 12:
            swarm.wipe(0) if rng.random() < 0.3 else swarm.kill(0)
        elif turn % 25 == 0 and turn:
            swarm.start(0)
        swarm.sense(rng.choice([0.0, 0.05, 0.5]))
        if rng.random() < 0.05:
            swarm.random_links(rng.choice([0.3, 0.6]))
        swarm.turn()


@pytest.mark.no_cover
@settings(max_examples=examples(15, 2400), deadline=None, phases=ONLY)
@given(st.integers(0, 1 << 32))
def test_no_cycles_where_queues_come_and_go(seed: int) -> None:
    rng = random.Random(seed)
    size = rng.randint(4, 10)
    swarm = Swarm(rng, size, 1, seq_period=2, policies=("survival",), queue_toll=True)
    swarm.random_links(rng.choice([0.3, 0.6]))
    swarm.loss = rng.choice([0.0, 0.3])
    for _ in range(80):
        swarm.sense(rng.choice([0.0, 0.05]))
        for i in range(1, size):
            if rng.random() < 0.3:
                swarm.queue(i, rng.choice([0, 5, 20, 50]))
        if rng.random() < 0.05:
            swarm.random_links(rng.choice([0.3, 0.6]))
        swarm.turn()


def line(risks: list[float], *, base: bool = True) -> Swarm:
    """0 - 1 - 2 - ...; node 0 is the base, or away."""
    swarm = Swarm(random.Random(1), len(risks), 1, policies=("survival",))
    swarm.risks = dict(enumerate(risks))
    swarm.links = {frozenset((i, i + 1)) for i in range(len(risks) - 1)}
    swarm.sense(0.0)
    if not base:
        swarm.kill(0)
    return swarm


def test_a_detour_is_taken_when_it_is_safer() -> None:
    swarm = Swarm(random.Random(1), 5, 1, policies=("survival",))
    # From 4 by 1 through danger, or by 3 and 2.
    swarm.links = {frozenset(link) for link in ((0, 1), (1, 4), (0, 2), (2, 3), (3, 4))}
    swarm.risks[1] = 0.3
    swarm.sense(0.0)
    for _ in range(8):
        swarm.turn()
    assert swarm.nodes[4].routing.next_hop == 3
    assert swarm.nodes[4].routing.hops == 3
    assert swarm.nodes[1].routing.next_hop == 0


def test_a_full_neighbour_is_passed_by() -> None:
    swarm = Swarm(random.Random(1), 4, 1, seq_period=1, policies=("survival",))
    swarm.links = {frozenset(link) for link in ((0, 1), (0, 2), (1, 3), (2, 3))}
    swarm.risks[2] = 0.1
    swarm.sense(0.0)
    for _ in range(5):
        swarm.turn()
    routing = swarm.nodes[3].routing
    assert routing.next_hop == 1
    swarm.nodes[1].holdings.capacity_items = 0
    for _ in range(4):
        swarm.turn()
    assert routing.next_hop == 2
    assert routing.metric == toll(0.1) + toll(0.0)
    swarm.nodes[2].holdings.capacity_items = 0
    for _ in range(4):
        swarm.turn()
    # Nobody has room: the cheaper way will be the first to have some.
    assert routing.next_hop == 1


def diamond(*, queue_toll: bool) -> Swarm:
    """From 3 to the base by 1 or by 2, where it is a little less safe."""
    swarm = Swarm(random.Random(1), 4, 1, seq_period=1, policies=("survival",), queue_toll=queue_toll)
    swarm.links = {frozenset(link) for link in ((0, 1), (0, 2), (1, 3), (2, 3))}
    swarm.risks[2] = 0.02
    swarm.sense(0.0)
    for _ in range(5):
        swarm.turn()
    assert swarm.nodes[3].routing.next_hop == 1
    return swarm


def test_data_avoid_a_node_where_data_wait() -> None:
    swarm = diamond(queue_toll=True)
    # A turn carries 10 data. A datum that arrives behind 20 others is exposed three times.
    swarm.queue(1, 20)
    for _ in range(3):
        swarm.turn()
    assert swarm.nodes[1].routing.metric == 3 * toll(0.0)
    routing = swarm.nodes[3].routing
    assert (routing.next_hop, routing.metric) == (2, toll(0.02) + toll(0.0))
    swarm.queue(1, 0)
    for _ in range(3):
        swarm.turn()
    assert (routing.next_hop, routing.metric) == (1, 2 * toll(0.0))


def test_without_the_toll_nobody_cares_for_queues() -> None:
    swarm = diamond(queue_toll=False)
    swarm.queue(1, 20)
    for _ in range(3):
        swarm.turn()
    assert costs(swarm) == cheapest(swarm)


def test_the_data_that_gather_on_the_safest_node_of_an_island_do_not_drive_others_away() -> None:
    swarm = Swarm(random.Random(1), 4, 1, policies=("survival",), queue_toll=True)
    swarm.risks = dict(enumerate([0.0, 0.2, 0.1, 0.0]))
    swarm.links = {frozenset((i, i + 1)) for i in range(3)}
    swarm.sense(0.0)
    swarm.kill(0)
    swarm.queue(3, 40)
    for _ in range(FORGOTTEN + 12):
        swarm.turn()
    assert [swarm.nodes[i].routing.next_hop for i in (1, 2, 3)] == [2, 3, None]


def test_where_no_base_is_all_data_go_to_the_safest_node() -> None:
    swarm = line([0.0, 0.3, 0.2, 0.1, 0.0, 0.2], base=False)
    for _ in range(FORGOTTEN + 12):
        swarm.turn()
    hops = {i: node.routing.next_hop for i, node in swarm.nodes.items()}
    assert hops == {1: 2, 2: 3, 3: 4, 4: None, 5: 4}
    assert all(node.routing.hops == NO_ROUTE for node in swarm.nodes.values())


def test_shelter_is_not_left_for_a_place_that_is_hardly_safer() -> None:
    swarm = line([0.0, 0.05, 0.05], base=False)
    for _ in range(FORGOTTEN + 12):
        swarm.turn()
    assert [swarm.nodes[i].routing.next_hop for i in (1, 2)] == [None, None]


def test_after_the_base_is_lost_nobody_takes_shelter_before_the_old_routes_are_forgotten() -> None:
    swarm = line([0.0, 0.5, 0.0, 0.0])
    for _ in range(8):
        swarm.turn()
    assert costs(swarm) == cheapest(swarm)
    swarm.kill(0)
    sheltered = None
    for turn in range(40):
        swarm.turn()
        if swarm.nodes[1].routing.route is None and swarm.nodes[1].routing.next_hop is not None:
            sheltered = turn
            break
    # It is silent for the lifetime of the base's last beacon, and then for as long as its own are remembered.
    assert sheltered is not None
    assert sheltered >= NEIGHBOUR_STEPS + FORGOTTEN - 1


def test_when_the_base_comes_back_all_have_a_way_again() -> None:
    swarm = line([0.0, 0.1, 0.2, 0.1, 0.0], base=False)
    for _ in range(40):
        swarm.turn()
    swarm.start(0)
    for _ in range(10):
        swarm.turn()
    assert costs(swarm) == cheapest(swarm)


def test_a_base_writes_its_number_now_and_then_and_goes_on_with_higher_ones() -> None:
    store = DurableStore(epoch=7)
    node = make_node(0, base=True, store=store, seq_period=1)
    commits = 0
    last = 0
    for step in range(3 * ANNOUNCEMENTS_CLAIMED):
        before = store.get_meta("announcement")
        last = node.step(float(step))[0].route_number  # type: ignore[union-attr]
        commits += store.get_meta("announcement") != before
        assert not newer(last, store.disk.meta["announcement"]), "said before it was on disk"
        store.commit()
    assert commits <= 6
    again = make_node(0, base=True, store=store.crashed(), seq_period=1)
    [beacon, *_] = again.step(0.0)
    assert newer(beacon.route_number, last)  # type: ignore[union-attr]
