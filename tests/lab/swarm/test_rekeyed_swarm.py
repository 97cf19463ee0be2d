"""Whole swarms that change their link key in flight: nothing is lost, whoever is out of range or off meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.mission import ground_of, keyring_of
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.trust.key_updates import KeyUpdates
from tests.keyed import keyed

#: Other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


class Rekeyed(World):
    """Some nodes are out of everybody's range for a time."""

    away: frozenset[int] = frozenset()

    @property
    def neighbours(self) -> Sequence[Sequence[int]]:
        away = self.away
        if not away:
            return super().neighbours
        return [
            [] if node in away else [other for other in others if other not in away]
            for node, others in enumerate(super().neighbours)
        ]


def swarm(name: str, *keys: str) -> Rekeyed:
    return Rekeyed(load_scenario(name, {}, ["keys=true", *keys]))


def key_updates(world: World, node_id: int) -> KeyUpdates:
    return keyed(world.agents[node_id]).signed.key_updates


def ground_changes(world: World, number: int, revoked: frozenset[int] = frozenset(), base: int = 0) -> None:
    ground = replace(ground_of(world.scenario), number=number, revoked=revoked)
    key_updates(world, base).renew(keyring_of(ground, base))


def numbers(world: World) -> dict[int, int]:
    """How many nodes have each link key."""
    counts: dict[int, int] = {}
    for node_id in range(len(world.agents)):
        number = key_updates(world, node_id).link.number
        counts[number] = counts.get(number, 0) + 1
    return counts


def test_a_grid_changes_its_key_twice_and_some_are_out_of_range_for_both() -> None:
    world = swarm("hostile", "hostile=[]", "data.until_step=130")
    world.run(30, after=check)
    world.away = frozenset({7, 18, 24})
    world.run(10, after=check)
    ground_changes(world, 2)
    world.run(30, after=check)
    assert numbers(world) == {1: 3, 2: 22}
    ground_changes(world, 3)
    world.run(30, after=check)
    assert numbers(world) == {1: 3, 3: 22}
    world.away = frozenset()
    world.run(30, after=check)
    assert numbers(world) == {3: 25}
    world.run(40, after=check)
    summary = world.statistics.summary()
    assert summary["delivered"] == summary["created"] == 24 * 13
    assert sum(summary["lost"].values()) == 0


def test_a_change_amid_losses_and_restarts_loses_nothing() -> None:
    """Nodes are off for some steps, and come back with what is on their disks: store and key updates."""
    world = swarm(
        "hostile", "hostile=[]", "data.until_step=70", "radio.loss=0.1", "radio.duplicate=0.1", "radio.reorder=0.1",
        "failures.reboot_rate=0.005", "failures.reboot_steps=5",
    )  # fmt: skip
    world.run(30, after=check)
    ground_changes(world, 2)
    world.run(120, after=check)
    assert numbers(world) == {2: 25}
    summary = world.statistics.summary()
    assert summary["delivered"] == summary["created"]
    assert summary["created"] > 150


@pytest.mark.parametrize("revoked", [12, pytest.param(24, marks=pytest.mark.soak)])
def test_a_revoked_drone_takes_only_what_it_has(revoked: int) -> None:
    """In the middle of the grid, and at its edge. What it created until then and had handed on is safe."""
    world = swarm("hostile", "hostile=[]", "data.until_step=80")
    world.run(40, after=check)
    ground_changes(world, 2, frozenset({revoked}))
    world.run(100, after=check)
    assert numbers(world) == {1: 1, 2: 24}
    assert key_updates(world, revoked).revoked
    assert all(key_updates(world, node_id).is_revoked(revoked, 1) for node_id in range(25) if node_id != revoked)
    held = set(world.stores[revoked].ids())
    arrived = {id for base in range(world.scenario.bases) for id in world.stores[base].ids()}
    made = {id for store in world.stores for id in store.ids()}
    missing = made - arrived
    assert {id.origin for id in missing} <= {revoked}
    assert missing <= held
    # Nobody has it as a neighbour.
    for node_id, agent in enumerate(world.agents):
        assert node_id == revoked or revoked not in agent.node.routing.neighbours


def test_the_same_seed_changes_the_key_in_the_same_way() -> None:
    hashes = []
    for _ in range(2):
        world = swarm("hostile", "hostile=[]", "nodes=16")
        world.run(20)
        ground_changes(world, 2)
        world.run(20)
        hashes.append(world.air.tally.sha256)
    assert hashes[0] == hashes[1]
