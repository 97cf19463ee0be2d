"""Whole swarms in virtual time, with the invariants checked in full after every step."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from rass_mav.core.messages import NO_ROUTE
from rass_mav.lab.hostile.kinds import KINDS
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.statistics import count_loops
from rass_mav.lab.swarm.world import World
from tests.extent import examples

from .worlds import in_a_process, run, summary_of, world_of

#: One of each kind, captured drones.
ATTACKERS = json.dumps(
    [{"kind": kind, "near": 4, "begin": 2, "captured": True} for kind in KINDS], separators=(",", ":")
)  # fmt: skip
CONNECTED = ["grid", "scale-free", "lennard-jones", "random-walk", "line"]


@pytest.mark.no_cover
@pytest.mark.parametrize(
    "arguments",
    [
        "--nodes 16 --steps 40 --seed 7 --loss 0.2 --duplicate 0.1 --check",
        "paper-grid --nodes 16 --steps 60 --loss 0.2 --capacity 4 --set custody.replicas=true --set without=[] "
        "--set node.forward=immediate",
        "power-cuts --steps 40 --set disk.error_rate=0.01 --set disk.commit_steps=1 --set disk.flip_rate=0.01",
        "reference-random-walk --steps 30",
        "hostile --nodes 9 --steps 14 --set keys=true --set radio.preset=wifi-1m --set radiation.strikes_per_step=3 "
        f"--set hostile={ATTACKERS}",
    ],
)
def test_the_same_seed_gives_the_same_bytes_in_any_process(arguments: str) -> None:
    first, second = (in_a_process(*arguments.split(), hash_seed=seed) for seed in ("0", "4242"))
    assert first == second
    assert "power" not in first or first["power"]["cuts"] > 3


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("name", "keys"), [("demo", {}), ("reference-random-walk", {}), ("hostile", {"keys": True}), ("field-lora", {})]
)
def test_another_seed_gives_other_bytes(name: str, keys: dict[str, Any]) -> None:
    worlds = [World(load_scenario(name, {"seed": seed, "nodes": 9, **keys})) for seed in (1, 2)]
    for world in worlds:
        world.run(12)
    assert worlds[0].air.tally.sha256 != worlds[1].air.tally.sha256


@pytest.mark.no_cover
@pytest.mark.parametrize("latency", [1, 3])
def test_latency_delays_but_loses_nothing(latency: int) -> None:
    summary = summary_of(
        nodes=16,
        steps=200,
        seed=2,
        radio={"latency_steps": latency},
        radiation={"sources": []},
        data={"until_step": 60},
    )
    assert summary["delivered"] == summary["created"] == 6 * 15


def test_a_datum_made_h_hops_away_takes_h_steps_and_h_exposures() -> None:
    """docs/evaluation/simulation.md, the order within a step: on a quiet line nothing waits."""
    world = world_of(
        nodes=5,
        topology="line",
        node={"forward": "step", "phases": "lockstep"},
        policy={"name": "hop-count"},
        radiation={"sources": [], "noise": 0},
        data={"interval_steps": 50},
        custody={"replicas": False},
        without=["receipts"],
    )
    # Routes are known after four steps; what was made before is left out of account.
    world.run(130, after=check)
    late = {id: step for id, step in world.ledger.arrived.items() if world.ledger.born[id] >= 50}
    assert {(id.origin, step - world.ledger.born[id]) for id, step in late.items()} == {(1, 1), (2, 2), (3, 3), (4, 4)}
    assert sorted(world.ledger.hops)[-1] == 4


def test_memory_is_counted_after_the_air_is_quiet() -> None:
    world = run(
        nodes=2,
        topology="line",
        steps=100,
        node={"forward": "step", "phases": "lockstep"},
        custody={"replicas": False},
        radiation={"sources": [], "noise": 0},
        data={"interval_steps": 10},
        store={"capacity_items": 10},
    )
    # The one drone holds each datum at the end of the step that made it, and of no other, once the route is known.
    assert world.statistics.summary()["memory_used_percent"] == pytest.approx(100 * 10 / (100 * 10), rel=0.15)


def test_corruption_is_found_in_the_step_that_struck() -> None:
    world = world_of(
        nodes=3,
        topology="line",
        steps=1,
        radiation={"sources": [[0, 0, 1.0]], "decay": 0, "noise": 0},
        node={"forward": "step", "phases": "lockstep"},
        custody={"replicas": False},
    )
    world.run(40, after=check)
    summary = world.statistics.summary()
    # Intensity 1 without decay: whatever lies in a drone's store at the next step is struck for certain.
    assert summary["delivered"] == 0
    assert summary["lost"]["corrupted"] == summary["created"] - summary["held"]
    assert summary["created"] == 8


@pytest.mark.no_cover
def test_a_full_swarm_overflows_and_the_ledger_balances() -> None:
    summary = summary_of(
        nodes=9,
        steps=120,
        seed=5,
        topology="islands",
        mobility={"split_step": 20, "gap_m": 50},
        radiation={"sources": []},
        store={"capacity_items": 4},
        data={"interval_steps": 2},
    )
    assert summary["lost"]["overflow"] > 0
    assert summary["held"] > 0


@pytest.mark.no_cover
def test_several_bases_share_the_work() -> None:
    world = run(nodes=25, bases=3, steps=110, seed=4, radiation={"sources": []}, data={"until_step": 80})
    assert world.statistics.summary()["delivered"] == world.statistics.summary()["created"]
    assert all(len(list(world.stores[base].ids())) > 20 for base in range(3))


@pytest.mark.no_cover
def test_without_custody_what_is_lost_on_the_air_has_vanished() -> None:
    world = run(nodes=16, steps=100, seed=6, custody={"mode": "none"}, radio={"loss": 0.3}, radiation={"sources": []})
    lost = world.statistics.summary()["lost"]
    assert lost["vanished"] > 0
    assert lost["corrupted"] == lost["overflow"] == 0
    assert world.statistics.summary()["reliability"] == 1.0


@pytest.mark.no_cover
def test_large_data_go_in_chunks_through_the_swarm() -> None:
    summary = summary_of(
        nodes=5,
        topology="line",
        steps=120,
        seed=9,
        radio={"loss": 0.1, "duplicate": 0.05, "reorder": 0.1},
        radiation={"sources": []},
        data={"bytes": 3000, "interval_steps": 20, "until_step": 40},
    )
    assert summary["delivered"] == summary["created"] == 8
    assert summary["altered"] == 0
    assert summary["transmissions_per_datum"] > 3000 / 123


@pytest.mark.no_cover
def test_stigmergy_fills_every_store_and_refuses_the_rest() -> None:
    summary = summary_of(
        nodes=25,
        steps=120,
        seed=1,
        policy={"name": "stigmergy"},
        radiation={"sources": []},
        store={"capacity_items": 50},
    )
    assert summary["memory_used_percent"] > 80
    assert summary["lost"]["overflow"] > summary["created"] / 2


def test_data_expire() -> None:
    world = run(
        nodes=4, steps=80, topology="islands", mobility={"split_step": 10, "gap_m": 50}, radiation={"sources": []},
        data={"lifetime_s": 4.0},
    )  # fmt: skip
    assert world.statistics.summary()["lost"]["expired"] > 0


@pytest.mark.no_cover
@settings(max_examples=examples(8), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    topology=st.sampled_from([*CONNECTED, "islands"]),
    policy=st.sampled_from(["rass", "rass-literal", "hop-count", "stigmergy"]),
    seed=st.integers(0, 10**6),
    nodes=st.integers(2, 20),
    bases=st.integers(1, 2),
    loss=st.sampled_from([0.0, 0.2, 0.6]),
    duplicate=st.sampled_from([0.0, 0.3]),
    reorder=st.sampled_from([0.0, 0.4]),
    latency=st.integers(0, 3),
    capacity=st.integers(1, 12),
    drift=st.sampled_from([0.0, 0.5]),
)
def test_the_invariants_hold_whatever_happens(topology: str, policy: str, **keys: Any) -> None:
    run(
        nodes=keys["nodes"],
        bases=keys["bases"],
        steps=50,
        seed=keys["seed"],
        topology=topology,
        policy={"name": policy},
        mobility={"split_step": 15, "rejoin_step": 35},
        radio={
            "loss": keys["loss"],
            "duplicate": keys["duplicate"],
            "reorder": keys["reorder"],
            "latency_steps": keys["latency"],
        },
        radiation={"drift": keys["drift"]},
        store={"capacity_items": keys["capacity"]},
        data={"interval_steps": 5},
    )


def test_counting_loops() -> None:
    assert count_loops([None, 0, 1, 2]) == 0
    assert count_loops([1, 0, 0, 4, 5, 3, None]) == 2
    assert count_loops([0]) == 1
    assert count_loops([]) == 0


@pytest.mark.no_cover
def test_hop_counts_are_the_shortest_on_a_quiet_grid() -> None:
    world = run(nodes=64, steps=25, radiation={"sources": []}, policy={"name": "hop-count"})
    expected = world.graph.hops_from([0])
    assert [agent.node.routing.hops for agent in world.agents] == expected


@pytest.mark.no_cover
def test_routes_die_when_the_base_is_out_of_reach() -> None:
    world = run(nodes=16, steps=60, topology="islands", mobility={"split_step": 30, "gap_m": 50})
    hops = [agent.node.routing.hops for agent in world.agents]
    near = world.graph.hops_from([0])
    assert [h == NO_ROUTE for h in hops] == [n is None for n in near]


@pytest.mark.no_cover
def test_the_far_half_of_islands_is_cut_off_for_good() -> None:
    world = World(load_scenario("islands", {"nodes": 36, "arena_m": 12, "mobility.split_step": 30}))
    far = {n for n, (x, _) in enumerate(world.surroundings.positions) if x > 0}
    assert len(far) == 18
    world.run(30)
    assert None not in world.graph.hops_from([0])
    world.run(1)
    assert {n for n, hops in enumerate(world.graph.hops_from([0])) if hops is None} == far


@pytest.mark.no_cover
def test_when_an_island_rejoins_all_that_it_held_arrives() -> None:
    options = {"nodes": 36, "arena_m": 12, "mobility.split_step": 20, "mobility.rejoin_step": 90}
    still = ["radiation.sources=[]", "data.until_step=90", "data.interval_steps=10"]
    world = World(load_scenario("islands", options, still))
    world.run(90, after=check)
    assert world.ledger.held > 60
    world.run(60, after=check)
    summary = world.statistics.summary()
    assert summary["delivered"] == summary["created"] == 35 * 9


def test_what_is_recorded_is_what_pymavlink_reads(tmp_path: Any) -> None:
    path = tmp_path / "air.tlog"
    summary = in_a_process("--nodes", "16", "--steps", "40", "--record", str(path))
    data = path.read_bytes()
    parser = common.MAVLink(None)
    parser.robust_parsing = False  # a bad frame raises
    position = frames = 0
    last = 0
    while position < len(data):
        stamp = int.from_bytes(data[position : position + 8], "big")
        assert stamp >= last
        last = stamp
        length = data[position + 9] + 12
        message = parser.decode(bytearray(data[position + 8 : position + 8 + length]))
        assert message.get_type() == "TUNNEL"
        assert message.payload_type == 33200
        position += 8 + length
        frames += 1
    assert frames == summary["frames"]["sent"]
