"""A node and a ground station: parameters are listed, read and set."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.agent.settings import GroundSettings
from rass_mav.core.messages import Beacon
from rass_mav.core.routes.ranks import ByCost
from rass_mav.lab.swarm.autopilot import autopilot_heartbeat
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.component import single
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.station.ground import MOST_LISTS_10S, MOST_SETS_S, REBIRTH_S
from rass_mav.station.parameters import INDEX, PARAMETERS
from rass_mav.wire import decode
from tests.core.durable import DurableStore
from tests.extent import examples
from tests.some import some
from tests.telemetry import named_value_float

from .conversation import Conversation, kinds, values


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
    c = Conversation(store=DurableStore(7))
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
    assert locked.set("NOT_MINE", 3.0, 9)[:1] == [] or mav.PARAM_ERROR is not None


@pytest.mark.parametrize(("key", "direct"), [("may_set", True), ("may_set_by_radio", False)])
def test_each_way_has_its_own_key(key: str, direct: bool) -> None:
    everything = {"may_set": True, "may_set_by_radio": True}
    locked = Conversation(ground={**everything, key: False})
    heard = locked.set("RASS_ALPHA", 3.0, direct=direct)
    assert values(heard) == {"RASS_ALPHA": 1.0}
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"] == [f"RASS_ALPHA: ground.{key} is false"]
    if mav.PARAM_ERROR is not None:
        assert [m.error for m in heard if m.get_type() == "PARAM_ERROR"] == [mav.PERMISSION_DENIED]
    open_ = Conversation(ground={"may_set": False, "may_set_by_radio": False, key: True})
    assert values(open_.set("RASS_ALPHA", 3.0, direct=direct)) == {"RASS_ALPHA": 3.0}


def test_by_radio_nothing_can_be_set_unless_the_file_says_so() -> None:
    assert not GroundSettings().may_set_by_radio
    assert GroundSettings().may_set


@pytest.mark.no_cover
@pytest.mark.parametrize("direct", [False, True])
def test_a_flood_of_changes_leaves_the_node_its_routes(direct: bool) -> None:
    c = Conversation()
    ways = [1.0, 2.0]
    nodes = {id(c.agent.node): c.agent.node}
    for number in range(180 * 20):
        c.now = number / 180
        message = common.MAVLink_param_set_message(7, 191, b"RASS_STEP_S", ways[number % 2], mav.REAL32)
        c.ask(message, direct=direct)
        nodes[id(c.agent.node)] = c.agent.node
    # The first one, and one in 5 s: 2.0 after 1.0 after ... .
    assert 2 <= len(nodes) <= 1 + 20 / REBIRTH_S
    assert c.ground.dropped >= (180 - MOST_SETS_S) * 19
    assert c.ground.refused <= MOST_SETS_S * 20


def test_what_comes_too_soon_after_a_new_beginning_is_refused_and_works_later() -> None:
    c = Conversation()
    assert values(c.set("RASS_STEP_S", 2.0)) == {"RASS_STEP_S": 2.0}
    heard = c.set("RASS_POLICY", 1.0)
    assert values(heard) == {"RASS_POLICY": 0.0}
    assert "try again in 5 s" in " ".join(m.text for m in heard if m.get_type() == "STATUSTEXT")
    assert values(c.set("RASS_ALPHA", 3.0)) == {"RASS_ALPHA": 3.0}, "weights need no new beginning"
    c.hear(c.now + REBIRTH_S)
    assert values(c.set("RASS_POLICY", 1.0))["RASS_POLICY"] == 1.0


def test_one_way_that_is_flooded_leaves_the_other_free() -> None:
    c = Conversation()
    for _ in range(100):
        c.ask(common.MAVLink_param_set_message(7, 191, b"RASS_T", -1.0, mav.REAL32))
    assert values(c.set("RASS_ALPHA", 3.0, direct=True)) == {"RASS_ALPHA": 3.0}


def test_a_flood_of_listings_leaves_room_on_the_air() -> None:
    c = Conversation()
    said = 0
    for number in range(60 * 20):
        c.ask(common.MAVLink_param_request_list_message(7, 191))
        said += len(c.hear((number + 1) / 20))
    assert said <= (60 / 10 + 1) * MOST_LISTS_10S * len(PARAMETERS)
    assert c.ground.dropped >= 60 * 20 - (60 / 10 + 1) * MOST_LISTS_10S


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
    assert isinstance(node.routing.rank, ByCost)
    assert node.routing.rank.rules == node.policy.costs
    assert list(node.holdings.custody) == [id]
    assert values(c.set("RASS_ALPHA", 2.0)) == {"RASS_ALPHA": 0.0}, "it has no such weight"
    assert values(c.set("RASS_RISK_WORST", 0.5)) == {"RASS_RISK_WORST": 0.5}
    assert c.agent.node is node, "this needs no new beginning"
    assert node.risk.gain == pytest.approx(0.1), "what the file leaves to the policy stays the policy's"
    c.set("RASS_BANDWIDTH", 3.0)
    assert node.pace.items == 3


def test_what_is_forwarded_at_once_and_a_slow_link_outlive_a_new_beginning() -> None:
    c = Conversation(policy={"name": "survival"})
    c.agent.node.keep_pace(9.0, 2, 0.0)
    before = c.agent.node
    c.set("RASS_STEP_S", 2.0)
    node = c.agent.node
    assert node is not before
    # Neighbours may count on what it said last for as long as its turn was; the store knows that.
    assert node.routing.longest_s == pytest.approx(3.5 * 9.0)


@pytest.mark.no_cover
@settings(max_examples=examples(50), deadline=None)
@given(
    st.sampled_from(["rass", "survival"]),
    st.lists(
        st.tuples(st.sampled_from(PARAMETERS), st.floats(width=32) | st.integers(-2, 300).map(float)), max_size=12
    ),
)
def test_whatever_is_set_between_steps_the_node_goes_on_and_remembers(
    policy: str, asked: list[tuple[Any, float]]
) -> None:
    sections: dict[str, Any] = {"policy": {"name": policy}, "risk": {"low": 0.0, "high": 300.0}}
    c = Conversation(**sections)
    held = [c.agent.node.put(bytes([number]), 0.0) for number in range(1, 4)]
    for step, (parameter, value) in enumerate(asked):
        heard = values(c.set(parameter.name, value))
        assert parameter.name in heard
        assert heard[parameter.name] == single(c.ground.in_force()[parameter.name])
        [beacon] = [m for m in map(said, c.agent.step(c.now)) if isinstance(m, Beacon)]
        assert beacon.policy == c.agent.settings.policy.make().tag
        assert 0 <= beacon.risk <= 65535
        assert set(held) <= set(c.agent.node.holdings.custody), f"after step {step}"
    again = Conversation(store=c.store, **sections)
    # A weight that was set to the policy's own is not remembered: it is in force all the same.
    assert again.ground.in_force() == c.ground.in_force()
    assert again.agent.settings == c.agent.settings
    assert again.agent.settings.policy.make().tag == c.agent.settings.policy.make().tag


def said(outgoing: Any) -> Any:
    fields = some(tunnel_from_datagram(outgoing.frame))
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
