"""One whole node without input and output."""

from __future__ import annotations

import random
from typing import Any

import pytest

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Way
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.messages import BROADCAST, Beacon, Committed, Data, Handover, Put
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.core.replicas.replicas import Replicas
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat, global_position_int_payload, local_position_ned
from rass_mav.mavlink.dialect import MavlinkMessage
from rass_mav.mavlink.frames import FLAG_SIGNED, FrameWriter
from rass_mav.mavlink.messages import GLOBAL_POSITION_INT, HEARTBEAT, NAMED_VALUE_FLOAT, STATUSTEXT, parse
from rass_mav.mavlink.signing import Signer
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.wire.measurement import Measurement, decode_measurement
from tests.some import some
from tests.telemetry import global_position_int, gps_raw_int, named_value_float

from .build import fit_beacon, heard, make, on, said, step, to_vehicle


def test_a_step_says_a_beacon_to_all_and_a_heartbeat_to_the_vehicle() -> None:
    agent = make(3)
    frames = agent.step(0.0)
    [outgoing] = on(Way.NEIGHBOURS, frames)
    assert (outgoing.target, outgoing.promises) == (BROADCAST, False)
    assert isinstance(said([outgoing])[0], Beacon)
    [frame] = to_vehicle(frames)
    heartbeat = parse(frame)
    assert (frame.message_id, frame.component_id) == (HEARTBEAT, 191)
    assert (heartbeat.type, heartbeat.autopilot) == (18, 8)  # ONBOARD_CONTROLLER, INVALID
    assert to_vehicle(agent.step(0.5)) == []
    assert [frame.message_id for frame in to_vehicle(agent.step(1.0))] == [HEARTBEAT]


def test_telemetry_becomes_risk_and_a_measurement() -> None:
    agent = make(3, risk={"low": 100.0, "high": 300.0})
    vehicle = FrameWriter(7, 1)
    agent.step(0.0)
    assert agent.node.risk.risk(0.0) == 1.0, "unknown risk is the worst"
    for message in (
        autopilot_heartbeat(),
        global_position_int(45.5, -73.6, 120.0, 20.0, 1000),
        named_value_float("RAD", 150.0, 1000),
    ):
        agent.vehicle_bytes(vehicle.message(message), 1.0)
    assert agent.node.risk.risk(1.0) == pytest.approx(0.25)
    id = some(agent.measure(1.0))
    stored = some(agent.store.get(id))
    measurement = decode_measurement(stored.payload)
    assert measurement.latitude == pytest.approx(45.5)
    assert measurement.longitude == pytest.approx(-73.6)
    assert (measurement.altitude, measurement.reading) == (120.0, 150.0)
    assert agent.peers.writer.system_id == 7, "the system id is taken from the autopilot"
    # Ten seconds later the reading is stale: unknown again.
    id = some(agent.measure(12.0))
    stored = some(agent.store.get(id))
    assert decode_measurement(stored.payload).reading is None
    assert agent.node.risk.risk(12.0) == 1.0


def measured(agent: Agent, now: float) -> Measurement:
    id = some(agent.measure(now))
    stored = some(agent.store.get(id))
    return decode_measurement(stored.payload)


def test_without_a_position_on_earth_the_local_one_counts() -> None:
    agent = make(3, mavlink={"autopilot_id": 7})
    vehicle = FrameWriter(7, 1)
    assert measured(agent, 0.0)[:3] == (None, None, None)
    agent.vehicle_bytes(vehicle.message(local_position_ned(1.5, -2.25, -10.0, 1000)), 1.0)
    assert measured(agent, 1.0).local == (1.5, -2.25, -10.0)
    agent.vehicle_bytes(vehicle.message(global_position_int(45.5, -73.6, 120.0, 20.0, 1000)), 2.0)
    assert (measured(agent, 2.0).latitude, measured(agent, 2.0).local) == (45.5, None)
    # The autopilot has fallen silent: where the vehicle is now, nobody knows.
    silent = measured(agent, 13.0)
    assert (silent.latitude, silent.local) == (None, None)


@pytest.mark.parametrize("unit", [None, "usvh", "counts"])
def test_a_measurement_tells_the_unit_of_its_reading(unit: str | None) -> None:
    agent = make(3, mavlink={"autopilot_id": 7}, risk={"unit": unit})
    assert measured(agent, 0.0).unit is None, "there is no reading"
    agent.vehicle_bytes(FrameWriter(7, 1).message(named_value_float("RAD", 2.5, 1000)), 1.0)
    assert (measured(agent, 1.0).reading, measured(agent, 1.0).unit) == (2.5, unit)


def test_a_measurement_bounds_the_error_of_its_position() -> None:
    agent = make(3, mavlink={"autopilot_id": 7})
    vehicle = FrameWriter(7, 1)

    def hear(message: MavlinkMessage, now: float) -> None:
        agent.vehicle_bytes(vehicle.message(message), now)

    hear(gps_raw_int(1500), 0.0)
    hear(local_position_ned(1.5, -2.25, -10.0, 1000), 0.0)
    assert measured(agent, 0.0).error_m is None, "there is no position on Earth"
    hear(global_position_int(45.5, -73.6, 120.0, 20.0, 1000), 1.0)
    assert measured(agent, 3.0).error_m == 3.0, "it hovers"
    payload = global_position_int_payload(45.5, -73.6, 120.0, 20.0, 1000, velocity=(3.0, -4.0, 9.0))
    agent.vehicle_bytes(vehicle.frame(GLOBAL_POSITION_INT, payload), 4.0)
    assert measured(agent, 4.0).error_m == 3.0
    assert measured(agent, 6.0).error_m == pytest.approx(3.0 + 5.0 * 2.0)
    assert measured(agent, 10.5).error_m is None, "the accuracy is old"
    hear(gps_raw_int(1500), 11.0)
    assert measured(agent, 11.0).error_m == pytest.approx(3.0 + 5.0 * 7.0)
    hear(gps_raw_int(0), 11.0)
    assert measured(agent, 11.0).error_m is None, "the autopilot does not know it"


@pytest.mark.parametrize("size", [20, 22, 24, 60])
def test_random_bytes_fill_up_what_the_measurement_leaves(size: int) -> None:
    agent = make(3, mavlink={"autopilot_id": 7}, data={"bytes": size}, risk={"unit": "cpm"})
    vehicle = FrameWriter(7, 1)
    for message in (
        named_value_float("RAD", 2.5, 1000),
        gps_raw_int(1500),
        global_position_int(45.5, -73.6, 120.0, 20.0, 1000),
    ):
        agent.vehicle_bytes(vehicle.message(message), 1.0)
    id = some(agent.measure(1.0))
    stored = some(agent.store.get(id))
    assert len(stored.payload) == max(size, 23)
    assert decode_measurement(stored.payload)[6:] == ("cpm", 3.0)


def test_a_reading_of_somebody_else_is_not_ours() -> None:
    agent = make(3, mavlink={"autopilot_id": 7})
    for system, component in ((8, 1), (7, 191), (7, 2)):
        agent.vehicle_bytes(FrameWriter(system, component).message(named_value_float("RAD", 0.1, 1000)), 0.0)
    assert agent.node.risk.risk(0.0) == 1.0
    assert agent.telemetry.ignored.keys() == {(8, 1, "RAD"), (7, 191, "RAD"), (7, 2, "RAD")}


def test_a_datagram_that_is_cut_off_does_not_spoil_the_next_one() -> None:
    a, b = make(1), make(2)
    [beacon] = step(a, 0.0)
    b.peer_bytes(beacon.frame[:-5], 0.0)
    b.peer_bytes(beacon.frame, 0.0)
    assert list(b.node.routing.neighbours) == [1]
    # The rest of it may look like the beginning of another frame.
    assert b.peers.reader.malformed >= 1


def test_two_frames_in_one_datagram_and_garbage_between() -> None:
    a, b, c = make(1), make(2), make(3)
    c.peer_bytes(step(a, 0.0)[0].frame + b"\xfd\x00garbage" + step(b, 0.0)[0].frame, 0.0)
    assert sorted(c.node.routing.neighbours) == [1, 2]


def test_tunnel_frames_for_others_are_left_alone() -> None:
    a, b = make(1), make(2)
    [beacon] = step(a, 0.0)
    payload = some(tunnel_from_datagram(beacon.frame))
    writer = FrameWriter(9, 191)
    strangers = [
        writer.tunnel(payload[5], payload_type=33201),
        writer.tunnel(payload[5], payload_type=33200, target_system=77),
        writer.tunnel(payload[5], payload_type=33200, target_system=b.peers.writer.system_id, target_component=5),
    ]
    for frame in strangers:
        assert not b.peer_bytes(frame, 0.0)
    assert not b.node.routing.neighbours
    assert b.peers.foreign == 1
    ours = writer.tunnel(payload[5], payload_type=33200, target_system=b.peers.writer.system_id, target_component=191)
    b.peer_bytes(ours, 0.0)
    assert list(b.node.routing.neighbours) == [1]


def test_garbage_in_a_tunnel_is_counted_and_survived() -> None:
    agent = make(1)
    writer = FrameWriter(9, 191)
    agent.peer_bytes(writer.tunnel(b"\x21short", payload_type=33200), 0.0)
    agent.peer_bytes(writer.tunnel(b"\x41" + bytes(60), payload_type=33200), 0.0)
    agent.peer_bytes(writer.tunnel(b"", payload_type=33200), 0.0)
    assert (agent.peers.malformed, agent.peers.foreign) == (2, 1)


def test_a_second_node_with_our_id_is_told_to_the_ground() -> None:
    one, other = make(5), make(5)
    other.node.store.set_meta("x", 1)
    twin = build_node(other.settings, MemoryStore(4242), random.Random(9), now=0.0, newborn=True)
    [beacon] = step(twin, 0.0)
    one.peer_bytes(beacon.frame, 0.0)
    texts = [parse(frame).text for frame in to_vehicle(one.step(1.0)) if frame.message_id == STATUSTEXT]
    assert any("node id 5" in (text if isinstance(text, str) else text.decode()) for text in texts), texts
    # Said once, not at every step.
    one.peer_bytes(step(twin, 1.0)[0].frame, 1.0)
    assert [f for f in to_vehicle(one.step(2.0)) if f.message_id == STATUSTEXT] == []


def test_an_echo_of_our_own_beacon_is_no_rival() -> None:
    agent = make(5)
    agent.peer_bytes(step(agent, 0.0)[0].frame, 0.0)
    assert not agent.node.alarms.rivals
    assert agent.node.alarms.echoes == 1
    assert agent.node.alarms.clones == 0


def test_beacons_in_our_name_that_we_have_not_sent_come_from_a_copy_of_our_store() -> None:
    agent, twin = make(5), make(5)
    step(twin, 0.0)
    for second in range(3):
        sent = step(agent, float(second))
        agent.peer_bytes(sent[0].frame, float(second))
    last = said(sent)[0].number
    [beacon] = [message for message in said(twin.step(1.0), 1.0) if isinstance(message, Beacon)]
    for number in (last + 1, last - 3):
        [forged] = twin.peers.frames([beacon._replace(number=number & 0xFFFF)], twin.store, 1.0)
        agent.peer_bytes(forged.frame, 3.0)
    alarms = agent.node.alarms
    assert (alarms.echoes, alarms.clones, alarms.rivals) == (3, 2, {})


def test_a_full_node_tells_the_ground_and_goes_on() -> None:
    agent = make(4, store={"capacity_items": 1}, data={"interval_steps": 1})
    agent.reading(1.0, 0.0)
    heard = to_vehicle([outgoing for t in range(4) for outgoing in agent.step(float(t))])
    texts = [parse(frame).text for frame in heard if frame.message_id == STATUSTEXT]
    assert len(texts) == 1
    assert agent.store.counters()["overflow"] == 3


def test_what_rests_on_an_unfinished_commit_is_marked() -> None:
    class Slow(MemoryStore):
        """Nothing is ever on disk."""

        unwritten = True

        def durable(self, id: Any) -> bool:
            return False

    base, drone = make(1, base=True), make(2)
    slow = build_node(drone.settings, Slow(7), random.Random(2), now=0.0, newborn=True)
    for node in (drone, slow):
        node.measure(0.0)
        node.peer_bytes(step(base, 0.0)[0].frame, 0.0)
        beacon, data = step(node, 1.0)
        assert isinstance(said([data])[0], Data)
        assert (beacon.promises, data.promises) == (False, node is slow)
        forwarder = build_node(base.settings, Slow(8) if node is slow else MemoryStore(8), random.Random(1), now=0.0)
        [answer] = forwarder.peer_bytes(data.frame, 1.0)
        assert answer.promises is (node is slow)


@pytest.mark.parametrize("broadcast", [True, False])
@pytest.mark.parametrize("forward", ["step", "immediate"])
def test_data_move_on_at_once_or_in_the_next_step(forward: str, broadcast: bool) -> None:
    agent = make(3, forward=forward, data={"interval_steps": 1, "due": "together", "until_step": 1})
    agent.answers.broadcast = broadcast
    agent.reading(1.0, 0.0)
    heard(agent, fit_beacon(agent, 2, 0), 0.0)
    first = [type(m) for m in said(agent.step(0.0))]
    d = make_datum(DatumId(4, 5, 6), 0, 0.0, b"x")
    then = [type(m) for m in said(heard(agent, Data(4, 3, (Handover(7, d),)), 0.1))]
    agent.node.put(b"y", 0.2)
    put = [type(m) for m in said(agent.forward(0.2))]
    if forward == "immediate":
        # Its own measurement, what came in, what was put. Who gave it the second hears it go, or is answered.
        assert (first, then, put) == ([Beacon, Data], [Data] if broadcast else [Committed, Data], [Data])
    else:
        assert (first, then, put) == ([Beacon], [Committed], [])


def test_named_value_floats_of_other_names_are_ignored() -> None:
    agent = make(3, mavlink={"reading_name": "CPM", "autopilot_id": 1})
    writer = FrameWriter(1, 1)
    frame = writer.message(named_value_float("RAD", 1.0, 1000))
    assert frame[7] == NAMED_VALUE_FLOAT
    agent.vehicle_bytes(frame, 0.0)
    assert agent.telemetry.reading is None
    agent.vehicle_bytes(writer.message(named_value_float("CPM", 12.0, 1000)), 0.0)
    assert agent.telemetry.reading is not None


def test_with_a_sensor_of_its_own_the_autopilots_reading_is_not_believed() -> None:
    agent = make(3, sensor_unit="cpm", risk={"low": 0.0, "high": 10.0})
    vehicle = FrameWriter(7, 1)
    for message in (autopilot_heartbeat(), named_value_float("RAD", 9.0, 1000)):
        agent.vehicle_bytes(vehicle.message(message), 1.0)
    assert (agent.node.risk.risk(1.0), measured(agent, 1.0).reading) == (1.0, None)
    agent.reading(2.5, 1.5)
    assert (agent.node.risk.risk(2.0), measured(agent, 2.0).reading) == (0.25, 2.5)
    # It falls silent.
    assert (agent.node.risk.risk(12.0), measured(agent, 12.0).reading) == (1.0, None)


def test_what_is_signed_is_read_like_all_else_and_answered_unsigned() -> None:
    """Autopilots and neighbours may sign. A node has no key: it checks nothing, and signs nothing."""
    agent = make(7, data={"interval_steps": 0})
    signed = FrameWriter(7, 1, Signer(bytes(range(32)), 0, 1))
    for message in (autopilot_heartbeat(), named_value_float("RAD", 0.25, 1)):
        agent.vehicle_bytes(signed.message(message), 0.0)
    assert agent.node.risk.risk(0.0) == 0.25
    neighbour = make(8, base=True)
    neighbour.peers.writer = FrameWriter(8, 191, Signer(bytes(range(32)), 1, 1))
    for outgoing in step(neighbour, 0.0):
        assert outgoing.frame[2] & FLAG_SIGNED
        agent.peer_bytes(outgoing.frame, 0.0)
    agent.node.put(b"x", 0.0)
    answers = step(agent, 1.0)
    assert {type(message) for message in said(answers)} == {Beacon, Data}, "it has a neighbour"
    assert not any(outgoing.frame[2] & FLAG_SIGNED for outgoing in answers)


def test_under_stigmergy_no_bandwidth_is_kept_for_replica_copies() -> None:
    agent = make(3, forward="immediate", policy={"name": "stigmergy"}, store={"bandwidth_items": 10})
    agent.step(0.0)
    beacon = Beacon(9, 4, 0, 0, 9, 4, 1, 0, 0, 0, 0, 50, agent.node.policy.tag, POTENTIAL_ONE, 0)
    for _ in range(12):
        agent.node.put(b"reading", 0.5)
    agent.node.receive(beacon, 0.5)
    assert sum(isinstance(message, Put) for message in said(agent.step(1.0), 1.0)) == 10


@pytest.mark.parametrize(
    ("base", "sections", "replicas"),
    [
        (False, {}, True),
        (True, {}, False),
        (False, {"policy": {"name": "stigmergy"}}, False),
        (True, {"policy": {"name": "stigmergy"}}, False),
        (False, {"custody": {"mode": "none"}}, False),
        (False, {"custody": {"replicas": False}}, False),
        (False, {"policy": {"name": "stigmergy"}, "custody": {"replicas": True}}, False),
    ],
)
def test_replica_copies_are_kept_by_drones_that_hand_over_with_custody(
    base: bool, sections: dict[str, Any], replicas: bool
) -> None:
    agent = make(3, base=base, **sections)
    keeps = isinstance(agent.node, Node) and isinstance(agent.node.replicas, Replicas)
    assert keeps is replicas
