"""sitl/three-vehicles.yaml does what sitl/README.md says."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from rass_mav.core.messages import Data
from rass_mav.lab.fleet.processes import run
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.wire import decode
from tests.extent import extents, seeds

FILE = str(Path(__file__).parents[3] / "sitl" / "three-vehicles.yaml")
NO_CORRUPTION = "radiation.corruption=false"


def summary_of(*assignments: str, policy: str = "rass") -> dict[str, Any]:
    world = World(load_scenario(FILE, {"policy.name": policy}, assignments))
    world.run(world.scenario.steps, after=check)
    return world.statistics.summary()


@pytest.mark.no_cover
def test_data_of_the_far_vehicle_take_two_hops() -> None:
    summary = summary_of(NO_CORRUPTION)
    assert summary["nodes"] == 4
    assert summary["hops"]["p95"] == 2
    assert summary["delivered"] == summary["created"] > 0


def targets_of_the_far_vehicle(*assignments: str) -> Counter[int]:
    """To whom vehicle 1 sent how many data, read from the frames on the air."""
    targets: Counter[int] = Counter()

    def record(frame: bytes, step: int) -> None:
        tunnel = tunnel_from_datagram(frame)
        message = tunnel and decode(tunnel[-1], 0.0)
        if isinstance(message, Data) and message.sender == 1:
            targets[message.target] += len(message.handovers)

    world = World(load_scenario(FILE, {}, (NO_CORRUPTION, *assignments)), record=record)
    world.run(world.scenario.steps, after=check)
    return targets


@pytest.mark.no_cover
def test_its_data_avoid_the_vehicle_near_the_source() -> None:
    near_a_source = targets_of_the_far_vehicle()
    assert near_a_source[2] > 4 * near_a_source[3]
    without = targets_of_the_far_vehicle("radiation.sources=[]")
    assert without[3] > without[2] / 2


@pytest.mark.no_cover
@pytest.mark.parametrize("runs", extents(2, 6))
def test_what_knows_the_risk_loses_less(runs: int) -> None:
    """On average: in single runs of 360 data chance may favour the shortest way."""
    lost = {"rass": 0.0, "hop-count": 0.0}
    for seed in range(1, runs + 1):
        for policy in lost:
            one_copy = (f"seed={seed}", "steps=600", "custody.replicas=false", "node.forward=step")
            lost[policy] += 1.0 - summary_of(*one_copy, policy=policy)["reliability"]
    assert lost["rass"] < 0.9 * lost["hop-count"]


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", seeds(1, 4))
def test_with_replicas_and_without_waiting_nothing_is_left_to_lose(seed: int) -> None:
    assert summary_of(f"seed={seed}", "steps=600")["reliability"] == 1.0


@pytest.mark.no_cover
def test_the_same_over_udp() -> None:
    steps = {"steps": 30}
    summary = run(load_scenario(FILE, {"transport": "udp", **steps}))
    virtual = World(load_scenario(FILE, steps))
    virtual.run(30)
    assert summary["created"] == virtual.ledger.created == summary["delivered"] + summary["held"] > 0
    assert summary["delivered"] > 0
    assert summary["altered"] == 0
    assert summary["routing"]["max_hop_count"] >= 2
