"""20 and 100 nodes on one radio of 57,600 bit/s, which also carries the flight telemetry."""

from __future__ import annotations

import random
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import pytest
from shared_radio import BYTES_S, Air, Arrivals, RadioNode, Simulation, Vehicle

from rass_mav.app.links import AirtimeSection
from rass_mav.link.airtime import Urgency

TELEMETRY_BYTES_S = 2000.0
#: Seconds: until everybody knows how many they are, and what is looked at then.
WARM_S, WATCHED_S = 40.0, 60.0


class Flight(NamedTuple):
    nodes: list[RadioNode]
    created: int
    arrived: int
    beacons: float
    """Part of the airtime."""
    waits: list[float]
    """How long each telemetry frame waited for the channel, seconds."""


@cache
def fly(nodes: int, swarm: bool) -> Flight:
    """The same telemetry with a swarm and without."""
    simulation = Simulation()
    air = Air(simulation)
    rng = random.Random(5)
    for n in range(nodes):
        Vehicle(simulation, air, n % 250 + 1, TELEMETRY_BYTES_S / nodes, rng)
    arrivals = Arrivals()
    budget = AirtimeSection().budget(shared=True)
    members = [
        RadioNode(
            simulation, air, n, budget, base=n == 0, observer=arrivals, rng=rng,
            risk={"worst": 0.5}, data={"interval_steps": 30},
        )
        for n in range(nodes if swarm else 0)
    ]  # fmt: skip
    simulation.run(WARM_S)
    warm, before = len(air.telemetry_waits), air.used[Urgency.BEACON]
    simulation.run(WARM_S + WATCHED_S)
    assert air.telemetry_waits
    return Flight(
        members,
        len(arrivals.made),
        len(arrivals.ids),
        (air.used[Urgency.BEACON] - before) / WATCHED_S,
        air.telemetry_waits[warm:],
    )


@pytest.mark.parametrize("nodes", [20, 100])
def test_beacons_take_at_most_a_third_and_telemetry_is_in_time(nodes: int) -> None:
    flight = fly(nodes, True)
    assert 0 < flight.beacons <= 0.30
    alone = fly(nodes, False).waits
    assert len(alone) == pytest.approx(TELEMETRY_BYTES_S * WATCHED_S / 40, rel=0.4)
    # Frame by frame: how much later it leaves because there is a swarm.
    delays = [max(0.0, a - b) for a, b in zip(flight.waits, alone, strict=False)]
    assert max(delays) <= 0.100
    assert max(flight.waits) <= 0.100


@pytest.mark.parametrize("nodes", [20, 100])
def test_data_percolate(nodes: int) -> None:
    flight = fly(nodes, True)
    assert flight.created > 2 * nodes
    # What was made last is still on its way: a turn for the datum and one for what was lost.
    assert flight.arrived >= 0.6 * flight.created


@pytest.mark.parametrize("nodes", [20, 100])
def test_everybody_knows_everybody_although_beacons_are_rare(nodes: int) -> None:
    flight = fly(nodes, True)
    turns = {node.agent.node.turn_s for node in flight.nodes}
    assert min(turns) > 1.0
    for node in flight.nodes:
        assert len(node.agent.node.routing.neighbours) == nodes - 1
        assert node.agent.node.routing.hops == (0 if node.id == 0 else 1)


def test_the_more_neighbours_the_rarer_the_beacons() -> None:
    few, many = (max(node.agent.node.turn_s for node in fly(nodes, True).nodes) for nodes in (20, 100))
    assert few < many
    budget = AirtimeSection().budget(shared=True)
    assert all(node.lane.pacer is not None and node.lane.pacer.budget == budget for node in fly(20, True).nodes)
    assert budget.bytes_s == BYTES_S


def test_the_emulated_radio_is_half_duplex_and_as_fast_as_it_says() -> None:
    simulation = Simulation()
    air = Air(simulation, bytes_s=1000.0)
    heard: list[float] = []
    air.hearers.append((1, lambda frame: heard.append(simulation.now)))
    air.hearers.append((2, lambda frame: pytest.fail("one's own frame")))
    for _ in range(3):
        air.send(2, bytes(100), None)
    simulation.run(1.0)
    assert [b - a for a, b in pairwise([0.0, *heard])] == pytest.approx([0.1, 0.1, 0.1])
