"""How the nodes move, step by step; and survey patterns: they cover the area, and neighbours stay in range."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.config.loading import convert
from rass_mav.errors import ConfigError
from rass_mav.lab.medium.neighbours import Position, RangeGraph
from rass_mav.lab.swarm import topology
from rass_mav.lab.swarm.mobility import (
    LJ_DISTANCE_M,
    TOPOLOGIES,
    Block,
    Lawnmower,
    LennardJones,
    Mobility,
    Perimeter,
    blocks,
    make_mobility,
)
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.surroundings import Surroundings
from tests.environment import environment
from tests.extent import examples

FIVE = [[0.0, 0.0], [1.0, 0.5], [1.0, -0.5], [2, 0.5], [3.0, 0.0]]
seeds = st.integers(0, 2**32)


def make(name: str, seed: int = 1, **options: Any) -> Mobility:
    nodes = options.pop("nodes", len(FIVE) if name == "positions" else 100)
    if name == "positions":
        options.setdefault("positions", FIVE)
    numbers = {"range_m": 3.0, "arena_m": 20.0, **options}
    return make_mobility(name, nodes=nodes, rng=Random(seed), **numbers)


def track(mobility: Mobility, steps: int) -> list[list[Position]]:
    """The positions at steps 0 .. steps."""
    taken = []
    for t in range(steps + 1):
        before = mobility.positions
        moved = mobility.step(t)
        assert moved == (mobility.positions != before)
        taken.append(list(mobility.positions))
    return taken


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_step_0_is_the_start(name: str) -> None:
    mobility = make(name)
    start = list(mobility.positions)
    assert mobility.step(0) is False
    assert mobility.positions == start
    assert len(start) == (5 if name == "positions" else 100)


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_only_these_move(name: str) -> None:
    mobility = make(name, **({"split_step": 3} if name == "islands" else {}))
    taken = track(mobility, 5)
    assert (taken[0] != taken[5]) == (name in {"lennard-jones", "random-walk", "islands", "survey"})


@pytest.mark.parametrize("steps", [[1], [0, 0], [0, 2], [0, 1, 1]])
def test_steps_left_out_or_taken_twice_are_our_own_mistake(steps: list[int]) -> None:
    mobility = make("grid")
    for t in steps[:-1]:
        mobility.step(t)
    with pytest.raises(ValueError, match="is due"):
        mobility.step(steps[-1])


def test_grid_and_line_stand_where_topology_puts_them() -> None:
    assert make("grid").positions == topology.grid(100, 20.0)
    line = make("line", nodes=10, arena_m=0.0)
    assert line.positions == topology.line(10, 0.8 * 3.0)
    assert RangeGraph(line.positions, 3.0).hops_from([0]) == list(range(10))
    assert make("line", nodes=10, pitch_m=1.5).positions == topology.line(10, 1.5)


def test_a_list_of_positions_is_taken_as_it_is() -> None:
    assert make("positions").positions == [(0.0, 0.0), (1.0, 0.5), (1.0, -0.5), (2.0, 0.5), (3.0, 0.0)]


@pytest.mark.parametrize("name", ["grid", "random-walk", "islands"])
def test_several_bases_start_in_different_corners(name: str) -> None:
    mobility = make(name, bases=4)
    assert set(mobility.positions[:4]) == {(-9.0, -9.0), (9.0, 9.0), (-9.0, 9.0), (9.0, -9.0)}


# Random walk


@pytest.mark.no_cover
@settings(max_examples=examples(5, 600))
@given(seeds)
def test_every_walker_moves_15_cm_a_step_and_stays_inside_the_walls(seed: int) -> None:
    taken = track(make("random-walk", seed), 150)
    assert taken[0] == topology.grid(100, 20.0)
    for before, after in pairwise(taken):
        assert all(math.dist(p, q) == pytest.approx(0.15, rel=1e-9) for p, q in zip(before, after, strict=True))
        assert all(abs(c) <= 9.5 for place in after for c in place)


def test_one_walker_in_ten_takes_a_new_heading() -> None:
    # Far from the walls a robot turns only by chance.
    taken = track(make("random-walk", nodes=400, arena_m=2000.0, range_m=300.0), 60)
    turned = total = 0
    for a, b, c in zip(taken, taken[1:], taken[2:], strict=False):
        for p, q, r in zip(a, b, c, strict=True):
            total += 1
            turned += math.dist((2 * q[0] - p[0], 2 * q[1] - p[1]), r) > 1e-6
    # 23,600 draws with chance 0.1: three standard deviations are 0.006.
    assert turned / total == pytest.approx(0.1, abs=0.006)


def test_walkers_head_in_all_directions() -> None:
    first, second = track(make("random-walk", nodes=400, arena_m=200.0, range_m=30.0), 1)
    headings = [math.atan2(q[1] - p[1], q[0] - p[0]) for p, q in zip(first, second, strict=True)]
    quarters = [sum(k <= (h + math.pi) / (math.pi / 2) < k + 1 for h in headings) for k in range(4)]
    # 100 expected in each, standard deviation 8.7.
    assert all(70 < count < 130 for count in quarters)


def test_a_walker_at_a_wall_turns_back() -> None:
    taken = track(make("random-walk", nodes=1, arena_m=2.0), 400)
    assert all(max(map(abs, places[0])) <= 0.5 for places in taken)
    assert max(places[0][0] for places in taken) > 0.3
    assert min(places[0][0] for places in taken) < -0.3


@pytest.mark.no_cover
def test_walkers_of_a_crowded_grid_start_beyond_the_walls_and_walk_in() -> None:
    taken = track(make("random-walk", nodes=1000), 200)
    assert max(abs(c) for place in taken[0] for c in place) > 9.5
    out_at_last = sum(max(map(abs, place)) > 9.5 for place in taken[-1])
    assert out_at_last < 0.1 * sum(max(map(abs, place)) > 9.5 for place in taken[0])
    for before, after in pairwise(taken):
        for p, q in zip(before, after, strict=True):
            assert max(map(abs, q)) <= max(9.5, *map(abs, p))


# Lennard-Jones


@pytest.mark.no_cover
@settings(max_examples=examples(10))
@given(seeds, st.sampled_from([8.0, 20.0]))
def test_lennard_jones_robots_are_never_faster_than_5_cm_a_step_and_stay_inside(seed: int, arena_m: float) -> None:
    wall = arena_m / 2 - 0.5
    taken = track(make("lennard-jones", seed, nodes=40, arena_m=arena_m), 40)
    for before, after in pairwise(taken):
        assert all(math.dist(p, q) <= 0.05 + 1e-12 for p, q in zip(before, after, strict=True))
        assert all(abs(c) <= wall for place in after for c in place)


@pytest.mark.parametrize("apart_m", [0.35, 1.0, 2.0, 2.9])
def test_two_robots_settle_at_the_rest_distance(apart_m: float) -> None:
    pair = LennardJones([(0.0, 0.0), (apart_m, 0.0)], 3.0, 9.5, Random(1))
    taken = track(pair, 300)
    settled = [math.dist(*places) for places in taken[-100:]]
    assert sum(settled) / 100 == pytest.approx(LJ_DISTANCE_M, abs=0.03)
    assert max(settled) - min(settled) < 0.2


def test_robots_out_of_range_do_not_feel_each_other() -> None:
    pair = LennardJones([(0.0, 0.0), (3.2, 0.0)], 3.0, 9.5, Random(1))
    # Only the random motion is left: 5 mm a step along each axis.
    first, second = track(pair, 1)
    assert all(math.dist(p, q) < 0.03 for p, q in zip(first, second, strict=True))


def test_robots_at_the_same_place_come_apart() -> None:
    pair = LennardJones([(1.0, 1.0), (1.0, 1.0)], 3.0, 9.5, Random(1))
    assert math.dist(*track(pair, 100)[-1]) > 1.0


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_swarm_settles_near_the_rest_distance_and_stays_together(seed: int) -> None:
    """Robots beyond the nearest pull too, so a crowd rests somewhat closer than a pair.

    In a triangular lattice of spacing a, six neighbours each at a, sqrt(3) a and 2 a are within range. Pull and push
    are in balance where the sum of (d0/r)^4 over them is that of (d0/r)^2: (a/d0)^2 = (1 + 1/9 + 1/16)/(1 + 1/3 + 1/4).
    """
    lattice = LJ_DISTANCE_M * math.sqrt((1 + 1 / 9 + 1 / 16) / (1 + 1 / 3 + 1 / 4))
    assert 2 * lattice < 3.0 < math.sqrt(7) * lattice
    mobility = make("lennard-jones", seed)
    for t in range(301):
        mobility.step(t)
        if t % 25 == 0:
            assert None not in RangeGraph(mobility.positions, 3.0).hops_from([0])
    places = mobility.positions
    nearest = [min(math.dist(p, q) for j, q in enumerate(places) if j != i) for i, p in enumerate(places)]
    assert sum(nearest) / 100 == pytest.approx(lattice, rel=0.05)
    assert all(d == pytest.approx(lattice, rel=0.25) for d in nearest)


# Islands


def test_islands_part_for_good_at_the_split() -> None:
    taken = track(make("islands"), 150)
    start = topology.grid(100, 20.0)
    assert all(places == start for places in taken[:100])
    apart = [(x + 2.0 if x > 0 else x, y) for x, y in start]
    assert all(places == apart for places in taken[100:])
    graph = RangeGraph(apart, 3.0)
    near, far = graph.hops_from([0]), graph.hops_from([50])
    assert None not in near[:50] + far[50:]
    assert near[50:] == far[:50] == [None] * 50


def test_islands_may_come_together_again() -> None:
    mobility = make("islands", split_step=2, rejoin_step=4, gap_m=5.0)
    moved = [mobility.step(t) for t in range(6)]
    assert moved == [False, False, True, False, True, False]
    assert mobility.positions == topology.grid(100, 20.0)


# What makes no swarm


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("ring", {}, r"^topology: expected one of grid, .*, got 'ring'"),
        ("grid", {"nodes": 0}, r"^nodes: expected a number >= 1, got 0"),
        ("grid", {"bases": 0}, r"^bases: expected 1\.\.100, got 0"),
        ("grid", {"bases": 101}, r"^bases: expected 1\.\.100, got 101"),
        ("grid", {"range_m": 0.0}, r"^radio.range_m: expected a number > 0"),
        ("grid", {"range_m": math.nan}, r"^radio.range_m: expected a number > 0"),
        ("grid", {"arena_m": 0.0}, r"^arena_m: expected more than 1 m"),
        ("grid", {"arena_m": math.inf}, r"^arena_m: expected more than 1 m"),
        ("random-walk", {"arena_m": 1.2}, r"^arena_m: robots that walk need at least 1.3 m"),
        ("line", {"pitch_m": 0.0}, r"^mobility.pitch_m: expected a number > 0"),
        ("islands", {"split_step": 0}, r"^mobility.split_step: expected a step >= 1"),
        ("islands", {"split_step": 5, "rejoin_step": 5}, r"^mobility.rejoin_step: expected a step after 5"),
        ("islands", {"gap_m": -1.0}, r"^mobility.gap_m: expected a number > 0"),
        ("positions", {"nodes": 6}, r"^mobility.positions: expected one \[x, y\] for each of 6 nodes, got 5"),
        ("positions", {"positions": None}, r"^mobility.positions: .* got none"),
        (
            "positions",
            {"nodes": 1, "positions": [[1.0]]},
            r"^mobility.positions\[0\]: expected \[x, y\] in metres, got \[1.0\]",
        ),
        ("positions", {"nodes": 1, "positions": [[0.0, math.inf]]}, r"^mobility.positions\[0\]: "),
    ],
)
def test_numbers_that_make_no_swarm_are_reported(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(name, **options)


# Determinism

_PRINT_DIGEST = """
import hashlib, sys
from random import Random
from rass_mav.lab.swarm.mobility import make_mobility
for name in sys.argv[1:]:
    swarm = make_mobility(name, nodes=60, range_m=3.0, arena_m=15.0, rng=Random(7), bases=3, split_step=5)
    digest = hashlib.sha256()
    for t in range(12):
        swarm.step(t)
        digest.update(repr(swarm.positions).encode())
    print(digest.hexdigest())
"""


def test_a_seed_gives_the_same_swarm_in_any_process() -> None:
    names = [name for name in TOPOLOGIES if name != "positions"]
    one, other = (
        subprocess.run(
            [sys.executable, "-c", _PRINT_DIGEST, *names],
            env=environment(PYTHONHASHSEED=hash_seed), cwd=Path(__file__).parents[3], capture_output=True, text=True,
            check=True,
        ).stdout.split()
        for hash_seed in ("0", "12345")
    )  # fmt: skip
    assert one == other
    assert len(set(one)) == len(names)


@pytest.mark.parametrize("name", ["scale-free", "lennard-jones", "random-walk"])
def test_another_seed_gives_another_swarm(name: str) -> None:
    assert track(make(name, seed=1), 2) != track(make(name, seed=2), 2)


metres = st.floats(50, 3000)


@given(st.integers(1, 70), metres, metres)
def test_the_blocks_cover_the_area_once_and_are_equally_large(drones: int, width: float, height: float) -> None:
    found = blocks(drones, width, height)
    assert len(found) == drones
    for block in found:
        assert block.width * block.height == pytest.approx(width * height / drones)
        assert block.west >= -width / 2 - 1e-6
        assert block.west + block.width <= width / 2 + 1e-6
    rng = Random(1)
    for _ in range(50):
        x, y = rng.uniform(-width / 2, width / 2), rng.uniform(-height / 2, height / 2)
        assert sum(0 <= x - b.west < b.width and 0 <= y - b.south < b.height for b in found) == 1


@pytest.mark.parametrize(
    ("block", "strip"),
    [(Block(-100, -50, 200, 100), 30), (Block(0, 0, 90, 300), 45), (Block(5, 5, 20, 200), 50), (Block(0, 0, 9, 9), 50)],
)
def test_the_strips_cover_their_block(block: Block, strip: float) -> None:
    way = Lawnmower(block, strip)
    flown = [way.at(metre) for metre in range(math.ceil(way.length_m) + 1)]
    for x, y in flown:
        assert 0 <= x - block.west <= block.width
        assert 0 <= y - block.south <= block.height
    # The sensor sees a square as wide as a strip; places on the way are taken every metre.
    half = strip / 2 + 0.5
    for i in range(21):
        for j in range(21):
            x, y = block.west + block.width * i / 20, block.south + block.height * j / 20
            assert any(abs(x - fx) <= half and abs(y - fy) <= half for fx, fy in flown)


@given(st.floats(0, 5000), st.floats(0, 100))
def test_no_way_is_shorter_than_the_line(start: float, distance: float) -> None:
    for way in (Lawnmower(Block(-100, -50, 200, 100), 30), Perimeter(400, 300)):
        assert math.dist(way.at(start), way.at(start + distance)) <= distance + 1e-6


def test_a_drone_flies_back_the_way_it_came() -> None:
    way = Lawnmower(Block(0, 0, 100, 60), 20)
    assert way.length_m == 3 * 80 + 2 * 20
    assert way.at(0) == (10, 10)
    assert way.at(90) == (90, 20)
    assert way.at(100) == (90, 30)
    assert way.at(way.length_m) == (90, 50)
    assert way.at(way.length_m + 30) == way.at(way.length_m - 30)
    assert way.at(2 * way.length_m) == way.at(0)


def test_bases_are_spread_along_the_edge_and_drive_along_it() -> None:
    swarm = make_mobility(
        "survey", nodes=4, bases=4, range_m=100, arena_m=1, rng=Random(1), area_m=(200, 100), base_speed_m=5
    )
    assert swarm.positions == [(0, -50), (100, 0), (0, 50), (-100, 0)]
    for t in range(121):
        swarm.step(t)
        assert all(abs(x) == 100 or abs(y) == 50 for x, y in swarm.positions)
    # Once around the 600 m.
    assert swarm.positions == [(0, -50), (100, 0), (0, 50), (-100, 0)]


def survey(**keys: object) -> Scenario:
    return convert({"topology": "survey", "bases": 1, **keys}, Scenario, "test")


def test_drones_keep_their_speed_limits() -> None:
    scenario = survey(
        nodes=25, node={"step_s": 2.0},
        mobility={"area_m": [800, 600], "strip_m": 40, "speed_m_s": [4, 9], "base_speed_m_s": 3},
    )  # fmt: skip
    surroundings = Surroundings(scenario)
    flown = [0.0] * 25
    for _ in range(200):
        before = surroundings.positions
        surroundings.step()
        for node, (old, new) in enumerate(zip(before, surroundings.positions, strict=True)):
            moved = math.dist(old, new)
            assert moved <= 2.0 * (9 if node else 3) + 1e-9
            flown[node] = max(flown[node], moved)
            assert abs(new[0]) <= 400
            assert abs(new[1]) <= 300
    # On a straight strip a drone moves at its speed, and each has its own.
    assert min(flown[1:]) >= 2.0 * 4
    assert len({round(metres, 6) for metres in flown[1:]}) == 24


def test_neighbours_stay_in_range() -> None:
    # 6 x 4 blocks of 100 m x 100 m: drones of blocks side by side are at most 224 m apart.
    surroundings = Surroundings(survey(nodes=25, mobility={"area_m": [600, 400]}, radio={"range_m": 224}))
    for _ in range(300):
        surroundings.step()
        graph: RangeGraph = surroundings.graph
        for node in range(1, 25):
            column, row = (node - 1) % 6, (node - 1) // 6
            if column < 5:
                assert node + 1 in graph.neighbours[node]
            if row < 3:
                assert node + 6 in graph.neighbours[node]
        assert None not in graph.hops_from([0])


def test_the_seed_decides_where_and_how_fast_they_fly() -> None:
    def positions(seed: int) -> list[tuple[float, float]]:
        surroundings = Surroundings(survey(nodes=9, seed=seed, mobility={"area_m": [600, 400]}))
        for _ in range(20):
            surroundings.step()
        return surroundings.positions

    assert positions(1) == positions(1)
    assert positions(1) != positions(2)
