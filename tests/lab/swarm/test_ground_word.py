"""Whole swarms in which only the ground's word counts: a captured drone has the link key, and is inside."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest

from rass_mav.lab.medium.air import open_datagram
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.wire.attestation import ANCHOR, ASK, STATEMENT_SIGNATURE
from tests.extent import extents
from tests.keyed import keyed
from tests.some import some

#: What says something in a base's name.
LIARS = ("false-base", "impostor", "receipt-forger", "request-forger", "route-forger", "word-forger")


def swarm(*keys: str, name: str = "hostile") -> World:
    return World(load_scenario(name, {}, ["keys=true", *keys]))


def counts(world: World) -> Counter[str]:
    """What the nodes' `status` says, of all nodes."""
    total: Counter[str] = Counter()
    for agent in world.agents:
        attestations = some(keyed(agent).attestations)
        total.update(attestations.report())
    return total


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("kinds", "policy"),
    [
        # The suite has all of them in one swarm, a soak each in its own.
        (LIARS, "survival"),
        (("false-base",), "rass"),
        *(pytest.param((kind,), "survival", marks=pytest.mark.soak) for kind in LIARS),
        *(pytest.param((kind,), "rass", marks=pytest.mark.soak) for kind in ("impostor", "route-forger")),
    ],
)
@pytest.mark.parametrize("made", extents(70, 130))
def test_a_captured_drone_that_lies_about_bases_costs_nothing(made: int, kinds: Sequence[str], policy: str) -> None:
    """`made`: data are created until this step."""
    attackers = ",".join(f"{{kind: {kind}, near: 12, begin: 20, end: {made - 10}, captured: true}}" for kind in kinds)
    world = swarm(f"hostile=[{attackers}]", f"data.until_step={made}", f"policy.name={policy}")
    world.run(made - 11)
    during = world.statistics.summary()
    assert during["created"] > 2.3 * (made - 10)
    # As without an attacker: what is missing has just been created, or waits for a lost frame.
    assert during["delivered"] >= 0.96 * during["created"]
    world.run(61)
    summary = world.statistics.summary()
    assert summary["created"] == summary["delivered"] == 2.4 * made
    assert not any(summary["lost"].values())
    assert summary["altered"] == 0
    assert not any(summary["hostile"]["alarms"].values())
    assert summary["routing"]["loops"] == 0
    found = counts(world)
    if kinds != ("request-forger",):
        assert found["routes_refused"] + beacons_refused(world) > 30 or found["waiting"] > 40, "it was there"


def beacons_refused(world: World) -> int:
    return sum(keyed(agent).sessions.report()["beacons_refused"] for agent in world.agents)


def spread(*keys: str) -> tuple[float, Counter[int], list[int]]:
    """Mean steps from the arrival of a datum until its last copy in the swarm has ended, bytes of payload by type, and
    what the nodes know at the end."""
    size: Counter[int] = Counter()

    def record(frame: bytes, step: int) -> None:
        opened = some(open_datagram(frame, 0.0))
        payload = opened[3]
        type_ = payload[0] & 15
        size[payload[1] if type_ == 15 else type_] += len(payload)

    world = World(load_scenario("hostile", {}, ["data.until_step=150", *keys]), record=record)
    ended: dict[object, int] = {}

    def look(world: World) -> None:
        held = {id for agent in world.agents[1:] for id in agent.store.ids()}
        for id in world.ledger.arrived:
            if id not in held:
                ended.setdefault(id, world.t)
            else:
                ended.pop(id, None)

    world.run(250, after=look)
    arrived = world.ledger.arrived
    assert len(arrived) == world.statistics.summary()["created"] == 24 * 15
    assert ended.keys() == arrived.keys(), "no copy is left"
    delays = [ended[id] - at for id, at in arrived.items()]
    return sum(delays) / len(delays), size, sorted({agent.node.receipts.statements_hash for agent in world.agents})


@pytest.mark.no_cover
def test_receipts_take_about_as_many_steps_and_some_more_bytes() -> None:
    open_delay, open_size, open_summaries = spread()
    delay, size, summaries = spread("keys=true")
    assert len(open_summaries) == len(summaries) == 1
    assert delay <= open_delay + 6
    told = sum(size[type_] for type_ in (8, 14, 16, STATEMENT_SIGNATURE, ASK))
    assert 0 < size[STATEMENT_SIGNATURE] < size[8]
    # Over longer missions it is half as many more (docs/how-to/keys.md).
    assert told <= 1.9 * sum(open_size[type_] for type_ in (8, 14, 16))
    assert size[14] == 0
    # Anchors are rare.
    assert 0 < size[ANCHOR] < 0.02 * size[1]


def test_beacons_with_everything_on_have_at_most_64_bytes_besides_answers() -> None:
    sizes = set()

    def record(frame: bytes, step: int) -> None:
        opened = open_datagram(frame, 0.0)
        if opened is not None and opened[3][0] & 15 == 1:
            sizes.add(len(opened[3]))

    scenario = load_scenario("paper-random-walk", {}, ["keys=true", "nodes=20"])
    World(scenario, record=record).run(40)
    assert {53, 63} & sizes
    assert max(sizes) <= 64
