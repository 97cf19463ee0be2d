"""Robots that die, reboot, are wiped or land: what is lost by it, and what is not."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import NO_ROUTE
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.world import World
from tests.extent import examples, extents
from tests.nodes import node_of
from tests.some import some

from .worlds import scenario, world_of

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

#: Failures are possible, but none comes by itself: tests call `crash`.
BY_HAND = {"base_off": [[10**6, 10**6 + 1]]}
QUIET = {"sources": [], "noise": 0.0}


def line(nodes: int = 4, **keys: Any) -> World:
    """Base 0, then a line of drones that make no data by themselves; routes are known, the first reboots are over."""
    sections: dict[str, Any] = {
        "policy": {"name": "hop-count"}, "radiation": QUIET, "data": {"interval_steps": 0}, "failures": BY_HAND,
        "node": {"forward": "step", "phases": "lockstep"}, "custody": {"replicas": False}, **keys,
    }  # fmt: skip
    world = world_of(nodes=nodes, topology="line", **sections)
    world.run(10, after=check)
    return world


def put(world: World, node_id: int) -> DatumId:
    return world.agents[node_id].node.put(b"a measurement", world.t * world.step_s)


def lost(world: World) -> dict[str, int]:
    return {fate: count for fate, count in world.ledger.losses().items() if count}


def test_a_reboot_costs_memory_and_time_but_no_datum() -> None:
    world = line()
    far, own = put(world, 3), put(world, 2)
    world.crash(2, world.t + 5)
    node = world.agents[2].node
    assert list(node.holdings.custody) == [own]
    assert node.routing.route is None
    assert not node.routing.neighbours
    world.run(5, after=check)
    assert world.ledger.held == 2
    # Back on, it hears its neighbours, but takes no route until nobody can remember its old ones.
    world.run(5, after=check)
    assert set(node.routing.neighbours) == {1, 3}
    assert node.routing.hops == NO_ROUTE
    world.run(20, after=check)
    assert node.routing.hops == 2
    assert set(world.ledger.arrived) == {far, own}
    assert lost(world) == {}


def test_with_a_drone_dies_what_nobody_else_has() -> None:
    world = line()
    delivered = put(world, 1)
    world.run(2, after=check)
    alone, elsewhere = put(world, 2), put(world, 3)
    world.crash(2, None)
    check(world)
    assert world.ledger.lost == {alone: Fate.DIED}
    world.run(30, after=check)
    summary = world.statistics.summary()
    assert summary["created"] == 3
    assert list(world.ledger.arrived) == [delivered]
    assert (summary["held"], lost(world)) == (1, {"died": 1})
    assert summary["reliability"] == pytest.approx(2 / 3, abs=1e-6)
    # Node 3 has lost its only neighbour: the dead one is as good as gone.
    assert list(world.agents[3].node.holdings.custody) == [elsewhere]
    assert not world.agents[3].node.routing.neighbours


def test_a_wiped_drone_begins_anew() -> None:
    world = line()
    before = put(world, 2)
    world.crash(2, world.t + 3, wiped=True)
    assert lost(world) == {"died": 1}
    world.run(4, after=check)
    after = put(world, 2)
    assert after.sequence == before.sequence == 0
    assert after.epoch != before.epoch
    world.run(20, after=check)
    assert list(world.ledger.arrived) == [after]
    assert lost(world) == {"died": 1}


def test_a_copy_elsewhere_outlives_a_dead_drone() -> None:
    world = line()
    id = put(world, 3)
    # Node 2 has taken it over, and its word is lost on the way back.
    datum = some(world.stores[3].get(id))
    assert node_of(world.agents[2]).custody_store.take_custody(3, 77, datum)
    assert world.ledger.copies == {id: 2}
    world.crash(3, None)
    assert lost(world) == {}
    world.run(5, after=check)
    assert list(world.ledger.arrived) == [id]


def test_a_datum_that_was_in_the_air_when_its_drone_died_is_held_again() -> None:
    world = line(3, radio={"latency_steps": 3}, routing={"neighbour_steps": 6})
    world.run(20, after=check)
    id = put(world, 2)
    world.run(1, after=check)
    world.crash(2, None)
    assert lost(world) == {"died": 1}
    world.run(4, after=check)
    assert lost(world) == {}
    assert list(world.agents[1].node.holdings.custody) == [id]
    world.run(6, after=check)
    assert list(world.ledger.arrived) == [id]


def test_delivered_data_stay_delivered_when_bases_are_wiped() -> None:
    for wiped in (False, True):
        failures = {"base_off": [[20, 35]], "base_wiped": wiped}
        world = line(failures=failures, data={"interval_steps": 5})
        epoch = world.stores[0].epoch
        world.run(10, after=check)
        arrived = set(world.ledger.arrived)
        assert len(arrived) >= 5
        world.run(15, after=check)
        # Nothing came in meanwhile, nobody has a route any more, and nothing is lost.
        assert set(world.ledger.arrived) == arrived
        assert [agent.node.routing.hops for agent in world.agents[1:]] == [NO_ROUTE] * 3
        world.run(40, after=check)
        assert (world.stores[0].epoch != epoch) == wiped
        assert [agent.node.routing.hops for agent in world.agents] == [0, 1, 2, 3]
        assert set(world.ledger.arrived) > arrived
        assert sum(lost(world).values()) == 0
        assert arrived.isdisjoint(world.stores[0].ids()) == wiped
        summary = world.statistics.summary()
        assert summary["delivered"] + summary["held"] == summary["created"] == 3 * 15


def test_who_is_off_says_hears_and_makes_nothing() -> None:
    said: list[tuple[int, int]] = []
    world = World(
        scenario(nodes=9, radiation=QUIET, data={"interval_steps": 3}, failures=BY_HAND),
        # A frame's sixth byte is the system id.
        record=lambda frame, step: said.append((frame[5] - 1, step)),
    )
    world.run(10)
    world.crash(4, 25)
    heard = world.agents[4].peers.received
    world.run(15, after=check)
    assert not [step for node, step in said if node == 4 and step >= 10]
    assert world.agents[4].peers.received == heard == 0
    assert world.agents[4].telemetry.reading is None
    world.run(5, after=check)
    assert {step for node, step in said if node == 4 and step >= 10} == set(range(25, 30))
    # When it is back its data are due in the same steps as ever.
    born = sorted(step for id, step in world.ledger.born.items() if id.origin == 4)
    assert born == [step for step in [*range(10), *range(25, 30)] if (step - 4) % 3 == 0]
    # What it counted in its first life still counts.
    heard_in_all = sum(agent.peers.received for agent in world.agents)
    assert world.statistics.summary()["frames"]["received"] > heard_in_all


def test_stored_data_are_struck_while_the_drone_is_off_and_found_after() -> None:
    certain = {"sources": [[0, 0, 1.0]], "decay": 0.0, "noise": 0.0}
    world = line(radiation=certain)
    id = put(world, 2)
    world.crash(2, world.t + 4)
    world.run(4, after=check)
    struck = some(world.stores[2].get(id))
    assert not struck.intact
    assert (world.ledger.held, lost(world)) == (1, {})
    world.run(1, after=check)
    assert (world.ledger.held, lost(world)) == (0, {"corrupted": 1})


def test_a_reboot_brings_back_what_was_removed_but_not_yet_on_the_disk() -> None:
    world = line()
    id = put(world, 2)
    world.run(1, after=check)
    assert world.ledger.copies == {id: 1}
    world.crash(2, world.t)
    check(world)
    # Custody was passed on, but the removal waited for the next commit: a replica, and the base counts it once.
    assert world.ledger.copies == {id: 2}
    world.run(30, after=check)
    assert list(world.ledger.arrived) == [id]
    assert (world.ledger.held, lost(world)) == (0, {})


def test_a_datum_is_lost_for_the_reason_that_took_its_custodian() -> None:
    world = line(3)
    id = put(world, 2)
    datum = some(world.stores[2].get(id))
    node_of(world.agents[1]).custody_store.take_custody(2, 77, datum)
    world.crash(1, None)
    # The sender hears late that the datum was taken over, and lets go of its copy.
    custodian = node_of(world.agents[2])
    custodian.custody_store.drop(custodian.holdings.custody[id], Fate.PASSED_ON)
    assert lost(world) == {"died": 1}


@pytest.mark.parametrize("nodes", extents(25, 100))
def test_with_custody_nothing_vanishes_however_many_answers_are_lost(nodes: int) -> None:
    custody = {"replicas": False}
    world = world_of(nodes=nodes, steps=4 * nodes, seed=2, radio={"loss": 0.3}, custody=custody)
    world.run(4 * nodes, after=check)
    summary = world.statistics.summary()
    assert summary["lost"]["corrupted"] > 0
    assert summary["lost"]["vanished"] == 0


@settings(max_examples=examples(4, 400), suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10**6), loss=st.sampled_from([0.0, 0.2]), bases=st.integers(1, 2), mirror=st.booleans()
)  # fmt: skip
def test_reboots_landings_and_bases_that_are_off_cost_no_datum(
    seed: int, loss: float, bases: int, mirror: bool
) -> None:
    world = world_of(
            nodes=16,
            bases=bases,
            seed=seed,
            steps=160,
            radio={"loss": loss, "reorder": loss},
            radiation={"sources": []},
            custody={"replicas": mirror},
            failures={
                "reboot_rate": 0.02, "reboot_steps": 4, "battery_steps": [20, 60], "recharge_steps": 6,
                "base_off": [[20, 40]],
            },
            data={"until_step": 60},
            store={"capacity_items": 1000},
        )  # fmt: skip
    world.run(60, after=check)
    counts = world.statistics.summary()["failures"]
    assert counts["rebooted"] > 0
    assert counts["landed"] > 0
    # From now on nothing fails any more.
    world.failures = None
    world.run(100, after=check)
    summary = world.statistics.summary()
    assert lost(world) == {}
    assert summary["delivered"] == summary["created"] > 0


def test_a_crash_out_of_season_is_our_bug() -> None:
    world = line()
    with pytest.raises(ValueError, match="cannot be off from step 10 to 9"):
        world.crash(1, 9)
    durable = world_of(nodes=4)
    with pytest.raises(ValueError, match="cannot be off"):
        durable.crash(1, 5)
