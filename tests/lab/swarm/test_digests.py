"""Summaries in whole swarms: replicas end within a short time, and no datum is worse off."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks.receipts import WITHIN, Copies, main
from rass_mav.config.loading import convert
from rass_mav.core.messages import Summary
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World
from tests.extent import seeds
from tests.nodes import node_of

pytestmark = pytest.mark.no_cover

NODES = 36


def scenario(**keys: Any) -> Scenario:
    return convert({"nodes": NODES, "bases": 2, "steps": 120, "data": {"until_step": 60}, **keys}, Scenario, "test")


def copies_of(checked: bool, **keys: Any) -> Copies:
    copies = Copies(scenario(**keys))

    def after(world: World) -> None:
        copies.look(world)
        if checked:
            check(world)

    copies.world.run(120, after=after)
    return copies


@pytest.mark.parametrize("seed", seeds(1, 4))
@pytest.mark.parametrize(
    ("topology", "part"),
    # Where nodes move, the one that has to tell that it passed a datum on may be out of range by then.
    [("grid", 0.5), ("random-walk", 0.6)],
)
def test_nodes_with_a_copy_soon_know_of_its_arrival_and_nothing_is_lost_by_that(
    topology: str, part: float, seed: int
) -> None:
    told = copies_of(True, topology=topology, seed=seed)
    ledger = told.world.ledger
    assert told.ends["known"] >= 0.95 * (told.ends["known"] + told.ends["unknown"])
    assert told.ends["known"] > 250
    assert sorted(told.delays)[len(told.delays) * 19 // 20] < part * WITHIN
    assert ledger.created == len(ledger.arrived) + ledger.held + sum(ledger.losses().values())
    assert told.world.loops == 0
    plain = copies_of(False, topology=topology, seed=seed, without=["summaries"])
    with_summaries, without = (copies.world.statistics.summary() for copies in (told, plain))
    assert with_summaries["memory_used_percent"] < without["memory_used_percent"]


def test_nodes_send_no_more_than_their_share() -> None:
    copies = copies_of(False)
    # One receipt and one summary of 108 bytes in six steps; a base has a summary of what arrives in two.
    assert copies.bytes / (NODES * 120) <= 40


@pytest.mark.parametrize(
    "keys", [{"without": ["receipts"]}, {"custody": {"replicas": False}}, {"without": ["lasting-replicas"]}]
)
def test_there_are_no_summaries_where_no_replica_waits_for_a_receipt(keys: dict[str, Any]) -> None:
    world = World(scenario(**keys))
    world.run(40)
    assert world.ledger.arrived
    said = [node_of(agent).summaries.turn(t) for agent in world.agents for t in range(12)]
    assert not any(isinstance(message, Summary) for message in said)


def test_the_benchmark_prints_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["demo", "--set", "nodes=16", "--set", "steps=40"]
    main(options)
    assert "receipts: " in capsys.readouterr().out
    main([*options, "--json", "--set", "without=[summaries]"])
    [line] = capsys.readouterr().out.splitlines()
    one = json.loads(line)
    assert one["receipt_bytes"] <= one["receipt_bytes_bounds"]["drone"] < 24
    assert one["loops"] == 0
