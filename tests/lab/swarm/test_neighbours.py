"""Who hears whom: the range graph against a search over all pairs."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.lab.medium.neighbours import TOLERANCE_M, Cells, RangeGraph
from rass_mav.lab.swarm.topology import grid

coordinate = st.floats(-30, 30, allow_nan=False) | st.integers(-9, 9).map(float)
places = st.lists(st.tuples(coordinate, coordinate), max_size=25)


def brute_force(positions: list[tuple[float, float]], range_m: float) -> list[list[int]]:
    return [
        [
            j
            for j, (qx, qy) in enumerate(positions)
            if j != i and (qx - px) ** 2 + (qy - py) ** 2 <= (range_m + TOLERANCE_M) ** 2
        ]
        for i, (px, py) in enumerate(positions)
    ]


@given(places, st.sampled_from([0.5, 1.0, 3.0, 100.0]))
def test_the_graph_is_that_of_all_pairs(positions: list[tuple[float, float]], range_m: float) -> None:
    assert RangeGraph(positions, range_m).neighbours == brute_force(positions, range_m)


@given(places, places)
def test_an_update_forgets_the_old_places(before: list[tuple[float, float]], after: list[tuple[float, float]]) -> None:
    graph = RangeGraph(before, 3.0)
    graph.update(after)
    assert graph.neighbours == brute_force(after, 3.0)


def test_nodes_exactly_at_the_range_hear_each_other() -> None:
    # In a line of pitch 0.1 m rounding puts some distances a little above 0.3 m.
    positions = [(0.1 * i, 0.0) for i in range(30)]
    assert any(math.dist(positions[i], positions[i + 3]) > 0.3 for i in range(27))
    graph = RangeGraph(positions, 0.3)
    assert graph.neighbours[10] == [7, 8, 9, 11, 12, 13]


def test_just_out_of_range_is_not_heard() -> None:
    assert RangeGraph([(0.0, 0.0), (3.000001, 0.0)], 3.0).neighbours == [[], []]


def test_a_node_of_the_paper_grid_has_its_eight_neighbours() -> None:
    graph = RangeGraph(grid(100, 20.0), 3.0)
    assert graph.neighbours[55] == [44, 45, 46, 54, 56, 64, 65, 66]
    assert graph.neighbours[0] == [1, 10, 11]


def test_hops_on_the_paper_grid_are_those_of_a_king_on_a_chessboard() -> None:
    hops = RangeGraph(grid(100, 20.0), 3.0).hops_from([0])
    assert hops == [max(i // 10, i % 10) for i in range(100)]


def test_hops_lead_to_the_nearest_base_and_end_at_gaps() -> None:
    graph = RangeGraph([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (9.0, 0.0)], 1.0)
    assert graph.hops_from([0]) == [0, 1, 2, 3, None]
    assert graph.hops_from([0, 3]) == [0, 1, 1, 0, None]
    assert graph.hops_from([]) == [None] * 5


@pytest.mark.parametrize("range_m", [0.0, -1.0, math.nan, math.inf])
def test_a_range_that_is_none_is_our_own_mistake(range_m: float) -> None:
    with pytest.raises(ValueError, match="range_m"):
        RangeGraph([], range_m)


def test_the_work_grows_with_the_neighbours_not_with_all_pairs() -> None:
    rng = Random(1)
    positions = [(rng.uniform(-31, 31), rng.uniform(-31, 31)) for _ in range(1000)]
    cells = Cells(3.0)
    for i, (x, y) in enumerate(positions):
        cells.add(i, x, y)
    looked_at = sum(
        len(here) * (len(here) - 1) // 2 if here is there else len(here) * len(there) for here, there in cells.pairs()
    )
    edges = sum(map(len, RangeGraph(positions, 3.0).neighbours)) // 2
    # Nine cells of side R against a circle of radius R: 9/pi = 2.9 pairs looked at for each edge.
    assert edges <= looked_at < 4 * edges
