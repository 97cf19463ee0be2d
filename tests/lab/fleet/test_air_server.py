"""The air of a mock swarm, in this process: real sockets on 127.0.0.1, time brought by the test."""

from __future__ import annotations

import os
import random
import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.messages import NO_ROUTE, Beacon, Data, Handover
from rass_mav.lab.fleet.air_server import AirOrder, MockAir, serve
from rass_mav.lab.medium.settings import RadioSection
from rass_mav.lab.swarm.scenario import NodeSection, RadiationSection, Scenario, system_id
from rass_mav.mavlink.frames import FrameReader, FrameWriter
from rass_mav.mavlink.messages import NAMED_VALUE_FLOAT, companion_heartbeat
from rass_mav.mavlink.telemetry import Telemetry
from rass_mav.wire import encode
from tests.patience import PATIENCE_S
from tests.some import some


class Swarm:
    """The air, and a bare socket for each node of a line."""

    def __init__(self, nodes: int = 3, **radio: Any) -> None:
        self.scenario = Scenario(
            nodes=nodes, topology="line", radio=RadioSection(**radio), radiation=RadiationSection(noise=0.0)
        )
        self.server = MockAir(AirOrder(self.scenario))
        self.air = [self.socket(port) for port in self.server.ports.air]
        self.vehicle = [self.socket(port) for port in self.server.ports.vehicle]

    @staticmethod
    def socket(port: int) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.connect(("127.0.0.1", port))
        sock.setblocking(False)
        return sock

    def say(self, node: int, data: bytes) -> None:
        """A node sends to its neighbours, and the air deals with it. UDP on one host arrives before send returns."""
        self.air[node].send(data)
        self.server.wires.poll(PATIENCE_S)

    def heard(self, node: int) -> list[bytes]:
        return drained(self.air[node])

    def introduce(self) -> None:
        """Every node has spoken once, so that the air knows where it is."""
        for node in range(self.scenario.nodes):
            self.say(node, beacon(node))
        for node in range(self.scenario.nodes):
            self.heard(node)

    def close(self) -> None:
        self.server.close()
        for sock in self.air + self.vehicle:
            sock.close()


MakeSwarm = Callable[..., Swarm]


def drained(sock: socket.socket) -> list[bytes]:
    frames = []
    while True:
        try:
            frames.append(sock.recv(4096))
        except BlockingIOError:
            return frames


def beacon(node: int, hops: int = NO_ROUTE) -> bytes:
    message = Beacon(node, 1, 1, 0, 0, 0, 0, hops, 0, 0, 0, 5, 0, 0, 0)
    (payload,) = encode(message, 0.0)
    return FrameWriter(system_id(node), 191).tunnel(payload, payload_type=33200)


def frame(payload: bytes) -> bytes:
    return FrameWriter(1, 191).tunnel(payload, payload_type=33200)


@pytest.fixture
def make_swarm(request: pytest.FixtureRequest) -> MakeSwarm:
    def make(nodes: int = 3, **radio: Any) -> Swarm:
        swarm = Swarm(nodes, **radio)
        request.addfinalizer(swarm.close)
        return swarm

    return make


def test_all_in_range_hear_a_frame_and_nobody_else(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(4)
    swarm.introduce()
    swarm.say(1, frame(b"hello"))
    assert swarm.heard(0) == [frame(b"hello")]
    assert swarm.heard(2) == [frame(b"hello")]
    assert swarm.heard(1) == []
    assert swarm.heard(3) == []


def test_frames_that_share_a_datagram_are_frames_on_the_air(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.introduce()
    before = swarm.server.figures()
    swarm.say(0, frame(b"one") + frame(b"two") + b"noise")
    assert swarm.heard(1) == [frame(b"one"), frame(b"two")]
    assert swarm.server.figures().sent - before.sent == 2


def test_a_lossy_radio_drops_for_each_hearer_and_counts(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(3, loss=1.0)
    swarm.introduce()
    before = swarm.server.figures()
    swarm.say(1, frame(b"hello"))
    assert swarm.heard(0) == swarm.heard(2) == []
    after = swarm.server.figures()
    assert after.dropped - before.dropped == 2
    assert after.received == before.received
    assert after.sent - before.sent == 1


def test_a_doubled_frame_is_heard_twice(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2, duplicate=1.0)
    swarm.introduce()
    swarm.say(0, frame(b"hello"))
    assert swarm.heard(1) == [frame(b"hello"), frame(b"hello")]


def test_latency_holds_frames_back_for_steps(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2, latency_steps=2)
    swarm.introduce()
    for _ in range(2):
        swarm.server.step()
    swarm.heard(1)
    swarm.say(0, frame(b"hello"))
    swarm.server.step()
    assert swarm.heard(1) == []
    swarm.server.step()
    assert swarm.heard(1) == [frame(b"hello")]


def test_a_dead_node_hears_nothing_until_its_successor_speaks(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.introduce()
    swarm.air[1].send(frame(b"last words"))
    swarm.server.off(1)
    assert swarm.heard(0) == [frame(b"last words")]
    swarm.say(0, frame(b"anybody there?"))
    assert swarm.heard(1) == []
    swarm.air[1].close()
    swarm.air[1] = swarm.socket(swarm.server.ports.air[1])
    swarm.say(1, beacon(1))
    swarm.say(0, frame(b"welcome back"))
    assert swarm.heard(1) == [frame(b"welcome back")]


def test_the_flight_controller_says_place_and_reading_and_hears_heartbeats(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.server.look(0.1)
    assert drained(swarm.vehicle[1]) == []
    swarm.vehicle[1].send(FrameWriter(system_id(1), 191).message(companion_heartbeat()))
    swarm.server.wires.poll(PATIENCE_S)
    swarm.server.look(0.2)
    telemetry = Telemetry(system_id(1))
    reader = FrameReader()
    for data in drained(swarm.vehicle[1]):
        for frame in reader.feed(data):
            telemetry.handle(frame, 0.2)
    assert some(telemetry.reading).value == pytest.approx(swarm.server.surroundings.levels[1], rel=1e-6)
    assert telemetry.position is not None
    assert swarm.server.figures().heartbeats == 1


def test_figures_count_what_the_frames_say(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.say(0, beacon(0, hops=0))
    swarm.say(1, beacon(1, hops=7))
    data = [make_datum(DatumId(1, 9, n), 0, 0.0, b"x") for n in range(3)]
    for payload in encode(Data(1, 0, tuple(Handover(n + 1, d) for n, d in enumerate(data))), 0.0):
        swarm.say(1, FrameWriter(2, 191).tunnel(payload, payload_type=33200))
    swarm.say(1, b"noise")
    figures = swarm.server.figures()
    assert figures.data_sent == 3
    assert figures.max_hop_count == 7
    assert figures.malformed == 1
    assert figures.sent == 3


def test_the_air_goes_when_its_parent_has_gone(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    orders, parent = os.pipe()
    os.close(parent)
    try:
        assert serve(swarm.server, orders) is False
    finally:
        os.close(orders)


def test_orders_in_pieces_are_obeyed(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.introduce()
    orders, parent = os.pipe()
    try:
        # More than is read at once, so that a line is cut.
        os.write(parent, b"start\n" + 1000 * b"off 1\n" + b"stop\n")
        assert serve(swarm.server, orders) is True
        swarm.say(0, frame(b"hello"))
        assert swarm.heard(1) == []
        assert swarm.server.started
    finally:
        os.close(orders)
        os.close(parent)


def test_a_late_world_catches_up_and_its_flight_controllers_speak_once(
    make_swarm: MakeSwarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    swarm = make_swarm(2)
    swarm.vehicle[1].send(FrameWriter(system_id(1), 191).message(companion_heartbeat()))
    step_s = swarm.scenario.node.step_s
    orders, parent = os.pipe()
    try:
        os.write(parent, b"start\nstop\n")
        with monkeypatch.context() as patched:
            # At the start, before the first wait, and after it.
            patched.setattr(time, "monotonic", iter([0.0, 0.0, 3.5 * step_s]).__next__)
            assert serve(swarm.server, orders) is True
    finally:
        os.close(orders)
        os.close(parent)
    assert swarm.server.surroundings.t == 3
    assert swarm.server.figures().late_steps == 2
    frames = FrameReader().feed(b"".join(drained(swarm.vehicle[1])))
    assert [frame.message_id for frame in frames].count(NAMED_VALUE_FLOAT) == 1


def test_the_world_stands_still_until_it_is_started(make_swarm: MakeSwarm) -> None:
    swarm = make_swarm(2)
    swarm.server.step()
    assert swarm.server.surroundings.t == 0
    swarm.server.started = True
    swarm.server.step()
    assert swarm.server.surroundings.t == 1


def test_surroundings_are_those_of_virtual_time() -> None:
    from rass_mav.lab.swarm.surroundings import Surroundings
    from rass_mav.lab.swarm.world import World

    scenario = Scenario(
        nodes=9, topology="random-walk", seed=random.randrange(1 << 30), node=NodeSection(step_s=0.1),
        radiation=RadiationSection(drift=0.2),
    )  # fmt: skip
    world, surroundings = World(scenario), Surroundings(scenario)
    for _ in range(5):
        world.step()
        assert surroundings.positions == world.surroundings.positions
        assert surroundings.levels == world.surroundings.levels
        surroundings.step()
