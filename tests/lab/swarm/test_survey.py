"""Survey patterns: they cover the area, at the speeds that were set, and neighbours stay in range."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.config.loading import convert
from rass_mav.lab.medium.neighbours import RangeGraph
from rass_mav.lab.swarm.mobility import Block, Lawnmower, Perimeter, blocks, make_mobility
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.surroundings import Surroundings

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
