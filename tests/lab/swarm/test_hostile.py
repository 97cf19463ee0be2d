"""Attackers beside honest nodes: what they may cost."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from rass_mav.core.datum import Fate
from rass_mav.errors import ConfigError
from rass_mav.lab.hostile.kinds import KINDS
from rass_mav.lab.swarm.catalogue import load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import extents

#: Unless a test says otherwise, the attacker is present from this step until that one,
ATTACK = (50, 150)
#: and so many steps later everything has healed.
HEALING = 200
#: What these do must not matter.
HARMLESS = (
    "number-squatter", "request-forger", "impostor", "id-inventor", "replayer", "flooder", "bit-flipper",
    "receipt-forger", "digest-forger",
)  # fmt: skip
#: What these take is missing while they are there.
THIEVES = ("sinkhole", "false-base", "black-hole", "committed-forger")


class Visit(NamedTuple):
    """Steps: when the attacker comes and goes, until when data are made, and when all of them must have arrived."""

    begin: int
    end: int
    made: int
    over: int


SHORT, LONG = Visit(20, 60, 100, 190), Visit(*ATTACK, 300, 500)


def swarm(kind: str, *keys: str, near: int = 12, begin: int = ATTACK[0], end: int = ATTACK[1]) -> World:
    hostile = f"hostile=[{{kind: {kind}, near: {near}, begin: {begin}, end: {end}}}]"
    return World(load_scenario("hostile", {}, [hostile, *keys]))


def with_policies(kinds: tuple[str, ...], *also_by_hops: str) -> list[tuple[str, str]]:
    return [(kind, "survival") for kind in kinds] + [(kind, "rass") for kind in also_by_hops]


@pytest.mark.no_cover
@pytest.mark.parametrize(("kind", "policy"), with_policies(HARMLESS, "impostor", "id-inventor", "number-squatter"))
@pytest.mark.parametrize("visit", extents(SHORT, LONG))
def test_liars_that_cost_nothing(visit: Visit, kind: str, policy: str) -> None:
    data = f"data.until_step={visit.made}"
    world = swarm(kind, f"policy.name={policy}", data, begin=visit.begin, end=visit.end)
    world.run(visit.over)
    summary = world.statistics.summary()
    # 24 drones, each every ten steps.
    assert summary["created"] == 2.4 * visit.made
    assert summary["delivered"] >= 0.99 * summary["created"]
    assert summary["lost"]["unfounded"] == 0
    assert summary["altered"] == 0


@pytest.mark.no_cover
@pytest.mark.parametrize(("kind", "policy"), with_policies(THIEVES, "sinkhole"))
def test_what_was_promised_to_thieves_heals_after_they_have_left(kind: str, policy: str) -> None:
    world = swarm(kind, f"policy.name={policy}", f"data.until_step={ATTACK[1] + 20}")
    world.run(ATTACK[1])
    made = set(world.ledger.born)
    world.run(HEALING)
    missing = made - world.ledger.arrived.keys()
    # A replica may have had to go for want of room, when the thief had the datum.
    assert {world.ledger.lost.get(id) for id in missing} <= {Fate.OVERFLOW}
    assert len(missing) <= 0.02 * len(made)


@pytest.mark.no_cover
@pytest.mark.parametrize("near", [0, 12], ids=["beside-the-base", "in-the-middle"])
@pytest.mark.parametrize("kind", ["shadower", "turn-shadower", "fitness-shadower"])
def test_what_a_shadower_says_is_forgotten_when_it_has_left(kind: str, near: int) -> None:
    """Without keys. What is created 60 s later arrives as usual."""
    world = swarm(kind, "data.until_step=180", near=near, begin=20, end=100)
    world.run(240)
    born, arrived = world.ledger.born, world.ledger.arrived
    assert len(arrived) == len(born) == 24 * 18
    delays = [arrived[id] - step for id, step in born.items() if step >= 160]
    assert sum(delays) <= 2 * len(delays)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("kind", "policy"), [("sinkhole", "survival"), ("black-hole", "survival"), ("sinkhole", "rass")]
)
def test_thieves_that_stay_are_found_out_and_nobody_else_is_suspected(kind: str, policy: str) -> None:
    hostile = f"hostile=[{{kind: {kind}, near: 12, begin: {ATTACK[0]}}}]"
    world = World(load_scenario("hostile", {}, [hostile, f"policy.name={policy}", "data.until_step=250"]))
    world.run(300)
    created, missing = len(world.ledger.born), len(world.ledger.born) - len(world.ledger.arrived)
    assert created == 24 * 25
    assert missing <= 0.02 * created
    thief = world.scenario.nodes
    for agent in world.agents:
        neighbours = agent.node.routing.neighbours
        assert not any(n.suspected for n in neighbours.values() if n.id != thief)
    assert any(agent.node.figures().get("doubted") for agent in world.agents)


@pytest.mark.no_cover
@pytest.mark.parametrize("made", extents(160, 450))
def test_a_new_name_is_given_little_before_it_has_delivered(made: int) -> None:
    """A thief that has a new name every 20 steps has no past."""
    world = swarm("name-changer", f"data.until_step={made}", end=10**6)
    world.run(made + 40)
    summary = world.statistics.summary()
    assert summary["created"] == 2.4 * made
    assert summary["lost"]["overflow"] == 0
    assert summary["delivered"] >= 0.9 * summary["created"]


@pytest.mark.no_cover
@pytest.mark.parametrize("world", ["hostile", "islands", "field-sik-64k"])
def test_among_honest_nodes_nobody_is_suspected(world: str) -> None:
    swarm = World(load_scenario(world))
    for _ in range(6):
        swarm.run(20)
        assert not any(agent.node.figures().get("doubted") for agent in swarm.agents)


@pytest.mark.no_cover
@pytest.mark.parametrize("mirror", ["true", "false"])
@pytest.mark.parametrize("place", extents((16, (5, 10), 80), (25, (12, 6), 250)))
def test_data_that_forgers_called_arrived_arrive_where_much_gets_lost(
    place: tuple[int, tuple[int, int], int], mirror: str
) -> None:
    """Such data wait while airtime is short. It must not be short for ever because nothing else is sent."""
    nodes, near, end = place
    forgers = ", ".join(f"{{kind: receipt-forger, near: {node}, begin: 10, end: {end}}}" for node in near)
    keys = [f"nodes={nodes}", "radio.loss=0.4", f"custody.replicas={mirror}", f"data.until_step={end}"]
    world = World(load_scenario("hostile", {}, [f"hostile=[{forgers}]", *keys]))
    world.run(end + 100)
    summary = world.statistics.summary()
    assert summary["created"] == (nodes - 1) * end / 10
    assert summary["delivered"] == summary["created"]


@pytest.mark.no_cover
def test_junk_that_does_not_end_leaves_room_for_data() -> None:
    hostile = f"hostile=[{{kind: junk-custody, near: 12, begin: {ATTACK[0]}}}]"
    world = World(load_scenario("hostile", {}, [hostile, "policy.name=rass", "data.until_step=150"]))
    world.run(250)
    assert len(world.ledger.arrived.keys() & world.ledger.born.keys()) >= 0.96 * 24 * 15


@pytest.fixture(scope="module")
def honest() -> str:
    """The summary of what is on the air in the first 30 steps of a small swarm without attackers."""
    world = World(load_scenario("hostile", {}, ["nodes=9"]))
    world.run(30)
    return world.air.tally.sha256


@pytest.mark.no_cover
@pytest.mark.parametrize("kind", KINDS)
def test_an_attacker_that_is_not_there_changes_nothing(kind: str, honest: str) -> None:
    visited = swarm(kind, "nodes=9", near=4, begin=10**6, end=10**6 + 1)
    visited.run(30)
    assert visited.air.tally.sha256 == honest


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_tells_the_same_lies(kind: str) -> None:
    summaries = set()
    for _ in range(2):
        world = swarm(kind, "nodes=9", near=4, begin=2)
        world.run(12)
        summaries.add(world.air.tally.sha256)
    assert len(summaries) == 1


@pytest.mark.no_cover
def test_what_nobody_made_is_not_in_the_ledger() -> None:
    world = swarm("junk-custody", begin=5)
    world.run(60)
    ledger = world.ledger
    assert ledger.false_delivered > 0
    assert ledger.created == len(ledger.arrived) + ledger.held + sum(ledger.losses().values())
    assert ledger.arrived.keys() <= ledger.born.keys()


@pytest.mark.parametrize(
    "hostile",
    [
        "[{kind: friend}]",
        "[{kind: sinkhole, near: 25}]",
        "[{kind: sinkhole, end: 0}]",
        "[{near: 3}]",
        "[{kind: sinkhole, captured: true}]",
    ],
)
def test_attackers_that_make_no_sense_are_refused(hostile: str) -> None:
    with pytest.raises(ConfigError, match="hostile"):
        load_scenario("hostile", {}, [f"hostile={hostile}"])
