"""Whole swarms over real stores on simulated disks: power cuts at any moment of a commit, and disks that fail."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.datum import DatumId, Fate
from rass_mav.lab.disk.power import CutMoment, Power
from rass_mav.lab.ledger import InvariantError
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario, load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import extents
from tests.some import some

#: No power goes by itself.
BY_HAND = "disk.cut_rate=0"


class Ungated(CommitGate):
    """Lets everything leave before it is on disk."""

    __slots__ = ()

    def say(self, frames: Sequence[Outgoing]) -> Sequence[Outgoing]:
        return frames


class UngatedWorld(World):
    make_gate = Ungated


def scenario(*assignments: str, **options: Any) -> Scenario:
    return load_scenario("power-cuts", options, assignments)


@contextmanager
def disks(world: World) -> Iterator[Power]:
    assert world.power is not None
    try:
        yield world.power
    finally:
        world.power.close()


def lost(world: World) -> dict[str, int]:
    return {fate: count for fate, count in world.ledger.losses().items() if count}


def assert_survived(world: World, power: Power) -> None:
    """After a cut of all nodes at once, what has not arrived is intact on a disk."""
    found: dict[DatumId, bytes] = {}
    for computer in power.computers:
        computer.disk.error_rate = 0.0
        computer.disk.read_only = computer.disk.full = False
        computer.shut_down()
        store = computer.open()
        for id in store.ids():
            datum = some(store.get(id))
            assert datum.intact
            found[id] = datum.payload
    assert set(world.ledger.arrived) <= set(found)
    assert set(world.ledger.born) - set(world.ledger.lost) <= set(found)
    assert all(found[id] == payload for id, payload in world.ledger.payloads.items() if id in found)


# -- power cuts --------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("cuts", extents(50, 1000))
def test_no_datum_is_lost_that_was_on_disk_by_many_power_cuts(cuts: int) -> None:
    steps = 9 * cuts // 2
    world = World(scenario(steps=steps))
    with disks(world) as power:
        world.run(steps, after=check)
        summary = world.statistics.summary()
        assert summary["power"]["cuts"] >= cuts
        assert min(summary["power"][moment.value] for moment in CutMoment) > cuts // 10
        assert summary["power"]["restarts"] == summary["power"]["set_aside"] == summary["altered"] == 0
        assert lost(world) == {}
        assert summary["delivered"] > 0.9 * summary["created"] > 5 * cuts
        assert_survived(world, power)


@pytest.mark.no_cover
def test_without_the_gate_the_same_run_finds_losses() -> None:
    world = UngatedWorld(scenario(steps=600))
    with disks(world) as power:
        while world.t < 600 and lost(world).get("unfounded", 0) <= 1:
            world.run(20)
        assert lost(world)["unfounded"] > 1
        assert power.figures()["cuts"] > 0


@pytest.mark.no_cover
def test_without_the_gate_the_check_fails() -> None:
    world = UngatedWorld(scenario(steps=900))
    with disks(world), pytest.raises(InvariantError, match="data that a disk had are lost"):
        world.run(900, after=check)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    "assignments",
    [
        ["custody.replicas=true"],
        ["custody.replicas=true", "policy.name=rass", "topology=random-walk", "arena_m=4"],
        ["data.bytes=400"],
        ["custody.mode=none", "node.forward=immediate"],
        ["policy.name=stigmergy", "store.capacity_items=500"],
        ["disk.commit_steps=2"],
        ["disk.error_rate=0.01", "disk.commit_steps=1", "disk.full=[[40, 60]]", "disk.read_only=[[80, 100]]"],
        ["failures.reboot_rate=0.02", "failures.wipe_rate=0.01"],
    ],
)
@pytest.mark.parametrize("steps", extents(70, 900))
def test_the_promises_hold_in_other_swarms_too(steps: int, assignments: list[str]) -> None:
    world = World(scenario(*assignments, steps=steps))
    with disks(world) as power:
        world.run(steps, after=check)
        assert power.figures()["cuts"] > steps // 10
        assert len(world.ledger.arrived) > 20
        assert_survived(world, power)


@pytest.mark.parametrize("moment", CutMoment)
def test_a_datum_is_created_when_its_commit_is_done(moment: CutMoment) -> None:
    world = World(scenario(BY_HAND, "data.interval_steps=0", "radio.loss=1"))
    with disks(world) as power:
        world.run(20, after=check)
        computer = power.computers[4]
        id = world.agents[4].node.put(b"a measurement", world.t * world.step_s)
        assert world.ledger.created == 0
        computer.moment = moment
        if moment is CutMoment.QUIET:
            # As the swarm does it before the node's turn.
            world.fail(4, None)
        world.run(1, after=check)
        assert list(world.off) == [4]
        # Not even if the disk has it: nobody knows.
        assert world.ledger.created == 0
        world.run(3, after=check)
        assert not world.off
        # The other moments are certain.
        written = bool(world.ledger.created) if moment is CutMoment.DURING else moment is CutMoment.AFTER
        assert list(world.ledger.copies) == list(world.agents[4].node.holdings) == ([id] if written else [])
        assert world.ledger.created == written
        # A number that the disk does not know is given again.
        assert world.agents[4].node.put(b"another", world.t * world.step_s).sequence == written


def test_a_datum_goes_with_a_wiped_disk_and_with_a_dead_drone() -> None:
    world = World(scenario(BY_HAND, "failures.reboot_rate=1e-12", "data.interval_steps=0", "radio.loss=1"))
    with disks(world):
        ids = [world.agents[node].node.put(b"a measurement", 0.0) for node in (2, 4, 6, 8)]
        world.run(2, after=check)
        epoch = world.stores[2].epoch
        world.crash(2, world.t + 2, wiped=True)
        world.crash(4, None)
        world.crash(6, world.t)
        assert world.ledger.lost == {ids[0]: Fate.DIED, ids[1]: Fate.DIED}
        world.run(10, after=check)
        assert world.off == {4: None}
        assert world.stores[2].epoch != epoch
        assert set(world.ledger.copies) == set(ids[2:])
        assert [list(world.agents[node].node.holdings) for node in (2, 6)] == [[], [ids[2]]]


# -- disks that fail ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["full", "read_only"])
def test_while_disks_cannot_be_written_no_custody_passes_and_afterwards_all_arrives(key: str) -> None:
    world = World(scenario(BY_HAND, f"disk.{key}=[[40, 80]]", "data.until_step=75", "store.capacity_items=50"))
    with disks(world) as power:
        world.run(41, after=check)
        created, arrived = world.ledger.created, len(world.ledger.arrived)
        assert created >= arrived > 30
        world.run(39, after=check)
        # Data are made and kept in memory. What they rest on is not on disk, so nobody else has heard of them.
        assert (world.ledger.created, len(world.ledger.arrived)) == (created, arrived)
        assert all(not store.accepting for store in world.stores[1:])
        assert all(gate.failures > 10 for gate in world.gates[1:])
        world.run(70, after=check)
        assert len(world.ledger.arrived) == world.ledger.created > created + 30
        assert lost(world) == {}
        assert power.figures()["restarts"] == 0


@pytest.mark.no_cover
def test_over_slow_disks_frames_wait_for_the_commit() -> None:
    delays = []
    for steps in (0, 3):
        world = World(scenario(BY_HAND, f"disk.commit_steps={steps}", "data.until_step=100", steps=200))
        with disks(world):
            world.run(200, after=check)
            summary = world.statistics.summary()
            assert summary["delivered"] == summary["created"] > 120
            assert all(gate.dropped == 0 for gate in world.gates)
            delays.append(summary["delay_steps"]["mean"])
    # A datum is committed where it is made, and at each hop.
    assert delays[1] > delays[0] + 3


@pytest.mark.no_cover
@pytest.mark.parametrize("runs", extents(5, 18))
def test_flipped_bits_cost_data_and_stores_and_nothing_else(runs: int) -> None:
    set_aside = died = created = 0
    for seed in range(runs):
        world = World(scenario("disk.flip_rate=0.5", "disk.error_rate=0.005", seed=seed, steps=120))
        with disks(world) as power:
            world.run(120, after=check)
            figures = power.figures()
            set_aside += figures["set_aside"]
            died += lost(world).get("died", 0)
            created += world.ledger.created
            assert len(world.ledger.arrived) > 20
    assert set_aside > 10 * runs
    # What can still be read is salvaged, and there are replicas.
    assert died < 0.05 * created


def test_a_synced_datum_that_is_gone_without_a_flip_is_our_bug() -> None:
    world = World(scenario(BY_HAND))
    with disks(world) as power:
        world.run(10, after=check)
        computer = next(computer for computer in power.computers[1:] if computer.diary.stored)
        computer.shut_down()
        (computer.disk.directory / "node.db-wal").unlink()
        with pytest.raises(InvariantError, match="no bit flipped, but its store is damaged"):
            computer.open()


# -- the command -------------------------------------------------------------------------------------------------------
