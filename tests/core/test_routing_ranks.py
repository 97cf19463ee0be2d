"""What holds for routing by hops and by costs alike, and that they differ in their rank only."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterable
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.messages import NO_ROUTE, Beacon, Route
from rass_mav.core.routes import table as table_module
from rass_mav.core.routes.announcements import newer
from rass_mav.core.routes.costs import NO_COST, CostRules
from rass_mav.core.routes.ranks import CHANGE_OVER_HOPS, ByCost, ByHops, Rank
from rass_mav.core.routes.table import RoutingTable

from .build import beacon, node_settings

TAG = 7
RANKS: dict[str, Callable[[], Rank]] = {
    "hops": ByHops,
    # Costs are hops where each toll is 1; no place is worth a move where no base is reachable.
    "costs": lambda: ByCost(CostRules(TAG, hold=1.0, hysteresis=1.0, change_over=CHANGE_OVER_HOPS)),
}


class Said(NamedTuple):
    """What a neighbour says of its way in one step."""

    base: int
    number: int
    hops: int


def neighbours_beacon(id: int, step: int, said: Said | None, *, free: int = 50, cost: int | None = None) -> Beacon:
    if said is None:
        return beacon(id, step, policy=TAG, potential=NO_COST, free=free)
    route = Route(100 + said.base, 9, said.number, said.hops)
    return beacon(id, step, route, policy=TAG, potential=said.hops if cost is None else cost, free=free)


SAID = st.none() | st.builds(Said, st.integers(0, 2), st.integers(0, 4), st.integers(0, 6))
#: For each step what each of four neighbours says.
STEPS = st.lists(st.tuples(SAID, SAID, SAID, SAID), max_size=25)


@pytest.mark.parametrize("kind", RANKS)
@given(st.lists(st.tuples(st.integers(1, 4), SAID, st.integers(1, 9), st.booleans(), st.booleans()), max_size=60))
def test_no_infeasible_route_is_ever_chosen(kind: str, moments: list[tuple[int, Said | None, int, bool, bool]]) -> None:
    table = RoutingTable(node_settings(5), 55, RANKS[kind]())
    announced: dict[int, list[tuple[int, int]]] = {}
    for step, (id, said, cost, full, announce) in enumerate(moments):
        now = step * 0.5
        table.hear(neighbours_beacon(id, step, said, free=0 if full else 50, cost=cost), now)
        table.update(now)
        if table.route is not None:
            assert table.next_hop is not None
            chosen = table.neighbours[table.next_hop].beacon
            assert table.route == (chosen.base, chosen.base_life, chosen.route_number, chosen.hops + 1)
            metric = chosen.hops if kind == "hops" or chosen.hops == 0 else chosen.potential
            for number, lowest in announced.get(chosen.base, []):
                assert newer(chosen.route_number, number) or (chosen.route_number == number and metric < lowest)
            if announce:
                announced.setdefault(chosen.base, []).append((chosen.route_number, metric + 1))
        if announce:
            table.announced(now)


@pytest.mark.no_cover
@given(STEPS)
def test_costs_of_one_a_hop_lead_the_same_way_as_hops(steps: list[tuple[Said | None, ...]]) -> None:
    by_hops, by_cost = (RoutingTable(node_settings(5), 55, rank()) for rank in RANKS.values())
    for step, all_said in enumerate(steps):
        now = float(step)
        for table in (by_hops, by_cost):
            for id, said in enumerate(all_said):
                table.hear(neighbours_beacon(id, step, said), now)
            table.update(now)
            table.announced(now)
        assert by_cost.next_hop == by_hops.next_hop
        assert by_cost.route == by_hops.route
        assert by_cost.distance == by_hops.distance
        assert by_hops.route is None or by_cost.metric == by_hops.metric == by_hops.hops


@pytest.mark.parametrize("kind", RANKS)
def test_a_rank_has_no_more_to_say_than_the_table_asks_for(kind: str) -> None:
    def public(names: Iterable[str]) -> set[str]:
        return {name for name in names if not name.startswith("_")}

    assert public(dir(RANKS[kind]())) - {"rules"} == public([*dir(Rank), *Rank.__annotations__])


@pytest.mark.parametrize("kind", RANKS)
def test_late_and_full_neighbours_are_behind_by_cost_only(kind: str) -> None:
    table, rank = RoutingTable(node_settings(5), 55, ByHops()), RANKS[kind]()
    table.hear(neighbours_beacon(1, 0, None, free=0), 0.0)
    table.hear(neighbours_beacon(2, 0, None), 0.0)
    full, free = table.neighbours.values()
    assert [rank.behind(n, now) for now in (0.0, 2.0) for n in (free, full)] == (
        [0, 0, 0, 0] if kind == "hops" else [0, 1, 2, 3]
    )


def test_the_table_knows_no_rank_by_name() -> None:
    names = {node.id for node in ast.walk(ast.parse(inspect.getsource(table_module))) if isinstance(node, ast.Name)}
    assert "Rank" in names
    assert not names & {"ByHops", "ByCost", "CostRules", "NO_COST", "CHANGE_OVER_HOPS"}


@pytest.mark.parametrize("kind", RANKS)
def test_a_neighbour_without_a_way_is_no_way(kind: str) -> None:
    table = RoutingTable(node_settings(5), 55, RANKS[kind]())
    table.hear(neighbours_beacon(1, 0, None), 0.0)
    table.update(0.0)
    assert (table.route, table.next_hop, table.distance) == (None, None, NO_ROUTE)
