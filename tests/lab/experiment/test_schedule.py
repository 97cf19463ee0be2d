"""The oracle for which airtime counts: by hand, against what bounds it, and against the swarm itself."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.lab.experiment.oracle import Contacts, Moment
from rass_mav.lab.experiment.schedule import Air, Schedule
from rass_mav.lab.medium.capacity import hand_over_s
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import examples

SMALL = {"nodes": 25, "steps": 60, "data.until_step": 50, "radio.preset": "wifi-1m", "topology": "random-walk"}


def plan(moments: list[Moment], due: list[tuple[int, int]], hop_s: float = 0.0) -> dict[str, Any]:
    """For steps of a second; node 0 is the base."""
    schedule = Schedule()
    schedule._moments, schedule._due = moments, due
    schedule._nodes, schedule._bases = len(moments[0].neighbours), 1
    schedule._hop_s, schedule._step_s = hop_s, 1.0
    return schedule.result()


LINE = [[1], [0, 2], [1, 3], [2]]
APART: list[list[int]] = [[], [2], [1], []]


def test_what_has_a_way_is_delivered_at_once_over_the_fewest_hops() -> None:
    found = plan([Moment(LINE, [0.0, 1.0, 1.0, 1.0])], [(0, 3), (0, 1)])
    assert found == {"data": 2, "kept": 2, "delivered": 2, "sent": 4, "busiest": 0.0}


def test_without_a_way_a_datum_rests_where_it_is_safest() -> None:
    moments = [Moment(APART, [0.0, 0.5, 0.1, 0.5])] * 2 + [Moment(LINE, [0.0, 0.5, 0.1, 0.5])]
    found = plan(moments, [(0, 1)] * 4000)
    # At 2, which is struck at the beginning of the second and of the third step.
    assert found["delivered"] == found["kept"] == pytest.approx(4000 * 0.9**2, abs=100)
    assert found["sent"] == 4000 + 2 * found["delivered"]


def test_copies_rest_at_all_nodes_that_are_about_as_safe() -> None:
    moments = [Moment(APART, [0.0, 0.1, 0.15, 0.5])] * 2
    found = plan(moments, [(0, 1)] * 4000)
    assert found["kept"] == pytest.approx(4000 * (1 - 0.1 * 0.15), abs=40)
    assert found["sent"] == pytest.approx(4000 * (1 + 0.1 + 0.15), rel=0.05), "a struck copy is made anew"


def test_it_knows_whom_a_drone_will_meet_and_which_dies() -> None:
    meets: list[list[int]] = [[1], [0], [], []]
    safe = [0.0] * 4
    assert plan([Moment(APART, safe), Moment(meets, safe)], [(0, 2)])["delivered"] == 1
    dies = Moment(APART, safe, off={1}, emptied={1})
    found = plan([Moment(APART, safe), dies], [(0, 1)])
    assert (found["kept"], found["delivered"]) == (1, 0)


def test_what_finds_no_airtime_waits() -> None:
    """A hand-over takes 50 ms from both nodes and from all in their range."""
    moments = [Moment(LINE, [0.0] * 4)] * 3
    found = plan(moments, [(0, 3)] * 7, hop_s=0.05)
    assert found["delivered"] == 7
    assert found["busiest"] <= 1.0
    assert plan(moments[:1], [(0, 3)] * 7, hop_s=0.05)["delivered"] < 7


@given(st.integers(0, 1 << 30), st.floats(0.001, 0.1))
@settings(max_examples=examples(60), deadline=None)
def test_the_hops_of_a_step_can_be_put_in_a_row(seed: int, hop_s: float) -> None:
    """Greedily, each after those before it that it disturbs: none ends after the step."""
    rng = random.Random(seed)
    nodes = range(12)
    near: list[list[int]] = [[] for _ in nodes]
    for a in nodes:
        for b in range(a):
            if rng.random() < 0.25:
                near[a].append(b)
                near[b].append(a)
    air, ends = Air(near, hop_s, 1.0), list[tuple[int, int, float]]()
    for _ in range(60):
        before = air.ways(rng.randrange(12))
        end = rng.choice(list(before))
        node = end
        while before[node] != node:
            a, b = before[node], node
            touched = {a, b, *near[a], *near[b]}
            # Slots are as long as a hop: the first that no hop takes which disturbs this one or is disturbed by it.
            taken = {slot for c, d, slot in ends if c in touched or d in touched or {a, b} & {*near[c], *near[d]}}
            slot = next(slot for slot in range(1000) if slot not in taken)
            ends.append((a, b, slot))
            node = a
        air.take(before, end)
    assert all((slot + 1) * hop_s <= 1.0 + 1e-9 for *_, slot in ends)


@pytest.mark.no_cover
def test_the_defaults_do_not_beat_it_and_it_does_not_beat_all_contacts() -> None:
    kept = delivered = 0.0
    for seed in range(3):
        world = World(load_scenario("demo", {**SMALL, "seed": seed}))
        schedule, contacts = Schedule(), Contacts()
        for _ in range(world.scenario.steps):
            world.step()
            schedule.after(world)
            contacts.after(world)
        found, most = schedule.result(), contacts.result()
        assert found["data"] == world.ledger.created
        assert 0.0 < found["busiest"] < 1.0
        assert found["kept"] <= most["kept"] + 3 * (most["data"] - most["kept"] + 1) ** 0.5
        kept += found["kept"] / found["data"]
        delivered += found["delivered"] / found["data"] - world.statistics.summary()["delivered_share"]
    assert kept / 3 > 0.98
    assert delivered / 3 > -0.01


def test_a_hand_over_takes_a_frame_and_an_answer() -> None:
    radio = load_scenario("demo", SMALL).radio
    # Two preambles, headers and gaps at least.
    assert 2 * (192e-6 + 8 * 64 / 1e6 + 50e-6) < hand_over_s(radio, 20) < 5e-3
