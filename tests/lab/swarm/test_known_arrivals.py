"""Receipts in whole swarms: nodes with a copy soon know of its arrival, and no datum is worse off."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks.receipts import WITHIN, Copies, bound, main
from rass_mav.config.loading import convert
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.lab.swarm.world import World
from tests.extent import seeds

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


def test_nodes_send_no_more_than_their_share() -> None:
    copies = copies_of(False)
    assert copies.bytes / (NODES * 120) <= bound(scenario())


def test_the_benchmark_prints_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["demo", "--set", "nodes=16", "--set", "steps=40"]
    main(options)
    assert "receipts: " in capsys.readouterr().out
    main([*options, "--json"])
    [line] = capsys.readouterr().out.splitlines()
    one = json.loads(line)
    assert one["receipt_bytes"] <= one["receipt_bytes_bound"] < 48
    assert one["loops"] == 0
