"""Crowds, and beacons that somebody has made up: each is said once, and the swarm must be over it soon."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from itertools import product

import pytest

from rass_mav.core.messages import BEACON_BASE, BEACON_WANTED, Beacon
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.core.routes.announcements import JUMP_TURNS
from rass_mav.core.routes.neighbours import CREDIT
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

#: As far ahead as to be newer than all that the base says for hours.
AHEAD = 30000


def world(positions: list[tuple[float, float]], *flags: str) -> World:
    """The product's own defaults, without radiation. Node 0 is the base."""
    return World(
        load_scenario(
            "demo",
            {},
            [
                f"nodes={len(positions)}",
                "topology=positions",
                f"mobility.positions={json.dumps(positions)}",
                "radiation.sources=[]",
                "store.capacity_items=500",
                *flags,
            ],
        )
    )


def grid(side: int) -> list[tuple[float, float]]:
    return [(2.0 * x, 2.0 * y) for y in range(side) for x in range(side)]


def say(swarm: World, beacon: Beacon, hearers: Iterable[int]) -> None:
    """Somebody says this once, after the present step."""
    for hearer in hearers:
        swarm.agents[hearer].node.receive(beacon, (swarm.t - 1) * swarm.step_s)


def forged(swarm: World, *, number: int, life: int | None = None, turn: int = 0) -> Beacon:
    """A beacon in the base's name."""
    node = swarm.agents[0].node
    life = node.store.life if life is None else life
    return Beacon(
        node.id, life, 5, BEACON_BASE, node.id, life, number & 0xFFFF, 0, 0, 0, 0, 0xFFFF, node.policy.tag,
        POTENTIAL_BASE, 0, turn,
    )  # fmt: skip


@pytest.mark.parametrize("policy", ["survival", "hop-count", "rass"])
def test_a_crowd_behind_one_gateway_finds_it(policy: str) -> None:
    """Thirty nodes hear each other and the gateway, and a table has room for twenty."""
    ring = [(4.6 + 0.6 * math.cos(0.2 * i), 0.6 * math.sin(0.2 * i)) for i in range(30)]
    swarm = world(
        [(0.0, 0.0), (2.8, 0.0), *ring], f"policy.name={policy}", "routing.max_neighbours=20", "data.until_step=40"
    )
    swarm.run(80, after=check)
    assert len(swarm.ledger.arrived) == swarm.ledger.created > 100


@pytest.mark.parametrize("policy", ["survival", "hop-count", "rass"])
def test_names_that_are_heard_once_cost_nothing_that_lasts(policy: str) -> None:
    swarm = world(grid(4), f"policy.name={policy}", "data.until_step=100")
    swarm.run(20)
    around = [set(agent.node.routing.neighbours) for agent in swarm.agents]
    tag = swarm.agents[0].node.policy.tag
    for id in range(1000, 1128):
        made_up = Beacon(id, id, 7, 0, 0, 0, 0, 255, 0, 0, 0, 50, tag, POTENTIAL_BASE - 2, 0, 0xFFFF)
        say(swarm, made_up, range(16))
    assert all(len(agent.node.routing.neighbours) <= 64 for agent in swarm.agents)
    swarm.run(5)
    assert [set(agent.node.routing.neighbours) for agent in swarm.agents] == around
    for agent in swarm.agents:
        assert agent.node.routing.longest_s == agent.node.routing.lifetime_s
    swarm.run(125, after=check)
    assert len(swarm.ledger.arrived) == swarm.ledger.created >= 150


def test_also_a_name_that_is_heard_again_and_again_stretches_no_wait() -> None:
    swarm = world(grid(2))
    swarm.run(5)
    for number in range(3):
        say(swarm, Beacon(1000, 7, number, 0, 0, 0, 0, 255, 0, 0, 0, 50, 0, 0, 0, 0xFFFF), [1])
    swarm.run(1)
    routing = swarm.agents[1].node.routing
    steps = routing.lifetime_s / routing.step_s
    assert routing.longest_s <= steps * CREDIT * routing.step_s


#: Who hears the forged beacon: everybody, those at the base, those far away from it, somebody in between.
HEARERS = {"all": range(1, 36), "near": (1, 6, 7), "far": (34, 35, 29, 28), "middle": (14,)}


def forgeries() -> Iterator[pytest.ParameterSet]:
    """Each lie, each place and each policy with each other; the suite takes each lie, place and policy."""
    for (i, what), (j, policy) in product(
        enumerate(["ahead", "other-life", "slow", "half"]), enumerate(["survival", "hop-count", "rass"])
    ):
        for k, where in enumerate(HEARERS):
            soak = [] if k == i and j == i % 3 else [pytest.mark.soak]
            yield pytest.param(what, where, policy, marks=soak)


@pytest.mark.parametrize(("what", "where", "policy"), list(forgeries()))
def test_one_beacon_in_the_name_of_the_base_ends_nothing(what: str, where: str, policy: str) -> None:
    swarm = world(grid(6), f"policy.name={policy}", "data.until_step=60")
    swarm.run(20)
    base = swarm.agents[0].node
    number = base.routing.number + (0x7FFF if what == "half" else AHEAD)
    beacon = forged(
        swarm,
        number=number,
        life=base.store.life ^ 1 if what == "other-life" else None,
        turn=0xFFFF if what == "slow" else 0,
    )
    say(swarm, beacon, HEARERS[where])
    # A request and its answer have ten hops to go. Nearly half the circle is two jumps.
    swarm.run(JUMP_TURNS + 30 if what == "half" else 30)
    assert all(agent.node.routing.route is not None for agent in swarm.agents)
    lives = {agent.node.routing.route.base_life for agent in swarm.agents if agent.node.routing.route is not None}
    assert lives == {base.store.life}
    swarm.run(40)
    assert len(swarm.ledger.arrived) == swarm.ledger.created > 200


def test_who_asks_for_numbers_all_the_time_does_not_cut_anybody_off() -> None:
    swarm = world(grid(4), "policy.name=survival", "data.until_step=100")
    for _ in range(130):
        swarm.run(1)
        wanted = (swarm.agents[0].node.routing.number + 0x7FFF) & 0xFFFF
        say(swarm, Beacon(999, 9, swarm.t, BEACON_WANTED, 0, 0, 0, 255, 0, wanted, 0, 0, 0, 0, 0), [0])
    assert swarm.loops == 0
    assert len(swarm.ledger.arrived) == swarm.ledger.created >= 150
