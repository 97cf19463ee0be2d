"""Custody with replicas and immediate forwarding in whole swarms, with the invariants checked in full after every
step."""

from __future__ import annotations

import random
from itertools import cycle, product
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import examples, extents

from .worlds import summary_of

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

#: What the lab leaves out: then a replica is kept until the datum has been passed on. And nothing: until the receipt.
PASSED_ON, RECEIPT = ["receipts"], list[str]()


@pytest.mark.parametrize(
    ("topology", "policy", "without", "forward"),
    [
        (topology, *modes)
        for topology, modes in zip(
            cycle(["grid", "scale-free", "lennard-jones", "random-walk", "line"]),
            product(["rass", "hop-count", "survival"], [PASSED_ON, RECEIPT], ["step", "immediate"]),
            strict=False,
        )
    ],
)
@pytest.mark.parametrize("size", extents(16, 49))
def test_nothing_is_lost_on_a_bad_radio_and_everything_arrives(
    size: int, topology: str, policy: str, without: list[str], forward: str
) -> None:
    nodes = 12 if topology == "line" else size
    found = summary_of(
        nodes=nodes, steps=10 * size, seed=3, topology=topology, policy={"name": policy}, without=without,
        node={"forward": forward}, radio={"loss": 0.3, "duplicate": 0.1, "reorder": 0.2},
        radiation={"corruption": False}, data={"until_step": 60}, store={"capacity_items": 5000},
    )  # fmt: skip
    assert found["delivered"] == found["created"] == 6 * (nodes - 1)
    assert sum(found["lost"].values()) == found["altered"] == 0
    assert found["frames"]["dropped"] > 0


def test_replicas_save_most_of_what_radiation_takes() -> None:
    base: dict[str, Any] = {"nodes": 36, "steps": 100, "seed": 2, "topology": "grid", "policy": {"name": "rass"}}
    plain = summary_of(**base, custody={"replicas": False}, without=PASSED_ON, node={"forward": "step"})
    mirrored = summary_of(**base, without=PASSED_ON, node={"forward": "step"})
    at_once = summary_of(**base, without=RECEIPT, node={"forward": "immediate"})
    assert plain["copies_mean"] == 1.0
    # And those of data that move one hop a step, until their holders are told that nobody counts on them any more.
    assert 1.5 < mirrored["copies_mean"] <= 2.5
    assert 1 - mirrored["reliability"] < 0.6 * (1 - plain["reliability"])
    assert 1 - at_once["reliability"] < 0.5 * (1 - mirrored["reliability"])
    assert at_once["delay_steps"]["mean"] < 0.5 * mirrored["delay_steps"]["mean"]


@pytest.mark.parametrize(("without", "forward"), [(PASSED_ON, "step"), (RECEIPT, "immediate")])
@pytest.mark.parametrize("nodes", extents(25, 100))
def test_an_island_keeps_its_data_until_it_is_back(nodes: int, without: list[str], forward: str) -> None:
    found = summary_of(
        nodes=nodes, steps=260, topology="islands", policy={"name": "survival"}, without=without,
        node={"forward": forward}, mobility={"split_step": 40, "rejoin_step": 180},
        data={"interval_steps": 40, "until_step": 170},
    )  # fmt: skip
    assert found["held"] == 0
    assert found["reliability"] > 0.85


@settings(max_examples=examples(10), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 1000),
    topology=st.sampled_from(["grid", "random-walk", "scale-free", "islands"]),
    policy=st.sampled_from(["rass", "rass-literal", "hop-count", "stigmergy", "survival"]),
    without=st.sampled_from([PASSED_ON, RECEIPT]),
    own_share=st.sampled_from([None, 0.0, 0.5, 1.0]),
    forward=st.sampled_from(["step", "immediate"]),
    capacity=st.integers(1, 6),
    radio=st.sampled_from([{}, {"loss": 0.3, "reorder": 0.3, "duplicate": 0.3}, {"latency_steps": 2}]),
    lifetime=st.sampled_from([None, 3.0]),
    reboots=st.sampled_from([0.0, 0.01]),
)
def test_the_invariants_hold_whatever_is_set(
    seed: int, topology: str, policy: str, without: list[str], own_share: float | None, forward: str,
    capacity: int, radio: Any, lifetime: Any, reboots: float,
) -> None:  # fmt: skip
    """Small stores, so that replicas yield all the time; `run` checks each step."""
    found = summary_of(
        nodes=16, steps=60, seed=seed, topology=topology, policy={"name": policy}, radio=radio,
        without=without, node={"forward": forward},
        store={"capacity_items": capacity, "bandwidth_items": 4, "own_share": own_share},
        data={"interval_steps": 3, "lifetime_s": lifetime}, mobility={"split_step": 20, "rejoin_step": 40},
        failures={"reboot_rate": reboots, "wipe_rate": reboots / 2, "die_fraction": 10 * reboots},
    )  # fmt: skip
    assert found["created"] == found["delivered"] + found["held"] + sum(found["lost"].values())
    assert found["altered"] == 0


def test_replicas_have_no_effect_under_replication() -> None:
    base: dict[str, Any] = {"nodes": 9, "steps": 30, "policy": {"name": "stigmergy"}}
    assert summary_of(**base, without=PASSED_ON) == summary_of(**base, custody={"replicas": False}, without=PASSED_ON)


def test_the_papers_worlds_have_one_copy_and_one_hop_a_step() -> None:
    for topology in ("grid", "scale-free", "lennard-jones", "random-walk"):
        scenario = load_scenario(f"paper-{topology}")
        assert not scenario.custody.replicas
        assert scenario.node.forward == "step"


@pytest.mark.parametrize("without", ["[]", "[overhearing]"])
def test_drones_overhear_each_other_unless_the_lab_leaves_that_out(without: str) -> None:
    keys = ["nodes=16", "arena_m=8", f"without={without}", "radiation.corruption=false"]
    world = World(load_scenario("demo", {}, keys))
    world.run(12)
    kept = [datum for agent in world.agents for datum in agent.node.overheard.values()]
    assert bool(kept) == (without == "[]")
    assert all(datum.intact for datum in kept)
    # Radiation strikes them like data in a store.
    for node_id in range(1, 16):
        world.strike(node_id, 1.0, random.Random(1))
    assert not any(datum.intact for agent in world.agents for datum in agent.node.overheard.values())
