"""Pictures over several hops of an air that takes time and loses frames, while drones fail."""

from __future__ import annotations

import pytest

from benchmarks.pictures import PART_BYTES, WARM_STEPS, Line, line, measure_time
from rass_mav.lab.swarm.invariants import check
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from tests.extent import extents
from tests.some import some


@pytest.mark.no_cover
@pytest.mark.parametrize("size", extents(300_000, 6_000_000))
def test_a_picture_arrives_over_four_hops_though_each_relay_is_killed_once(size: int) -> None:
    result = measure_time(line(4, "wifi-1m", 1.0, 0.1, 1), 1, size, kill=True, most_steps=5000)
    assert result["arrived"] == result["parts"] > size // 40_000
    assert result["altered"] == 0


@pytest.mark.no_cover
def test_a_transmission_makes_the_copy_of_the_custodian_and_the_replica() -> None:
    """Who hands a part over keeps it as the replica, so no chunk is sent for replicas alone."""
    parts, hops, chunk_bytes = 20, 3, 123
    world = Line(line(hops, "wifi-6m", 1.0, 0.0, 1))
    world.run(WARM_STEPS)
    ids = set(world.take_pictures(1, parts * PART_BYTES))
    nodes = [agent.node for agent in world.agents]
    before = sum(node.pace.sent for node in nodes)
    relayed = 0
    while not ids <= world.arrived.keys():
        world.step()
        for relay in nodes[1:-1]:
            for id in ids & relay.holdings.custody.keys():
                relayed += 1
                assert any(id in node.holdings for node in nodes if node is not relay)
    assert relayed
    needed = hops * parts * -(-PART_BYTES // chunk_bytes)
    # Some collide, and each drone has a measurement a step. Replicas of their own would make it twice as many.
    assert needed < sum(node.pace.sent for node in nodes) - before < 1.5 * needed


@pytest.mark.no_cover
def test_parts_that_a_node_has_heard_on_their_way_to_another_are_not_sent_to_it_again() -> None:
    """While the base is away, parts go to and fro between drones that hear each other."""
    sent = {}
    for overhear in (True, False):
        keys = {
            "nodes": 9, "seed": 1, "without": [] if overhear else ["overhearing"], "failures.base_off": [[0, 60]],
            "data.until_step": 80,
            "traffic.picture_bytes": 8192, "traffic.picture_part_bytes": 2048,
        }  # fmt: skip
        world = World(load_scenario("files", keys))
        for _ in range(130):
            world.step()
            check(world)
        pictures = some(world.statistics.pictures)
        assert pictures.whole(world.ledger.arrived) == len(pictures.taken) == 16
        assert world.ledger.altered == 0
        sent[overhear] = sum(agent.node.pace.sent for agent in world.agents)
    assert sent[True] < 0.9 * sent[False]


@pytest.mark.no_cover
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_a_receiver_that_restarts_in_the_middle_of_a_part_is_sent_the_rest(loss: float) -> None:
    chunks = -(-PART_BYTES // 123)
    world = Line(line(1, "sik-64k", 1.0, loss, 1))
    world.run(WARM_STEPS)
    source = world.agents[1].node
    before = source.pace.sent
    (part,) = world.take_pictures(1, PART_BYTES)
    while source.pace.sent - before < 0.75 * chunks:
        world.step()
    assert part not in world.arrived
    world.crash(0, world.t + 5)
    began = world.t
    while part not in world.arrived:
        world.step()
        assert world.t < began + 60
    assert world.ledger.altered == 0
    # Besides what got lost: the chunks of a second, those on their way, and a measurement a step.
    measurements = world.t - WARM_STEPS
    assert source.pace.sent - before - measurements <= chunks / (1.0 - 1.5 * loss) + 46 + 32
