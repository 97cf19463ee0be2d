"""Nodes whose autopilots pass their frames on: bursts, routes, and a storm through two links."""

from __future__ import annotations

import random
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import pytest

from rass_mav.agent.outgoing import Way
from rass_mav.core.messages import Urgency
from rass_mav.link.settings import AirtimeSection
from rass_mav.mavlink.frames import FrameWriter
from tests.some import some

from .forwarders import Forwarder, Port, wire
from .shared_radio import Air, Arrivals, RadioNode, Simulation

RADIO_BYTES_S, COMPANION_BYTES_S = 5760.0, 92160.0
DURATION_S = 60.0


class Cable(Air):
    """What a companion takes for the air: its autopilot's port."""

    def __init__(self, simulation: Simulation, forwarder: Forwarder, port: Port) -> None:
        super().__init__(simulation)
        self._forwarder = forwarder
        self._port = port
        self.sent = 0

    def send(self, sender: int | None, frame: bytes, urgency: Urgency | None) -> None:
        self.sent += 1
        self._forwarder.hear(self._port, frame)


class Companion(RadioNode):
    """A node at an autopilot's second port."""

    def __init__(self, simulation: Simulation, forwarder: Forwarder, node_id: int, **options: Any) -> None:
        self.forwarder = forwarder
        self.port = forwarder.port(COMPANION_BYTES_S)
        self.port.deliver = self.hear
        self.cable = Cable(simulation, forwarder, self.port)
        super().__init__(
            simulation, self.cable, node_id, AirtimeSection().budget(shared=True), rng=random.Random(node_id), **options
        )

    def say(self, frames: Any) -> None:
        for outgoing in frames:
            if outgoing.way is Way.VEHICLE:
                self.forwarder.hear(self.port, outgoing.frame)
        super().say([outgoing for outgoing in frames if outgoing.way is Way.NEIGHBOURS])


class Result(NamedTuple):
    nodes: list[Companion]
    forwarders: list[Forwarder]
    arrivals: Arrivals

    @property
    def sent(self) -> int:
        return sum(node.cable.sent for node in self.nodes)

    @property
    def copies(self) -> int:
        return sum(node.link_queue.copies for node in self.nodes)


@cache
def fly(nodes: int, *, links: int, px4: bool = False) -> Result:
    """A chain of autopilots. Those next to each other are joined by so many links."""
    simulation = Simulation()
    arrivals = Arrivals()
    forwarders = [Forwarder(simulation, n + 1, px4=px4) for n in range(nodes)]
    for a, b in pairwise(forwarders):
        for _ in range(links):
            wire(simulation, (a, a.port(RADIO_BYTES_S)), (b, b.port(RADIO_BYTES_S)))
    members = [
        Companion(
            simulation, forwarder, n, base=n == 0, observer=arrivals, risk={"worst": 0.5},
            data={"interval_steps": 10, "until_step": int(DURATION_S) - 20},
        )
        for n, forwarder in enumerate(forwarders)
    ]  # fmt: skip
    simulation.run(DURATION_S)
    return Result(members, forwarders, arrivals)


@pytest.mark.no_cover
@pytest.mark.parametrize("px4", [False, True], ids=["ArduPilot", "PX4"])
@pytest.mark.parametrize("nodes", [2, 4])
def test_data_percolate_through_autopilots(nodes: int, px4: bool) -> None:
    result = fly(nodes, links=1, px4=px4)
    assert len(result.arrivals.made) >= 3 * (nodes - 1)
    assert result.arrivals.ids == result.arrivals.made
    # Paced: hardly ever does a buffer on the way overflow, where the frames of several nodes meet.
    assert sum(forwarder.lost for forwarder in result.forwarders) <= 0.01 * sum(f.forwarded for f in result.forwarders)
    assert sum(port.lost for forwarder in result.forwarders for port in forwarder.ports) == 0
    assert result.copies == 0


@pytest.mark.no_cover
@pytest.mark.parametrize("px4", [False, True], ids=["ArduPilot", "PX4"])
def test_a_storm_is_counted_and_not_made_worse(px4: bool) -> None:
    """Two autopilots with two links between them: each frame goes round without end."""
    calm, storm = fly(2, links=1, px4=px4), fly(2, links=2, px4=px4)
    assert sum(forwarder.forwarded for forwarder in storm.forwarders) > 5 * sum(f.forwarded for f in calm.forwarders)
    assert storm.arrivals.made
    assert storm.arrivals.ids == storm.arrivals.made
    assert storm.copies > 10 * calm.sent
    assert sum(node.link_queue.duplicates.echoes for node in storm.nodes) > 0
    assert storm.sent <= 1.1 * calm.sent
    for node in storm.nodes:
        assert len(node.link_queue.duplicates) <= 2048


def test_a_burst_is_spread_so_that_two_messages_of_buffer_are_enough() -> None:
    result = fly(2, links=1, px4=True)
    node = result.nodes[1]
    assert some(node.link_queue.pacer).sent[Urgency.DATA] > 0
    assert result.forwarders[1].lost == 0


def test_the_emulation_does_what_was_measured() -> None:
    simulation = Simulation()
    autopilot = Forwarder(simulation, 1)
    ports = [autopilot.port(COMPANION_BYTES_S) for _ in range(2)]
    heard: list[bytes] = []
    ports[1].deliver = heard.append
    writers = [FrameWriter(system, 191) for system in range(2, 32)]
    autopilot.hear(ports[0], writers[0].tunnel(b"nobody was heard there", payload_type=33200))
    simulation.run(0.005)
    assert heard == []
    ports[1].heard = True
    for writer in writers:
        autopilot.hear(ports[0], writer.tunnel(b"to all", payload_type=33200))
        simulation.run(simulation.now + 0.01)
    tunnels = [frame for frame in heard if frame[7:10] == b"\x81\x01\x00"]
    assert len(tunnels) == 30, "broadcasts pass, however many speak"
    assert len(autopilot.routes) == 20
    heard.clear()
    for target in (21, 22):
        autopilot.hear(ports[1], writers[0].tunnel(b"to one", payload_type=33200, target_system=target))
    back: list[bytes] = []
    ports[0].deliver = back.append
    simulation.run(simulation.now + 0.01)
    assert len([frame for frame in back if frame[7:10] == b"\x81\x01\x00"]) == 1, "the 21st system has no route"


def test_the_emulated_px4_passes_three_of_a_burst_of_ten_and_all_of_a_paced_one() -> None:
    for gap_s, passed in ((0.0, (2, 3)), (0.006, (10, 10))):
        simulation = Simulation()
        autopilot = Forwarder(simulation, 1, px4=True)
        ports = [autopilot.port(COMPANION_BYTES_S) for _ in range(2)]
        ports[1].heard = True
        heard: list[bytes] = []
        ports[1].deliver = heard.append
        writer = FrameWriter(2, 191)
        for _ in range(10):
            autopilot.hear(ports[0], writer.tunnel(bytes(100), payload_type=33200))
            simulation.run(simulation.now + gap_s)
        simulation.run(1.0)
        assert passed[0] <= len([frame for frame in heard if frame[7:10] == b"\x81\x01\x00"]) <= passed[1]
