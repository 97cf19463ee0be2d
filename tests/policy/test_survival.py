"""Who gets the data under survival routing. How the way is found: tests/core/test_cost_routing.py."""

from __future__ import annotations

import random

import pytest

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, UNBOUNDED_FREE
from rass_mav.core.policy import POTENTIAL_BASE, View
from rass_mav.core.routes.costs import COST_ONE, NO_COST
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.policy.settings import PolicySettings

from .test_policies import IDS, neighbour

POLICY = PolicySettings(name="survival").make()


def view(way: Neighbour | None, *others: Neighbour, budget: int = 10) -> View:
    neighbours = [*others, way] if way else list(others)
    return View(neighbours, way, 3, COST_ONE, 0.1, budget, lambda neighbour: iter(IDS), random.Random(1))


def targets(view: View) -> list[tuple[DatumId, int]]:
    return [(t.id, t.neighbour) for t in POLICY.plan(view)]


def test_all_data_go_the_way_of_the_routing_table_oldest_first_within_the_budget() -> None:
    way = neighbour(2, COST_ONE, tag=POLICY.tag, hops=1)
    cheaper = neighbour(3, 1, tag=POLICY.tag, hops=1)
    assert targets(view(way, cheaper, budget=4)) == [(id, 2) for id in IDS[:4]]


@pytest.mark.parametrize(("free", "sent"), [(3, 3), (0, 0), (UNBOUNDED_FREE, 10)])
def test_no_more_than_the_next_hop_has_room_for(free: int, sent: int) -> None:
    assert len(targets(view(neighbour(2, COST_ONE, tag=POLICY.tag, hops=1, free=free)))) == sent


def test_without_a_way_data_stay() -> None:
    assert targets(view(None, neighbour(2, NO_COST, tag=POLICY.tag))) == []


def test_without_a_way_a_stranger_that_has_one_is_asked_the_nearest_to_a_base() -> None:
    far, near, full, lost = (
        neighbour(2, 900, tag=1, hops=5),
        neighbour(3, 100, tag=1, hops=2),
        neighbour(4, 100, tag=1, hops=1, free=0),
        neighbour(5, 100, tag=1, hops=NO_ROUTE),
    )
    assert {target for _, target in targets(view(None, far, near, full, lost))} == {3}


def test_a_strangers_base_is_left_to_the_routing_table() -> None:
    # It is the way if it is feasible; if it is not, nothing may go there.
    assert targets(view(None, neighbour(2, POTENTIAL_BASE, tag=1, hops=0))) == []


def test_what_a_hop_costs_is_a_setting() -> None:
    dear = PolicySettings(name="survival", hop_cost=0.5).make()
    assert dear.potential(1, 0.0, 1) == COST_ONE // 2
    assert dear.tag != POLICY.tag
