"""A node and a ground station: commands, what is said unasked, and who is who."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.outgoing import Way
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import COMMAND_ACK, HEARTBEAT, NAMED_VALUE_FLOAT, STATUSTEXT
from rass_mav.store.memory import MemoryStore
from tests.telemetry import named_value_float

from .conversation import GCS, SAID, Conversation, kinds


def acks(messages: list[Any]) -> list[tuple[int, int]]:
    assert all((m.target_system, m.target_component) == GCS for m in messages if m.get_msgId() == COMMAND_ACK)
    return [(m.command, m.result) for m in messages if m.get_msgId() == COMMAND_ACK]


def test_messages_can_be_asked_for() -> None:
    c = Conversation()
    c.ground.computer = lambda: mav.ComputerStatus(5.0)
    for message_id in (mav.AUTOPILOT_VERSION, mav.ONBOARD_COMPUTER_STATUS, NAMED_VALUE_FLOAT):
        heard = c.command(mav.CMD_REQUEST_MESSAGE, message_id)
        assert acks(heard) == [(mav.CMD_REQUEST_MESSAGE, mav.ACCEPTED)]
        assert message_id in [m.get_msgId() for m in heard[1:]]
    c.ask(common.MAVLink_command_int_message(7, 191, 0, mav.CMD_REQUEST_MESSAGE, 0, 0, mav.AUTOPILOT_VERSION, *[0] * 6))
    assert kinds(c.hear()) == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    for unknown in (33.0, 99999.0, -1.0, math.nan, 1e30):
        assert acks(c.command(mav.CMD_REQUEST_MESSAGE, unknown)) == [(mav.CMD_REQUEST_MESSAGE, mav.UNSUPPORTED)]


def test_other_commands_are_unsupported_unless_they_are_for_all() -> None:
    c = Conversation()
    arm = common.MAV_CMD_COMPONENT_ARM_DISARM
    assert acks(c.command(arm, 1.0)) == [(arm, mav.UNSUPPORTED)]
    assert c.command(arm, 1.0, component=0) == [], "the autopilot may well know it"
    assert acks(c.command(mav.CMD_REQUEST_MESSAGE, mav.AUTOPILOT_VERSION, component=0))
    assert c.command(mav.CMD_REQUEST_MESSAGE, 33.0, component=0) == []


def test_the_rate_of_values_can_be_set_and_asked_for() -> None:
    c = Conversation(ground={"values_s": 10.0})
    assert len(c.hear(4.9)) == len(SAID)
    assert acks(c.command(mav.CMD_SET_MESSAGE_INTERVAL, NAMED_VALUE_FLOAT, 1e6)) == [(511, mav.ACCEPTED)]
    begun = c.now
    assert len(c.hear(begun + 5.0)) == 5 * len(SAID)
    heard = c.command(mav.CMD_GET_MESSAGE_INTERVAL, NAMED_VALUE_FLOAT)
    assert [m.interval_us for m in heard if m.get_msgId() == mav.MESSAGE_INTERVAL] == [1_000_000]
    for micros in (1.0, 1e5, -7.0, math.nan, math.inf, 1e12):
        heard = c.command(mav.CMD_SET_MESSAGE_INTERVAL, NAMED_VALUE_FLOAT, micros)
        assert acks(heard) == [(511, mav.DENIED)], "the same rate stays"
    assert acks(c.command(mav.CMD_SET_MESSAGE_INTERVAL, NAMED_VALUE_FLOAT, -1.0)) == [(511, mav.ACCEPTED)]
    assert c.hear(c.now + 30.0) == []
    c.command(mav.CMD_SET_MESSAGE_INTERVAL, NAMED_VALUE_FLOAT, 0.0)
    assert len(c.hear(c.now + 30.0)) in (3 * len(SAID), 4 * len(SAID)), "every ten seconds again"
    assert acks(c.command(mav.CMD_SET_MESSAGE_INTERVAL, HEARTBEAT, 5e6)) == [(511, mav.DENIED)]
    assert acks(c.command(mav.CMD_SET_MESSAGE_INTERVAL, 33.0, 1e6)) == [(511, mav.UNSUPPORTED)]


def test_a_ping_comes_back_to_who_sent_it_and_an_answer_does_not() -> None:
    c = Conversation()
    c.ask(common.MAVLink_ping_message(123456, 9, 0, 0))
    [answer] = c.hear()
    assert (answer.time_usec, answer.seq) == (123456, 9)
    assert (answer.target_system, answer.target_component) == GCS
    c.ask(common.MAVLink_ping_message(123456, 9, 7, 191))
    assert c.hear() == []


def open_file(system: int, component: int) -> MavlinkMessage:
    """What MAVProxy asks first on `param fetch`."""
    name = b"@PARAM/param.pck?withdefaults=1"
    request = struct.pack("<HBBBBBBI", 8, 2, common.MAV_FTP_OPCODE_OPENFILERO, len(name), 0, 0, 0, 0) + name
    return common.MAVLink_file_transfer_protocol_message(0, system, component, request.ljust(251, b"\0"))


@pytest.mark.parametrize("direct", [False, True])
def test_a_file_transfer_is_refused_at_once(direct: bool) -> None:
    c = Conversation()
    c.ask(open_file(7, 191), direct=direct)
    [answer] = c.hear(0.1, direct=direct)
    assert (answer.target_system, answer.target_component) == GCS
    header = struct.unpack_from("<HBBBBBBIB", bytes(answer.payload))
    assert header == (9, 2, common.MAV_FTP_OPCODE_NAK, 1, 4, 0, 0, 0, common.MAV_FTP_ERR_UNKNOWNCOMMAND)


@pytest.mark.parametrize("target", [(0, 0), (7, 0), (7, 1), (8, 191)])
def test_a_file_transfer_with_somebody_else_is_left_alone(target: tuple[int, int]) -> None:
    c = Conversation()
    c.ask(open_file(*target))
    assert c.hear() == []


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_from_the_ground_do_no_harm(data: bytes, direct: bool) -> None:
    c = Conversation()
    asked = (mav.PARAM_SET, mav.PARAM_REQUEST_READ, mav.PING, 76, mav.COMMAND_INT, mav.FILE_TRANSFER_PROTOCOL)
    for message_id in asked:
        frame = c.gcs.frame(message_id, data[:250] or b"\0")
        if direct:
            c.ground.receive(frame, 0.0)
            c.ground.receive(data, 0.0)
        else:
            c.agent.vehicle_bytes(frame + data, 0.0)
    c.commit()
    c.hear()


def test_heartbeats_come_once_a_second_both_ways_however_long_the_steps() -> None:
    c = Conversation()
    c.set("RASS_STEP_S", 60.0)
    beats = [0, 0]
    for _ in range(200):
        frames, due = c.agent.tend(c.now)
        for outgoing in frames:
            beats[outgoing.way] += outgoing.frame[7] == HEARTBEAT
        if due > 30.0:
            break
        c.now = due
    assert beats == [30, 30]


def test_values_tell_how_the_node_does() -> None:
    c = Conversation(ground={"values_s": 10.0})
    c.agent.node.put(b"x", 0.0)
    c.agent.step(0.0)
    heard = {m.name: m.value for m in c.hear() if m.get_msgId() == NAMED_VALUE_FLOAT}
    assert heard == {
        "RASS_PHI": pytest.approx(1 / 265, rel=1e-4),
        "RASS_HOPS": -1.0,
        "RASS_RISK": 1.0,
        "RASS_FILL": pytest.approx(1 / c.agent.settings.store.most_items),
    }
    alone = Conversation(policy={"name": "survival"}, ground={"values_s": 10.0})
    alone.agent.step(0.0)
    heard = {m.name: m.value for m in alone.hear() if m.get_msgId() == NAMED_VALUE_FLOAT}
    assert heard["RASS_COST"] == -1.0, "it waits until nobody can remember what it announced in an earlier life"
    alone.agent.step(20.0)
    alone.now = 20.0
    heard = {m.name: m.value for m in alone.hear(40.0) if m.get_msgId() == NAMED_VALUE_FLOAT}
    assert "RASS_PHI" not in heard
    # A hundred hops' worth at certain death: this is what staying costs.
    assert heard["RASS_COST"] == pytest.approx(100 * (0.05 - math.log(0.001)), rel=1e-3)
    base = Conversation(base=True, ground={"values_s": 10.0})
    base.agent.step(0.0)
    heard = {m.name: m.value for m in base.hear() if m.get_msgId() == NAMED_VALUE_FLOAT}
    assert heard == {"RASS_HOPS": 0.0, "RASS_RISK": 1.0}


def test_a_value_that_px4_repeats_as_its_own_is_no_reading() -> None:
    """FIRMWARE: PX4 says a companion's NAMED_VALUE_FLOAT again, on every link, as if it had measured it."""
    c = Conversation(ground={"values_s": 10.0}, mavlink={"autopilot_id": 7})
    autopilot = FrameWriter(7, 1)
    c.agent.vehicle_bytes(autopilot.message(named_value_float("RAD", 0.25, 1000)), 0.0)
    c.agent.step(0.0)
    own = [m for m in c.hear() if m.get_msgId() == NAMED_VALUE_FLOAT]
    assert {m.name for m in own} == set(SAID)
    for message in own:
        c.agent.vehicle_bytes(autopilot.message(message), 0.5)
    assert c.agent.telemetry.reading is not None
    assert (c.agent.telemetry.reading.value, c.agent.telemetry.reading.at) == (0.25, 0.0)
    assert c.agent.node.risk.risk(0.5) == 0.25


def test_own_frames_that_come_back_are_not_answered() -> None:
    c = Conversation()
    own = FrameWriter(7, 191)
    c.agent.vehicle_bytes(own.message(common.MAVLink_param_request_list_message(0, 0)), 0.0)
    c.agent.vehicle_bytes(own.message(common.MAVLink_ping_message(1, 1, 0, 0)), 0.0)
    assert c.hear() == []


def test_the_system_id_is_the_autopilots_and_is_remembered() -> None:
    first = Conversation(node_id=40)
    assert first.agent.vehicle_writer.system_id == 40
    first.agent.vehicle_bytes(FrameWriter(12, 1).message(autopilot_heartbeat()), 0.0)
    first.ask(common.MAVLink_param_request_read_message(12, 191, b"RASS_T", -1), direct=True)
    [heard] = first.hear(direct=True)
    assert heard.get_srcSystem() == 12
    first.commit()
    again = Conversation(node_id=40, store=first.store)
    assert again.agent.vehicle_writer.system_id == 12, "before anything is heard"
    fixed = Conversation(node_id=40, store=first.store, mavlink={"system_id": 9})
    assert fixed.agent.vehicle_writer.system_id == 9


def test_two_nodes_with_one_id_both_tell_the_ground_and_their_data_stay_apart() -> None:
    still = {"interval_steps": 0}
    a, b = Conversation(5, MemoryStore(0xAAAA), data=still), Conversation(5, MemoryStore(0xBBBB), data=still)
    base = Conversation(1, base=True, without=("receipts",))
    texts: list[list[str]] = [[], []]
    ids = [c.agent.node.put(b"same bytes", 0.0) for c in (a, b)]
    for step in range(60):
        now = float(step)
        frames = {c: [o.frame for o in c.agent.step(now) if o.way is Way.NEIGHBOURS] for c in (a, b, base)}
        for speaker in (a, b, base):
            for hearer in (a, b, base):
                if hearer is not speaker:
                    for frame in frames[speaker]:
                        # Only the base answers: the twins take each other for their own echo.
                        for answer in hearer.agent.peer_bytes(frame, now):
                            speaker.agent.peer_bytes(answer.frame, now)
        for c, told in zip((a, b), texts, strict=True):
            c.now = now
            told += [m.text for m in c.hear(now + 0.9) if m.get_msgId() == STATUSTEXT and m.severity == 2]
    assert sorted(base.store.ids()) == sorted(ids), "the epoch keeps them apart"
    assert ids[0].origin == ids[1].origin
    for told, epoch in zip(texts, ("0000bbbb", "0000aaaa"), strict=True):
        whole = "".join(told)
        assert whole.count("two nodes have node id 5") == 2, "in the first and in the 31st second"
        assert epoch in whole
