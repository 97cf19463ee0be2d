"""Where the nodes stand at the start."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import Position, RangeGraph
from rass_mav.lab.swarm import topology
from tests.extent import examples

ARENA_M = 20.0
RANGE_M = 3.0
seeds = st.integers(0, 2**32)
Layout = Callable[[int, float, float, Random], list[Position]]


def nearest(positions: list[Position], *, before: bool) -> list[float]:
    """For each node after the first, the distance to the nearest of those before it, or of all others."""
    return [
        min(math.dist(place, other) for j, other in enumerate(positions) if j < i or (j > i and not before))
        for i, place in enumerate(positions)
        if i > 0
    ]


def test_the_paper_grid_stands_where_its_formula_says() -> None:
    expected = [(-9.0 + 2 * (i // 10), -9.0 + 2 * (i % 10)) for i in range(100)]
    assert topology.grid(100, ARENA_M) == expected


@pytest.mark.parametrize(("nodes", "side"), [(1, 1), (2, 2), (4, 2), (5, 3), (9, 3), (10, 4), (1000, 32)])
def test_a_grid_of_any_size_has_the_smallest_side_that_holds_it(nodes: int, side: int) -> None:
    positions = topology.grid(nodes, ARENA_M)
    assert len(set(positions)) == nodes
    assert len({y for _, y in positions}) == min(side, nodes)
    first = -ARENA_M / 2 + ARENA_M / side / 2
    assert positions[0] == pytest.approx((first, first))
    assert max(abs(c) for place in positions for c in place) <= -first + 1e-9


def test_a_line_has_its_pitch_and_its_middle_in_the_origin() -> None:
    assert topology.line(4, 2.5) == [(-3.75, 0.0), (-1.25, 0.0), (1.25, 0.0), (3.75, 0.0)]
    assert topology.line(1, 2.5) == [(0.0, 0.0)]


@pytest.mark.no_cover
@settings(max_examples=examples(30))
@given(seeds, st.integers(1, 120), st.sampled_from([1.5, 3.0, 5.0]))
def test_scale_free_robots_keep_the_law_of_distances(seed: int, nodes: int, range_m: float) -> None:
    positions = topology.scale_free(nodes, ARENA_M, range_m, Random(seed))
    assert len(positions) == nodes
    assert all(abs(c) <= 9.5 for place in positions for c in place)
    # Ids are shuffled, so what each robot found at its placement shows as: none nearer than 0.3 m, and one graph.
    assert all(0.3 <= d <= range_m for d in nearest(positions, before=False))
    assert None not in RangeGraph(positions, range_m).hops_from([0])


@settings(max_examples=examples(30))
@given(seeds, st.integers(1, 120), st.sampled_from([10.0, 20.0, 1000.0]))
def test_the_lennard_jones_start_is_connected_when_each_robot_is_placed(seed: int, nodes: int, arena_m: float) -> None:
    positions = topology.connected_uniform(nodes, arena_m, RANGE_M, Random(seed))
    assert len(positions) == nodes
    assert all(abs(c) <= arena_m / 2 - 0.5 for place in positions for c in place)
    assert all(0.3 <= d <= RANGE_M for d in nearest(positions, before=True))
    assert None not in RangeGraph(positions, RANGE_M).hops_from([0])


@pytest.mark.no_cover
def test_scale_free_gathers_robots_around_hubs() -> None:
    """Attachment must show: the best-connected robot hears more others than on a start without attachment."""
    attached: list[int] = []
    uniform: list[int] = []
    for seed in range(20):
        for make, hubs in ((topology.scale_free, attached), (topology.connected_uniform, uniform)):
            graph = RangeGraph(make(100, 60.0, RANGE_M, Random(seed)), RANGE_M)
            hubs.append(max(map(len, graph.neighbours)))
    assert sum(attached) > 1.5 * sum(uniform)


def test_scale_free_bases_stand_anywhere() -> None:
    starts = [topology.scale_free(30, ARENA_M, RANGE_M, Random(seed))[0] for seed in range(40)]
    for axis in (0, 1):
        assert min(place[axis] for place in starts) < -5
        assert max(place[axis] for place in starts) > 5


@pytest.mark.parametrize("make", [topology.scale_free, topology.connected_uniform])
def test_robots_that_find_no_place_are_reported(make: Layout) -> None:
    with pytest.raises(ConfigError, match=r"^nodes: no place found for robot \d+ of 200 in an arena of 3 m"):
        make(200, 3.0, RANGE_M, Random(1))


@pytest.mark.parametrize("make", [topology.scale_free, topology.connected_uniform])
@pytest.mark.parametrize(("arena_m", "range_m", "key"), [(1.0, 3.0, "arena_m"), (20.0, 0.3, "radio.range_m")])
def test_worlds_too_small_for_robots_are_reported(make: Layout, arena_m: float, range_m: float, key: str) -> None:
    with pytest.raises(ConfigError, match=f"^{key}: expected more than"):
        make(10, arena_m, range_m, Random(1))


def test_bases_of_a_grid_stand_in_its_four_corners() -> None:
    positions = topology.grid(100, ARENA_M)
    spread = topology.spread_bases(positions, 4)
    assert spread[:4] == [positions[0], positions[99], positions[9], positions[90]]
    assert spread[99] == positions[1]
    assert spread[9] == positions[2]
    assert spread[90] == positions[3]
    kept = set(range(4, 100)) - {9, 90, 99}
    assert all(spread[i] == positions[i] for i in kept)


def test_two_bases_of_a_line_stand_at_its_ends() -> None:
    spread = topology.spread_bases(topology.line(7, 2.4), 2)
    assert spread[0][0] == pytest.approx(-7.2)
    assert spread[1][0] == pytest.approx(7.2)


@pytest.mark.parametrize("bases", [1, 4, 6, 9])
def test_even_bases_have_about_as_many_nodes_each(bases: int) -> None:
    positions = topology.grid(900, 60.0)
    even = topology.even_bases(positions, bases)
    shares = Counter(min(range(bases), key=lambda base: math.dist(place, even[base])) for place in even)
    assert len(shares) == bases
    assert max(shares.values()) <= 1.3 * 900 / bases
    # In the middle: a base has all eight neighbours.
    assert all(sum(math.dist(even[base], place) < RANGE_M for place in even) == 9 for base in range(bases))
    assert sorted(even) == sorted(positions)
    assert topology.even_bases(positions, bases) == even


@given(st.integers(1, 60), st.data())
def test_spreading_bases_only_exchanges_places(nodes: int, data: st.DataObject) -> None:
    bases = data.draw(st.integers(1, nodes))
    positions = topology.grid(nodes, ARENA_M)
    spread = topology.spread_bases(positions, bases)
    assert sorted(spread) == sorted(positions)
    assert spread[0] == positions[0]
    if bases == 1:
        assert spread == positions
