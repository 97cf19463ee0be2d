"""A node and a ground station, in virtual time: bytes in, bytes out, read by pymavlink's own parser."""

from __future__ import annotations

import math
import random
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.agent.ground import VALUE_NAMES
from rass_mav.agent.loading import convert
from rass_mav.agent.parameters import INDEX, PARAMETERS, single
from rass_mav.agent.settings import AgentSettings
from rass_mav.core.cost_routing import CostTable
from rass_mav.core.messages import Beacon
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import MavlinkMessage, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    COMMAND_ACK,
    HEARTBEAT,
    NAMED_VALUE_FLOAT,
    STATUSTEXT,
    autopilot_heartbeat,
    named_value_float,
)
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.store.memory import MemoryStore
from rass_mav.wire import decode

SECTIONS = ("policy", "risk", "routing", "custody", "store", "data", "mavlink", "ground")
GCS = (255, 190)
QUIET = {"values_s": 0, "computer_s": 0}
#: The values that a drone says. What its policy goes by is either a fitness or a cost.
SAID = [name for name in VALUE_NAMES if name != "RASS_COST"]


class Conversation:
    """An agent with a ground station that asks through the autopilot, and with its own hands on the clock."""

    def __init__(self, node_id: int = 7, store: MemoryStore | None = None, **sections: Any) -> None:
        raw = {"node_id": node_id, "base": sections.pop("base", False), "step_s": 1.0}
        raw |= {name: sections.get(name, {}) for name in SECTIONS}
        # Most parameters are weights of this policy.
        raw["policy"] = {"name": "rass", **raw["policy"]}
        raw["ground"] = {**QUIET, **raw["ground"]}
        self.now = 0.0
        self.store = store or MemoryStore(1000 + node_id)
        about = convert(raw, AgentSettings, "test")
        self.agent = Agent(about, self.store, random.Random(1), now=0.0)
        assert self.agent.ground is not None
        self.ground = self.agent.ground
        self.gcs = FrameWriter(*GCS)
        self.parsers = (common.MAVLink(None), common.MAVLink(None))
        self.times: list[float] = []

    def ask(self, message: MavlinkMessage, *, direct: bool = False) -> None:
        data = self.gcs.message(message)
        if direct:
            self.ground.receive(data, self.now)
        else:
            self.agent.vehicle_bytes(data, self.now)

    def commit(self) -> None:
        """What a driver does: the store writes, and what was promised is said."""
        promised, self.ground.promised = self.ground.promised, []
        batch = self.store.take()
        if batch is not None:
            self.store.write(batch)
        for word in promised:
            word()

    def hear(self, until: float | None = None, *, direct: bool = False) -> list[Any]:
        """What arrives at the ground station up to a time (default: half a second from now), woken up as asked."""
        until = self.now + 0.5 if until is None else until
        out = []
        while self.now <= until:
            due = self.agent.tend(self.now)
            frames = (self.agent.to_vehicle, self.ground.to_ground)
            for way, parser in enumerate(self.parsers):
                for data in frames[way]:
                    for message in parser.parse_buffer(data):
                        if way == direct:
                            out.append(message)
                            self.times.append(self.now)
                frames[way].clear()
            assert due > self.now, "or it would be asked for ever"
            self.now = due
        self.now = until
        return [m for m in out if m.get_msgId() != HEARTBEAT]

    def set(self, name: str, value: float, kind: int = mav.REAL32) -> list[Any]:
        self.ask(common.MAVLink_param_set_message(7, 191, name.encode(), value, kind))
        self.commit()
        return self.hear()

    def command(self, command: int, *params: float, component: int = 191) -> list[Any]:
        filled = [*params, *[0.0] * (7 - len(params))]
        self.ask(common.MAVLink_command_long_message(7, component, command, 0, *filled))
        return self.hear()


def values(messages: list[Any]) -> dict[str, float]:
    return {m.param_id: m.param_value for m in messages if m.get_type() == "PARAM_VALUE"}


def kinds(messages: list[Any]) -> list[str]:
    return [m.get_type() for m in messages]


# -- parameters ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [(7, 191), (7, 0), (0, 0)])
@pytest.mark.parametrize("direct", [False, True])
def test_all_parameters_are_listed_paced_the_way_they_were_asked_for(target: tuple[int, int], direct: bool) -> None:
    c = Conversation()
    c.ask(common.MAVLink_param_request_list_message(*target), direct=direct)
    heard = c.hear(2.0, direct=direct)
    assert [m.param_index for m in heard] == list(range(len(PARAMETERS)))
    assert {m.param_count for m in heard} == {len(PARAMETERS)}
    assert {m.param_type for m in heard} == {mav.REAL32}
    assert values(heard)["RASS_BETA"] == 10.0
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in heard} == {(7, 191)}
    assert min(b - a for a, b in pairwise(c.times) if b != a) >= 0.039
    assert c.hear(4.0, direct=not direct) == [], "the other way is left alone"


def test_what_is_for_others_is_not_answered() -> None:
    c = Conversation()
    for target in ((7, 1), (8, 191), (8, 0), (7, 190)):
        c.ask(common.MAVLink_param_request_list_message(*target))
        c.ask(common.MAVLink_param_set_message(*target, b"RASS_ALPHA", 3.0, mav.REAL32))
        c.ask(common.MAVLink_command_long_message(*target, mav.CMD_REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0))
    assert c.hear() == []
    assert c.agent.settings.policy.alpha is None


def test_one_parameter_by_name_and_by_index() -> None:
    c = Conversation()
    c.ask(common.MAVLink_param_request_read_message(7, 191, b"RASS_T", -1))
    c.ask(common.MAVLink_param_request_read_message(7, 191, b"", INDEX["RASS_BETA"]))
    assert values(c.hear()) == {"RASS_T": 1.0, "RASS_BETA": 10.0}
    for name, index in ((b"NOT_MINE", -1), (b"", len(PARAMETERS)), (b"\xff\xfe", -1)):
        c.ask(common.MAVLink_param_request_read_message(7, 191, name, index))
        heard = c.hear()
        assert values(heard) == {}
        assert [m.error for m in heard if m.get_type() == "PARAM_ERROR"] in ([mav.DOES_NOT_EXIST], [])


def test_a_value_is_taken_over_at_once_and_answered_when_it_is_on_disk() -> None:
    c = Conversation()
    c.ask(common.MAVLink_param_set_message(7, 191, b"RASS_ALPHA", 2.5, mav.REAL32))
    assert c.agent.node.policy.potential(2, 0.0, 5) == pytest.approx((1 << 24) / 5.0, abs=1)
    assert c.hear() == [], "nothing is confirmed yet"
    c.commit()
    assert values(c.hear()) == {"RASS_ALPHA": 2.5}
    again = Conversation(store=c.store)
    assert again.agent.settings.policy.alpha == 2.5
    assert again.agent.node.policy.tag == c.agent.node.policy.tag


def test_a_wrong_value_is_refused_with_the_old_one_read_back() -> None:
    c = Conversation()
    c.set("RASS_ALPHA", 2.5)
    for value, kind in ((-1.0, mav.REAL32), (math.nan, mav.REAL32), (math.inf, mav.REAL32), (3.0, 6)):
        heard = c.set("RASS_ALPHA", value, kind)
        assert values(heard) == {"RASS_ALPHA": 2.5}
        assert "STATUSTEXT" in kinds(heard)
    assert c.ground.refused == 4
    assert c.agent.settings.policy.alpha == 2.5
    assert Conversation(store=c.store).agent.settings.policy.alpha == 2.5


def test_what_can_only_be_read() -> None:
    c = Conversation()
    heard = c.set("RASS_NODE_ID", 9.0)
    assert values(heard) == {"RASS_NODE_ID": 7.0}
    if mav.PARAM_ERROR is not None:
        assert [m.error for m in heard if m.get_type() == "PARAM_ERROR"] == [mav.READ_ONLY]
    locked = Conversation(ground={"may_set": False})
    heard = locked.set("RASS_ALPHA", 3.0)
    assert values(heard) == {"RASS_ALPHA": 1.0}
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"] == ["RASS_ALPHA: ground.may_set is false"]
    assert locked.set("NOT_MINE", 3.0, 9)[:1] == [] or mav.PARAM_ERROR is not None


def test_what_changes_with_the_policy_is_said_too() -> None:
    c = Conversation()
    assert values(c.set("RASS_POLICY", 1.0)) == {"RASS_POLICY": 1.0, "RASS_ALPHA": 10.0, "RASS_BETA": 1.0}
    assert c.agent.node.policy.name == "rass-literal"


def test_under_survival_a_new_hop_cost_makes_a_new_routing_table() -> None:
    c = Conversation(policy={"name": "survival"})
    id = c.agent.node.put(b"x", 0.0)
    tag = c.agent.node.policy.tag
    assert values(c.set("RASS_HOP_COST", 0.25)) == {"RASS_HOP_COST": 0.25}
    node = c.agent.node
    assert node.policy.tag != tag
    assert isinstance(node.routing, CostTable)
    assert node.routing.rules == node.policy.costs
    assert list(node.inventory) == [id]
    assert values(c.set("RASS_ALPHA", 2.0)) == {"RASS_ALPHA": 0.0}, "it has no such weight"
    assert values(c.set("RASS_RISK_WORST", 0.5)) == {"RASS_RISK_WORST": 0.5}
    assert c.agent.node is node, "this needs no new beginning"
    assert node.risk.gain == pytest.approx(0.1), "what the file leaves to the policy stays the policy's"
    c.set("RASS_BANDWIDTH", 3.0)
    assert node.bandwidth_items == 3


def test_what_is_forwarded_at_once_and_a_slow_link_outlive_a_new_beginning() -> None:
    c = Conversation(policy={"name": "survival"})
    c.agent.node.pace(9.0, 2, 0.0)
    before = c.agent.node
    c.set("RASS_STEP_S", 2.0)
    node = c.agent.node
    assert node is not before
    # Neighbours may count on what it said last for as long as its turn was; the store knows that.
    assert node.routing.longest_s == pytest.approx(3.5 * 9.0)


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(["rass", "survival"]),
    st.lists(
        st.tuples(st.sampled_from(PARAMETERS), st.floats(width=32) | st.integers(-2, 300).map(float)), max_size=12
    ),
)
def test_whatever_is_set_between_steps_the_node_goes_on_and_remembers(
    policy: str, asked: list[tuple[Any, float]]
) -> None:
    sections = {"policy": {"name": policy}, "risk": {"low": 0.0, "high": 300.0}}
    c = Conversation(**sections)
    held = [c.agent.node.put(bytes([number]), 0.0) for number in range(1, 4)]
    for step, (parameter, value) in enumerate(asked):
        heard = values(c.set(parameter.name, value))
        assert parameter.name in heard
        assert heard[parameter.name] == single(c.ground.in_force()[parameter.name])
        [beacon] = [m for m in map(said, c.agent.step(c.now)) if isinstance(m, Beacon)]
        assert beacon.policy == c.agent.settings.policy.make().tag
        assert 0 <= beacon.risk <= 65535
        assert set(held) <= set(c.agent.node.inventory), f"after step {step}"
    again = Conversation(store=c.store, **sections)
    assert again.agent.settings == c.agent.settings


def said(outgoing: Any) -> Any:
    fields = tunnel_from_datagram(outgoing.frame)
    assert fields is not None
    return decode(fields[5], 0.0)


def test_a_new_scale_counts_for_the_reading_there_is() -> None:
    c = Conversation(risk={"low": 0.0, "high": 300.0, "gain": 0.5})
    autopilot = FrameWriter(7, 1)
    for message in (autopilot_heartbeat(), named_value_float("RAD", 150.0, 1000)):
        c.agent.vehicle_bytes(autopilot.message(message), c.now)
    assert c.agent.node.risk.risk(c.now) == pytest.approx(0.5)
    c.set("RASS_RISK_HIGH", 600.0)
    assert c.agent.node.risk.risk(c.now) == pytest.approx(0.25)
    c.set("RASS_RISK_GAIN", 0.25)
    assert c.agent.node.risk.risk(c.now) == pytest.approx(0.25), "what was averaged stays"
    c.set("RASS_STEP_S", 2.0)
    assert c.agent.node.risk.risk(c.now) == pytest.approx(0.25), "also when the node begins anew"
    c.set("RASS_RISK_STALE", 1.0)
    c.set("RASS_RISK_WORST", 0.75)
    assert c.agent.node.risk.risk(c.now + 5) == 0.75


# -- commands and ping -----------------------------------------------------------------------------------------------


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
    for message_id in (33.0, 99999.0, -1.0, math.nan, 1e30):
        assert acks(c.command(mav.CMD_REQUEST_MESSAGE, message_id)) == [(mav.CMD_REQUEST_MESSAGE, mav.UNSUPPORTED)]


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


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_from_the_ground_do_no_harm(data: bytes, direct: bool) -> None:
    c = Conversation()
    for message_id in (mav.PARAM_SET, mav.PARAM_REQUEST_READ, mav.PING, 76, mav.COMMAND_INT):
        frame = c.gcs.frame(message_id, data[:250] or b"\0")
        if direct:
            c.ground.receive(frame, 0.0)
            c.ground.receive(data, 0.0)
        else:
            c.agent.vehicle_bytes(frame + data, 0.0)
    c.commit()
    c.hear()


# -- what is said unasked --------------------------------------------------------------------------------------------


def test_heartbeats_come_once_a_second_both_ways_however_long_the_steps() -> None:
    c = Conversation()
    c.set("RASS_STEP_S", 60.0)
    beats = [0, 0]
    for _ in range(200):
        due = c.agent.tend(c.now)
        for way, frames in enumerate((c.agent.to_vehicle, c.ground.to_ground)):
            beats[way] += sum(data[7] == HEARTBEAT for data in frames)
            frames.clear()
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
        "RASS_FILL": pytest.approx(1 / 50),
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


# -- who is who --------------------------------------------------------------------------------------------------------


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
    base = Conversation(1, base=True, custody={"receipts": False})
    texts: list[list[str]] = [[], []]
    ids = [c.agent.node.put(b"same bytes", 0.0) for c in (a, b)]
    for step in range(60):
        now = float(step)
        frames = {c: [o.frame for o in c.agent.step(now)] for c in (a, b, base)}
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
        assert whole.count("another node with node id 5") == 2, "in the first and in the 31st second"
        assert epoch in whole
