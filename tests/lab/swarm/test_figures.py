"""The figures of the paper's world, against an independent simulator and against exact computation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import extents

# Whole swarms, time after time: measuring coverage makes them five times slower, and others cover the same code.
pytestmark = pytest.mark.no_cover

PARITY = Path(__file__).parents[4] / "shared" / "data" / "paper" / "parity-grid.json"


def paper_grid(
    policy: str, seed: int, sources: Any = None, *, steps: int = 500, due: str = "step-id", bandwidth: int = 10
) -> dict[str, Any]:
    options: dict[str, Any] = {
        "policy.name": policy, "seed": seed, "steps": steps, "data.due": due, "store.bandwidth_items": bandwidth,
    }  # fmt: skip
    if sources is not None:
        options["radiation.sources"] = sources
    world = World(load_scenario("paper-grid", options))
    world.run(world.scenario.steps)
    return world.statistics.summary()


def exact_hop_count(sources: list[list[float]]) -> float:
    """Mean probability that a datum survives its way on the 10 x 10 grid, hop count, equal neighbours by chance.

    Eq. 2 at each node on the way, once each; by dynamic programming over the distance to the base in the corner.
    """
    survival = {(0, 0): 1.0}
    for distance in range(1, 10):
        for i in range(10):
            for j in range(10):
                if max(i, j) != distance:
                    continue
                parents = [
                    (a, b)
                    for a in range(max(0, i - 1), min(10, i + 2))
                    for b in range(max(0, j - 1), min(10, j + 2))
                    if max(a, b) == distance - 1
                ]
                kept = 1.0
                for x, y, intensity in sources:
                    kept *= 1 - intensity / (1 + (-9 + 2 * i - x) ** 2 + (-9 + 2 * j - y) ** 2)
                survival[i, j] = kept * sum(survival[p] for p in parents) / len(parents)
    del survival[0, 0]
    return sum(survival.values()) / len(survival)


@pytest.mark.parametrize(("seeds", "steps"), [(1, 350), pytest.param(4, 500, marks=pytest.mark.soak)])
def test_hop_count_agrees_with_exact_computation(seeds: int, steps: int) -> None:
    sources = [[2.333, 1.3541, 0.7116], [-2.1258, 0.2706, 0.6886], [-0.5218, 1.3966, 0.23]]
    runs = [paper_grid("hop-count", seed, sources, steps=steps) for seed in range(seeds)]
    measured = sum(1 - r["lost"]["corrupted"] / (r["created"] - r["held"]) for r in runs) / len(runs)
    assert measured == pytest.approx(exact_hop_count(sources), abs=0.015)


@pytest.mark.soak
@pytest.mark.parametrize("policy", ["hop-count", "rass", "rass-literal"])
def test_it_agrees_with_an_independent_simulator(policy: str) -> None:
    """The means over the worlds are closer than any of them."""
    differences = differences_from_an_independent_simulator(policy, worlds=6, seeds=2, steps=500)
    for name, mean, most in (("reliability", 0.02, 0.03), ("delay", 0.1, 0.3)):
        found = [difference[name] for difference in differences]
        assert abs(sum(found) / len(found)) < mean
        assert all(abs(difference) < most for difference in found), found


@pytest.mark.parametrize("policy", ["rass", pytest.param("rass-literal", marks=pytest.mark.soak)])
def test_in_one_world_it_agrees_with_an_independent_simulator(policy: str) -> None:
    (difference,) = differences_from_an_independent_simulator(policy, worlds=1, seeds=1, steps=250)
    assert abs(difference["reliability"]) < 0.03
    assert abs(difference["delay"]) < 0.3


def differences_from_an_independent_simulator(
    policy: str, worlds: int, seeds: int, steps: int
) -> list[dict[str, float]]:
    """Of reliability and of mean delay in steps, world by world."""
    if not PARITY.exists():
        pytest.skip("needs ../shared/data/paper, which is not part of the repository")
    parity = json.loads(PARITY.read_text())
    expected = parity["expect"][policy]
    assert len(parity["sources"]) >= worlds
    differences = []
    for world in range(worlds):
        runs = [paper_grid(policy, seed, parity["sources"][world], steps=steps) for seed in range(seeds)]
        reliability = sum(r["reliability"] for r in runs) / len(runs)
        delay = sum(r["delay_steps"]["mean"] for r in runs) / len(runs)
        differences.append(
            {
                "reliability": reliability - expected["reliability"][world],
                "delay": delay - expected["delay_steps"][world],
            }
        )
    return differences


def test_data_that_are_born_in_a_wave_towards_the_base_bunch_and_wait() -> None:
    """Half a step of delay, and none where a drone may send all it has."""
    delay = {
        (due, bandwidth): paper_grid("hop-count", 0, steps=150, due=due, bandwidth=bandwidth)["delay_steps"]["mean"]
        for due, bandwidth in (("step-id", 10), ("step+id", 10), ("step+id", 50))
    }
    assert delay["step+id", 10] > delay["step-id", 10] + 0.3
    assert delay["step+id", 50] == pytest.approx(delay["step-id", 10], abs=0.1)


@pytest.mark.parametrize("seeds", extents(2, 8))
def test_rass_avoids_the_source_that_hop_count_crosses(seeds: int) -> None:
    """The paper's physical experiment; with alpha 10 on hops (`rass-literal`) RASS is hop count here."""
    reliability = {}
    for policy in ("rass", "rass-literal", "hop-count"):
        runs = []
        for seed in range(seeds):
            world = World(load_scenario("five-drones", {"policy.name": policy, "seed": seed}))
            world.run(world.scenario.steps)
            runs.append(world.statistics.summary()["reliability"])
        reliability[policy] = sum(runs) / len(runs)
    assert reliability["rass"] > reliability["hop-count"] + 0.12
    assert reliability["rass-literal"] == pytest.approx(reliability["hop-count"], abs=0.03)
