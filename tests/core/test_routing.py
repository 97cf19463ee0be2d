from __future__ import annotations

import copy
from typing import Any

import pytest

from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, Beacon, Route
from rass_mav.core.routes.costs import CostRules
from rass_mav.core.routes.neighbours import CREDIT
from rass_mav.core.routes.ranks import ByCost, ByHops, Rank
from rass_mav.core.routes.table import HOLD_LIFETIMES, MAX_BASES, RoutingTable

from .build import beacon, node_settings


def table(
    node_id: int = 5, *, rank: Rank | None = None, restarted: float | None = None, number: int = 0, **settings: Any
) -> RoutingTable:
    made = RoutingTable(node_settings(node_id, **settings), 50 + node_id, rank or ByHops(), restarted=restarted)
    if made.base:
        made.announce(number)
    return made


def feasible(routing: RoutingTable, route: Route) -> bool:
    """Whether it is taken where nothing else is heard, long after anybody counts on another base's."""
    later = copy.deepcopy(routing)
    later.hear(beacon(99, route=route), 1e6)
    later.update(1e6)
    return later.next_hop == 99


def announce(routing: RoutingTable, now: float = 0.0) -> Route | None:
    routing.announced(now)
    return routing.route


def test_a_base_is_its_own_route() -> None:
    base = table(0, base=True, number=7)
    base.hear(beacon(1, route=Route(8, 9, 1, 0)), 0.0)
    base.update(0.0)
    assert base.route == Route(0, 50, 7, 0)
    assert base.next_hop is None


def test_after_an_announcement_only_shorter_or_newer_routes_are_feasible() -> None:
    routing = table()
    routing.hear(beacon(1, 0, Route(0, 9, 5, 2)), 0.0)
    routing.update(0.0)
    assert announce(routing) == Route(0, 9, 5, 3)
    assert feasible(routing, Route(0, 9, 5, 2))
    assert not feasible(routing, Route(0, 9, 5, 3))
    assert not feasible(routing, Route(0, 9, 4, 0))
    assert feasible(routing, Route(0, 9, 6, 200))
    assert feasible(routing, Route(0, 10, 1, 200))
    routing.hear(beacon(1, 1, Route(0, 9, 5, 3)), 1.0)
    routing.update(1.0)
    assert routing.route is None


def test_without_an_announcement_nothing_is_forbidden() -> None:
    routing = table()
    routing.hear(beacon(1, 0, Route(0, 9, 5, 2)), 0.0)
    routing.update(0.0)
    assert feasible(routing, Route(0, 9, 5, 100))


def test_a_slow_neighbour_that_has_become_fast_is_forgotten_sooner() -> None:
    routing = table()
    routing.hear(beacon(1, 0xFFFF)._replace(turn=90), -9.0)
    routing.hear(beacon(1, 0)._replace(turn=90), 0.0)
    routing.update(0.0)
    assert routing.longest_s == pytest.approx(3.5 * 9)
    routing.hear(beacon(1, 1), 1.0)
    routing.update(4.5)
    assert (list(routing.neighbours), routing.longest_s) == ([1], 3.5)
    routing.update(4.6)
    assert not routing.neighbours


def test_a_turn_that_grows_is_believed_as_far_as_it_is_shown() -> None:
    routing = table()
    for number in range(3):
        routing.hear(beacon(1, number)._replace(turn=600), float(number))
    routing.update(2.0)
    assert routing.longest_s == pytest.approx(3.5 * CREDIT)
    routing.hear(beacon(1, 3)._replace(turn=600), 2.0 + CREDIT)
    routing.update(2.0 + CREDIT)
    assert routing.longest_s == pytest.approx(3.5 * CREDIT * CREDIT)
    routing.hear(beacon(1, 4)._replace(turn=600), 20.0)
    routing.update(20.0)
    assert routing.longest_s == pytest.approx(3.5 * CREDIT * (18.0 - CREDIT))


def test_a_beacon_taken_in_late_counts_from_when_it_was_heard() -> None:
    routing = table()
    routing.hear(beacon(1, 0), 5.0)
    routing.update(5.0)
    routing.hear(beacon(1, 1), 2.0)
    routing.update(5.6)
    assert not routing.neighbours


def test_doubled_and_late_beacons_are_ignored() -> None:
    routing = table()
    assert routing.hear(beacon(1, 0xFFFF), 0.0)
    assert routing.hear(beacon(1, 0), 1.0)
    assert not routing.hear(beacon(1, 0), 2.0)
    assert not routing.hear(beacon(1, 0xFFF0), 2.0)
    assert routing.neighbours[1].heard == 1.0


def test_a_restarted_neighbour_starts_anywhere() -> None:
    routing = table()
    routing.hear(beacon(1, 1000), 0.0)
    assert routing.hear(beacon(1, 7), 1.0)
    assert routing.hear(beacon(1, 7, life=2), 1.0)


def hear_twice(routing: RoutingTable, first: Beacon, now: float = 0.0) -> bool:
    """Whether a neighbour is known that is heard twice."""
    routing.hear(first._replace(number=0xFFFF), now - 1.0)
    return routing.hear(first, now)


def test_the_table_is_bounded_and_keeps_the_nearest_and_of_these_the_fittest() -> None:
    routing = table(max_neighbours=2)
    hear_twice(routing, beacon(1, potential=1, route=Route(0, 9, 1, 0)))
    hear_twice(routing, beacon(2, potential=5))
    assert not hear_twice(routing, beacon(3, potential=5))
    assert hear_twice(routing, beacon(4, potential=6))
    assert set(routing.neighbours) == {1, 4}
    assert hear_twice(routing, beacon(5, potential=2, route=Route(0, 9, 1, 7)))
    assert set(routing.neighbours) == {1, 5}


def test_a_full_table_keeps_the_next_hop() -> None:
    routing = table(max_neighbours=1)
    hear_twice(routing, beacon(1, potential=1, route=Route(0, 9, 1, 3)))
    routing.update(0.0)
    assert not hear_twice(routing, beacon(2, potential=9, route=Route(0, 9, 1, 0)))
    assert routing.next_hop == 1


def test_under_costs_a_full_table_keeps_the_cheapest_and_strangers_go_first() -> None:
    rank = ByCost(CostRules(7, hold=1.0, hysteresis=1.0, change_over=3))
    routing = table(rank=rank, max_neighbours=3)
    way = Route(0, 9, 1, 4)
    hear_twice(routing, beacon(1, potential=900, policy=7, route=way))
    hear_twice(routing, beacon(2, potential=0xFFFFFFFF, policy=8, route=Route(0, 9, 1, 1)))
    hear_twice(routing, beacon(3, potential=100, policy=7, route=way))
    routing.update(0.0)
    assert hear_twice(routing, beacon(4, potential=800, policy=7, route=way))
    assert set(routing.neighbours) == {1, 3, 4}
    assert not hear_twice(routing, beacon(5, potential=900, policy=7, route=way))
    assert hear_twice(routing, beacon(6, potential=0xFFFFFFFF, flags=BEACON_BASE, policy=8, route=Route(6, 1, 1, 0)))
    assert set(routing.neighbours) == {3, 4, 6}


def test_who_says_that_it_is_a_base_fills_a_quarter_of_the_table_at_most() -> None:
    routing = table(max_neighbours=8)
    for id in range(100, 108):
        hear_twice(routing, beacon(id, flags=BEACON_BASE, route=Route(id, 1, 1, 0)))
    routing.update(0.0)
    kept = {100, 101, routing.next_hop}
    # Better than they: as near, and fitter. It takes the places of all that are not kept.
    for id in range(1, 20):
        hear_twice(routing, beacon(id, potential=1000 + id, flags=BEACON_BASE, route=Route(0, 9, 1, 0)))
    assert {id for id in routing.neighbours if id >= 100} == kept
    assert len(routing.neighbours) == 8


def test_a_base_heeds_requests_for_newer_numbers_of_its_own_only() -> None:
    base = table(0, base=True, number=0xFFFF)
    base.hear(beacon(1, 0, flags=BEACON_WANTED, wanted=(0, 0xFFFF)), 0.0)
    base.hear(beacon(1, 1, flags=BEACON_WANTED, wanted=(1, 0)), 0.0)
    base.hear(beacon(1, 2, flags=BEACON_WANTED, wanted=(0, 0xFFF0)), 0.0)
    assert base.requested is None
    base.hear(beacon(1, 3, flags=BEACON_WANTED, wanted=(0, 7)), 0.0)
    base.hear(beacon(1, 4, flags=BEACON_WANTED, wanted=(0, 0)), 0.0)
    assert base.requested == 7
    base.announce(7)
    assert base.requested is None
    assert base.route == Route(0, 50, 7, 0)


def test_feasibility_of_the_route_in_use_outlives_many_other_bases() -> None:
    routing = table()
    own = Route(0, 9, 5, 1)
    for n in range(2 * MAX_BASES):
        at = 100.0 * n
        routing.hear(beacon(1, 2 * n, own), at)
        routing.hear(beacon(2, 2 * n), at)
        routing.update(at)
        assert announce(routing, at) == Route(0, 9, 5, 2)
        routing.hear(beacon(1, 2 * n + 1), at + 50)
        routing.hear(beacon(2, 2 * n + 1, Route(1000 + n, 9, 1, 0)), at + 50)
        routing.update(at + 50)
        assert announce(routing, at + 50) == Route(1000 + n, 9, 1, 1)
        assert not feasible(routing, Route(0, 9, 5, 2))


def test_no_other_route_is_taken_before_all_have_forgotten_the_old_one() -> None:
    """That of an earlier life, or one that was lost."""
    hold = HOLD_LIFETIMES * 3.5
    restarted, bereft = table(restarted=0.0), table()
    bereft.hear(beacon(2, route=Route(200, 9, 3, 1)), 0.0)
    bereft.update(0.0)
    announce(bereft)
    bereft.hear(beacon(2, 1), 1.0)
    for routing in (restarted, bereft):
        routing.hear(beacon(1, route=Route(100, 9, 1, 2)), hold)
        routing.update(hold - 0.01)
        assert routing.route is None
        routing.update(hold)
        assert routing.next_hop == 1
