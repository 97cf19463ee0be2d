"""The oracle's ceiling: right by hand and by brute force, and in step with the mock swarm's order of events."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.lab.experiment.oracle import Ceiling, Contacts, Moment, is_due, parts, spread, survival
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.lab.swarm.world import World
from tests.extent import examples

SMALL = {"nodes": 16, "arena_m": 8, "steps": 30}


def ceiling(scenario: str, options: dict[str, Any]) -> tuple[World, dict[str, Any]]:
    """A run, and what the measure says of it."""
    world = World(load_scenario(scenario, options))
    measure = Ceiling()
    world.run(world.scenario.steps, after=measure.after)
    return world, measure.result()


# -- the dynamic program -----------------------------------------------------------------------------------------------


@st.composite
def moments(draw: st.DrawFn, *, moves: bool) -> list[Moment]:
    """Up to 4 nodes, node 0 the base. `moves`: up to 4 steps, all different; else one that is repeated."""
    nodes = draw(st.integers(2, 4))
    chances = st.lists(st.floats(0.05, 0.9), min_size=nodes, max_size=nodes)

    def moment() -> Moment:
        links = [(i, j) for i in range(nodes) for j in range(i) if draw(st.booleans())]
        near = [sorted({i + j - n for i, j in links if n in (i, j)}) for n in range(nodes)]
        if not moves:
            return Moment(near, draw(chances))
        some = st.sets(st.integers(1, nodes - 1))
        return Moment(near, draw(chances), off=draw(some), emptied=draw(some))

    return [moment() for _ in range(draw(st.integers(1, 4)))] if moves else [moment()]


def best_of_all_paths(moments: Sequence[Moment], t: int, node: int) -> float:
    """The same by trying all paths: at each step a strike, then the datum stays or goes one hop."""
    if node == 0 or t == len(moments):
        return 1.0
    moment = moments[t]
    if node in moment.emptied:
        return 0.0
    ways = [node]
    if node not in moment.off:
        ways += [other for other in moment.neighbours[node] if other not in moment.off]
    return (1 - moment.corruption[node]) * max(best_of_all_paths(moments, t + 1, way) for way in ways)


@given(moments(moves=True))
def test_it_is_the_best_of_all_paths(moments: list[Moment]) -> None:
    nodes = len(moments[0].corruption)
    table = survival(moments, nodes, 1)
    assert len(table) == len(moments) + 1
    for t, row in enumerate(table):
        for node in range(nodes):
            assert row[node] == pytest.approx(best_of_all_paths(moments, t, node))


def dijkstra(moment: Moment) -> list[float]:
    """exp(-shortest path to node 0), with the weight -log(1 - q_i) for each node that is left."""
    costs = [-math.log1p(-q) for q in moment.corruption]
    found: dict[int, float] = {}
    queue = [(0.0, 0)]
    while queue:
        cost, node = heapq.heappop(queue)
        if node not in found:
            found[node] = cost
            for other in moment.neighbours[node]:
                heapq.heappush(queue, (cost + costs[other], other))
    return [math.exp(-found[node]) if node in found else 0.0 for node in range(len(costs))]


@given(moments(moves=False))
def test_where_nothing_moves_and_the_end_is_far_it_is_dijkstra(moments: list[Moment]) -> None:
    # Who waits to the end keeps at most 0.95^400 of it: the end does not matter any more.
    table = survival(moments * 400, len(moments[0].corruption), 1)
    assert table[0] == pytest.approx(dijkstra(moments[0]), abs=1e-8)


def test_by_hand_with_a_drone_that_dies() -> None:
    """Base 0, drones 1 and 2 in a row; 1 dies in the third of four steps."""
    near = [[1], [0, 2], [1]]
    q = [0.0, 0.1, 0.5]
    before = Moment(near, q)
    table = survival([before, before, Moment(near, q, off={1}, emptied={1}), Moment(near, q, off={1})], 3, 1)
    assert [row[1] for row in table[:3]] == pytest.approx([0.9, 0.9, 0.0])
    # With two steps left 2's data get through 1; later they are better off with 2, which is struck at each step.
    assert [row[2] for row in table] == pytest.approx([0.5 * 0.9, 0.5**3, 0.5**2, 0.5, 1.0])


# -- with all contacts -------------------------------------------------------------------------------------------------


def test_the_parts_of_a_swarm() -> None:
    near = [[1], [0, 2], [1], [4], [3], []]
    assert sorted(parts(near, ())) == [0b000111, 0b011000, 0b100000]
    assert sorted(parts(near, {1})) == [0b000001, 0b000010, 0b000100, 0b011000, 0b100000]


def kept(moments: Sequence[Moment], node: int, draws: int = 20_000) -> float:
    """The share of data that are kept with all contacts."""
    swarm = [parts(moment.neighbours, moment.off) for moment in moments]
    rng = random.Random(1)
    return sum(spread(moments, 0, node, 1, swarm, rng) for _ in range(draws)) / draws


def test_copies_everywhere_by_hand() -> None:
    """Base 0; drones 1 and 2 are together at first, then apart, and then 1 meets the base."""
    q = [0.0, 0.4, 0.5]
    together: list[list[int]] = [[], [2], [1]]
    apart: list[list[int]] = [[], [], []]
    moments = [Moment(near, q) for near in (together, apart, [[1], [0], []])]
    # It is struck in the second and third step, and lost if both copies are.
    assert kept(moments, 1) == pytest.approx(1 - (1 - 0.6**2) * (1 - 0.5**2), abs=0.01)
    # If they stay together, one copy that is left becomes two again.
    moments = [Moment(together, q)] * 3
    assert kept(moments, 2) == pytest.approx((1 - 0.4 * 0.5) ** 2, abs=0.01)


def test_what_has_a_way_at_birth_is_never_struck() -> None:
    near = [[1], [0, 2], [1]]
    assert kept([Moment(near, [0.0, 1.0, 1.0])] * 3, 2, 10) == 1.0
    assert kept([Moment(near, [0.0, 1.0, 1.0], off={1})] * 3, 2, 10) == 0.0


def test_a_drone_that_dies_takes_its_copy_along() -> None:
    near = [[], [2], [1]]
    begin = Moment(near, [0.0, 0.0, 0.0])
    one, both = (Moment(near, [0.0, 0.0, 0.0], off=dead, emptied=dead) for dead in ({1}, {1, 2}))
    assert kept([begin, one], 1, 10) == 1.0
    assert kept([begin, both], 1, 10) == 0.0


@pytest.mark.no_cover
@pytest.mark.parametrize("topology", ["grid", "random-walk"])
def test_the_defaults_do_not_beat_all_contacts(topology: str) -> None:
    options = {**SMALL, "topology": topology, "radio.range_m": 2.5, "arena_m": 12}
    lost = least = 0.0
    for seed in range(4):
        world = World(load_scenario("demo", {**options, "seed": seed}))
        measure = Contacts()
        world.run(world.scenario.steps, after=measure.after)
        found = measure.result()
        assert found["data"] == world.ledger.created
        lost += sum(world.ledger.losses().values())
        least += found["data"] - found["kept"]
    assert lost >= least - 3 * math.sqrt(least + 1)


# -- in step with the mock swarm ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap_m", "kept_of_2"), [(0.1, 1), (5.0, 0)])
def test_strikes_and_links_are_those_of_the_same_step(gap_m: float, kept_of_2: int) -> None:
    """Every datum's fate is certain here, so the oracle and the swarm must agree exactly.

    Drone 2 stands on a source that strikes everything, and jumps away in step 20 only. What it made in step 19 is not
    struck in step 20, and moves on if the base is in range in step 20: with a small jump. Other data are struck before
    they can move, but for the last, which is made when the run ends.
    """
    steps = 30
    world, found = ceiling(
        "paper-grid",
        {
            "topology": "islands", "nodes": 3, "arena_m": 4, "steps": steps, "policy.name": "hop-count",
            "mobility.split_step": 20, "mobility.rejoin_step": 21, "mobility.gap_m": gap_m, "data.interval_steps": 1,
            "radiation.sources": [[1, -1, 1]], "radiation.decay": 1e12, "radiation.noise": 0,
        },
    )  # fmt: skip
    lost = world.ledger.losses()["corrupted"]
    assert lost == steps - 1 - kept_of_2
    assert found["data"] == world.ledger.created == 2 * steps
    assert found["kept"] == pytest.approx(found["data"] - lost, abs=1e-6)


@pytest.mark.no_cover
def test_a_line_loses_what_the_oracle_says() -> None:
    """There is one way only, and all data go on at once: the swarm does what the oracle would do."""
    steps, nodes = 400, 5
    world, found = ceiling(
        "paper-grid",
        {
            "topology": "line", "nodes": nodes, "arena_m": 12, "steps": steps, "seed": 3, "policy.name": "hop-count",
            "data.interval_steps": 1, "radiation.sources": [[-2, 1, 0.5], [2, -1, 0.6]], "radiation.noise": 0,
        },
    )  # fmt: skip
    kept = world.ledger.created - world.ledger.losses()["corrupted"]
    assert found["data"] == world.ledger.created == steps * (nodes - 1)
    # A datum made h hops away is struck h times, once at each drone on its way.
    corruption = Surroundings(world.scenario).corruption
    products = [math.prod(1 - q for q in corruption[1 : node + 1]) for node in range(1, nodes)]
    deviation = math.sqrt(steps * sum(p * (1 - p) for p in products))
    # The last few data are still on their way at the end.
    assert steps * sum(products) == pytest.approx(found["kept"], abs=nodes * nodes / 2)
    assert abs(kept - found["kept"]) < 3 * deviation
    # One strike less at the origin would show.
    less = steps * sum(p / (1 - corruption[node]) for node, p in enumerate(products, 1))
    assert abs(kept - less) > 10 * deviation


@pytest.mark.no_cover
@pytest.mark.parametrize("topology", ["random-walk", "lennard-jones", "islands"])
def test_it_is_the_same_for_all_policies_and_needs_no_agents(topology: str) -> None:
    scenario = "paper-grid" if topology == "islands" else f"paper-{topology}"
    options = {**SMALL, "topology": topology, "mobility.split_step": 10, "mobility.gap_m": 2.5, "seed": 4}
    found = {policy: ceiling(scenario, {**options, "policy.name": policy})[1] for policy in ("rass", "stigmergy")}
    assert found["rass"] == found["stigmergy"]
    alone = load_scenario(scenario, options)
    surroundings = Surroundings(alone)
    moments = []
    for _ in range(alone.steps):
        moments.append(Moment(surroundings.graph.neighbours, surroundings.corruption))
        surroundings.step()
    table = survival(moments, alone.nodes, alone.bases)
    data = [(t, node) for t in range(alone.steps) for node in range(1, alone.nodes) if is_due(alone.data, node, t)]
    assert found["rass"] == {"data": len(data), "kept": sum(table[t + 1][node] for t, node in data)}


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["rass", "hop-count", "survival"])
def test_no_policy_with_one_copy_is_better_on_average(policy: str) -> None:
    kept = expected = variance = 0.0
    for seed in range(6):
        world, found = ceiling("paper-random-walk", {**SMALL, "policy.name": policy, "seed": seed})
        kept += world.ledger.created - sum(world.ledger.losses().values())
        expected += found["kept"]
        variance += found["data"] / 4
    assert 0 < kept < expected + 3 * math.sqrt(variance)


@settings(max_examples=examples(15))
@given(st.integers(0, 12), st.sampled_from(["step-id", "step+id", "together"]), st.none() | st.integers(0, 20))
def test_data_are_due_when_the_swarm_makes_them(interval: int, due: str, until: int | None) -> None:
    options = {"nodes": 4, "arena_m": 4, "data.interval_steps": interval, "data.due": due, "data.until_step": until}
    world = World(load_scenario("paper-grid", options))
    world.run(24)
    made = {(step, id.origin) for id, step in world.ledger.born.items()}
    assert made == {(t, node) for t in range(24) for node in (1, 2, 3) if is_due(world.scenario.data, node, t)}


# -- with failures -----------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(3))
def test_what_dies_with_its_drone_the_oracle_cannot_save_either(seed: int) -> None:
    """All drones hear the base and die some time: lost is what they made in the step before, and nothing else."""
    world, found = ceiling(
        "paper-grid",
        {
            "nodes": 4, "arena_m": 4, "steps": 40, "seed": seed, "policy.name": "hop-count", "data.interval_steps": 1,
            "radiation.corruption": False, "failures.die_fraction": 1.0,
        },
    )  # fmt: skip
    assert world.ledger.losses()["died"] > 0
    assert found["data"] == world.ledger.created
    assert found["kept"] == world.ledger.created - world.ledger.losses()["died"]


@pytest.mark.no_cover
def test_with_failures_of_all_kinds_it_is_the_same_for_all_policies() -> None:
    options = {
        **SMALL, "failures.die_fraction": 0.2, "failures.wipe_rate": 0.02, "failures.reboot_rate": 0.03,
        "failures.reboot_steps": 3, "failures.base_off": [[8, 12]],
    }  # fmt: skip
    runs = [ceiling("paper-grid", {**options, "policy.name": policy}) for policy in ("rass", "stigmergy", "hop-count")]
    results = [found for _, found in runs]
    assert results[0] == results[1] == results[2]
    assert results[0]["data"] == runs[0][0].ledger.created
