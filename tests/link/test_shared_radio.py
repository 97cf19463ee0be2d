"""20 nodes, and in a soak 100, on one radio of 57,600 bit/s, which also carries the flight telemetry."""

from __future__ import annotations

import random
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import pytest

from rass_mav.core.messages import Urgency
from rass_mav.link.airtime import VEHICLE_PART
from rass_mav.link.settings import AirtimeSection
from rass_mav.mavlink.frames import FrameReader
from rass_mav.mavlink.messages import HEARTBEAT
from tests.extent import extents
from tests.some import some

from .shared_radio import BYTES_S, Air, Arrivals, RadioNode, Simulation, Vehicle

#: Long runs: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

TELEMETRY_BYTES_S = 2000.0
#: A NAMED_VALUE_FLOAT on the air.
VALUE_BYTES = 30
#: Pictures of each drone: more than the radio carries in the whole flight.
PARTS, PART_BYTES = 10, 32 * 1024
#: Seconds: until everybody knows how many they are, and what is looked at then.
WARM_S, WATCHED_S = 40.0, 60.0


class Flight(NamedTuple):
    nodes: list[RadioNode]
    created: int
    arrived: int
    used: dict[Urgency | None, float]
    """Part of the airtime, by what took it."""
    heartbeats: list[tuple[int, float]]
    """System id of a node, and when its heartbeat was heard."""
    beacons: list[tuple[int, float]]
    """Node id, and when its beacon was heard."""
    waits: list[float]
    """How long each telemetry frame waited for the channel, seconds."""


def fly(nodes: int, swarm: bool, *, ground: bool = False, pictures: bool = False) -> Flight:
    """The same telemetry with a swarm and without. `ground`: the radio is the autopilots', so what the nodes say to
    them and to the ground is on it too. `pictures`: the drones have more of them than the radio can carry."""
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
            risk={"worst": 0.5}, data={"interval_steps": 30}, ground={} if ground else None,
        )
        for n in range(nodes if swarm else 0)
    ]  # fmt: skip
    heartbeats: list[tuple[int, float]] = []
    reader = FrameReader()
    air.hearers.append(
        (
            -1,
            lambda data: heartbeats.extend(
                (frame.system_id, simulation.now)
                for frame in reader.feed(data)
                if frame.message_id == HEARTBEAT and frame.component_id == 191
            ),
        )
    )
    if pictures:
        content = random.Random(6)
        for member in members[1:]:
            for _ in range(PARTS):
                simulation.at(
                    WARM_S / 2,
                    partial(member.put, content.randbytes(PART_BYTES)),
                )
    simulation.run(WARM_S)
    warm, before = len(air.telemetry_waits), dict(air.used)
    simulation.run(WARM_S + WATCHED_S)
    assert air.telemetry_waits
    return Flight(
        members,
        len(arrivals.made),
        len(arrivals.ids),
        {kind: (air.used[kind] - before[kind]) / WATCHED_S for kind in before},
        [(system_id, at) for system_id, at in heartbeats if at >= WARM_S],
        [(sender, at) for sender, at in air.beacons if sender is not None and at >= WARM_S],
        air.telemetry_waits[warm:],
    )


#: Bytes of a signed TUNNEL frame.
LARGEST_FRAME = 158


@pytest.mark.parametrize("nodes", extents(14, 100))
def test_a_swarm_and_its_telemetry_share_a_slow_radio(nodes: int) -> None:
    """One flight, looked at from all sides: it takes some seconds to fly."""
    flight = fly(nodes, True)
    alone = fly(nodes, False).waits
    assert 0 < flight.used[Urgency.BEACON] <= 0.30
    # Telemetry, frame by frame: how much later it leaves because there is a swarm.
    delays = [max(0.0, a - b) for a, b in zip(flight.waits, alone, strict=True)]
    assert max(delays) <= 0.100
    assert max(flight.waits) <= 0.100
    # Data percolate. What was made last is still on its way: a turn for the datum, one for the answer.
    assert flight.created > 2 * nodes
    assert flight.arrived >= 0.6 * flight.created
    # Everybody knows everybody, although beacons are rare; and the more they are, the rarer.
    budget = AirtimeSection().budget(shared=True)
    assert budget.bytes_s == BYTES_S
    for node in flight.nodes:
        core, pacer = node.agent.node, node.link_queue.pacer
        assert some(pacer).budget == budget
        assert core.pace.turn_s >= nodes * 0.1
        assert len(core.routing.neighbours) == nodes - 1
        assert core.routing.hops == (0 if node.id == 0 else 1)


@pytest.mark.parametrize("nodes", extents(14, 100))
def test_what_the_autopilots_are_told_counts_on_the_radio_behind_them(nodes: int) -> None:
    """Heartbeats, values and texts are passed on by the autopilots, so they become rarer with the neighbours too."""
    flight = fly(nodes, True, ground=True)
    budget = AirtimeSection().budget(shared=True)
    part = budget.duty * (1.0 - budget.beacons) * VEHICLE_PART
    # Those who began together speak together: in the time that is watched there is room for one more frame of each.
    one_more = nodes * VALUE_BYTES / BYTES_S / WATCHED_S
    assert 0 < flight.used[Urgency.VEHICLE] <= part + one_more
    assert sum(flight.used[urgency] for urgency in Urgency) <= budget.duty
    assert max(flight.waits) <= 0.100, "telemetry"
    assert flight.arrived >= 0.6 * flight.created
    assert {system_id for system_id, _ in flight.heartbeats} == {(n - 1) % 255 + 1 for n in range(nodes)}


def test_telemetry_heartbeats_and_beacons_keep_their_times_beside_pictures() -> None:
    idle, flight = fly(4, True, ground=True), fly(4, True, ground=True, pictures=True)
    assert flight.used[Urgency.BULK] > 0.1, "the drones send as much as they may"
    waits = sorted(flight.waits)
    assert waits[int(0.99 * len(waits))] <= 0.100, "telemetry"
    # The worst of thousands: one more frame of the companions had begun.
    assert waits[-1] <= 0.100 + LARGEST_FRAME / BYTES_S, "telemetry"
    for beside, alone in ((flight.heartbeats, idle.heartbeats), (flight.beacons, idle.beacons)):
        assert len(beside) >= 0.95 * len(alone) > 0
        assert longest(beside) <= 2.0 * longest(alone)


def longest(heard: list[tuple[int, float]]) -> float:
    """Between two of one sender, seconds."""
    by_sender: dict[int, list[float]] = {}
    for sender, at in heard:
        by_sender.setdefault(sender, []).append(at)
    return max(later - earlier for times in by_sender.values() for earlier, later in pairwise(times))


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
