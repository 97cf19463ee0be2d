"""A node's own status: when it is sent, and what it says."""

from __future__ import annotations

import pytest

from rass_mav.agent.agent import Agent
from rass_mav.core.datum import DatumId, Kind, make_datum
from rass_mav.core.messages import Data, Handover, Route
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire.nodestatus import NodeStatus, decode_status
from tests.core.build import beacon
from tests.telemetry import global_position_int

from .build import make


def statuses(agent: Agent) -> list[NodeStatus]:
    data = [agent.store.get(info.id) for info in agent.store.held() if info.kind == Kind.STATUS]
    return [decode_status(datum.payload) for datum in data if datum is not None]


def run(agent: Agent, seconds: int, begin: int = 0) -> None:
    for now in range(begin, begin + seconds):
        agent.step(float(now))


@pytest.mark.parametrize("interval", [5.0, 60.0])
def test_it_comes_once_in_each_interval(interval: float) -> None:
    agent = make(3, data={"status_s": interval, "interval_steps": 0})
    run(agent, int(10 * interval))
    assert abs(len(statuses(agent)) - 10) <= 1


@pytest.mark.parametrize(("turn", "expected"), [(1.0, 60.0), (5.0, 300.0)])
def test_by_default_it_comes_once_a_minute_and_seldom_on_a_slow_link(turn: float, expected: float) -> None:
    agent = make(3, data={"status_s": None, "interval_steps": 0})
    agent.node.pace.turn_s = turn
    run(agent, int(6 * expected))
    assert abs(len(statuses(agent)) - 6) <= 1


def test_nodes_take_their_turns() -> None:
    first = []
    for id in range(2, 12):
        agent = make(id, data={"status_s": 100.0, "interval_steps": 0})
        while not statuses(agent):
            agent.step(float(agent.steps))
        first.append(agent.steps)
    assert len(set(first)) == len(first)
    assert max(first) - min(first) > 50


def test_a_base_says_that_it_is_one() -> None:
    agent = make(3, base=True, data={"status_s": 5.0, "interval_steps": 0})
    run(agent, 30)
    said = statuses(agent)
    assert said
    for status in said:
        assert (status.base, status.hops, status.alone, status.risk) == (True, 0, 0, 0.0)


@pytest.mark.parametrize("sections", [{"data": {}}, {"policy": {"name": "stigmergy"}}])
def test_none_where_it_is_off_and_where_every_node_has_everything(sections: dict[str, object]) -> None:
    sections = {"data": {"status_s": 5.0, "interval_steps": 0}, **sections}
    agent = make(3, **sections)  # type: ignore[arg-type]
    run(agent, 30)
    assert statuses(agent) == []


def test_none_after_the_last_step_with_data_and_none_in_a_full_store() -> None:
    agent = make(3, data={"status_s": 5.0, "interval_steps": 0, "until_step": 12})
    run(agent, 60)
    assert 1 <= len(statuses(agent)) <= 3
    full = make(3, data={"status_s": 5.0, "interval_steps": 0}, store={"capacity_items": 1})
    run(full, 60)
    assert len(statuses(full)) == 1


def test_a_node_that_was_stopped_does_not_make_up_for_it() -> None:
    agent = make(3, data={"status_s": 5.0, "interval_steps": 0})
    run(agent, 10)
    before = len(statuses(agent))
    run(agent, 1, begin=1000)
    assert len(statuses(agent)) == before + 1


def test_it_says_what_only_this_node_has() -> None:
    agent = make(
        3, data={"status_s": 1000.0, "interval_steps": 0}, custody={"replicas": True}, store={"capacity_items": 50}
    )
    autopilot = FrameWriter(7, 1)
    agent.vehicle_bytes(autopilot.message(common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)), 0.0)
    agent.vehicle_bytes(autopilot.message(global_position_int(47.5, 8.5, 400.0, 20.0, 1000)), 0.0)
    charge = common.MAVLink_sys_status_message(0, 0, 0, 0, 12000, 500, 83, 0, 0, 0, 0, 0, 0)
    agent.vehicle_bytes(autopilot.message(charge), 0.0)
    node = agent.node
    node.put(b"mine", 0.0)
    node.receive(Data(9, 3, (Handover(77, make_datum(DatumId(8, 5, 0), 0, 0.0, b"his")),)), 0.0)
    node.receive(beacon(9, 1, life=9), 0.0)
    [status] = [s for s in agent.services if type(s).__name__ == "Statuses"]
    status.step(2000.0)
    [said] = statuses(agent)
    assert (said.held, said.alone, said.alone_by_origin) == (2, 1, {3: 1}), (
        "node 9 has a replica of what it handed over"
    )
    # Two fifths are for its own data.
    assert (said.battery, said.place, said.hops, said.free) == (83, (47.5, 8.5), None, 50 - 20 - 2)
    assert list(said.neighbours) == [9]


def test_it_names_the_neighbour_to_which_its_data_go() -> None:
    agent = make(3, data={"status_s": 1000.0, "interval_steps": 0})
    node = agent.node
    node.receive(beacon(9, 1, life=9), 0.0)
    node.receive(beacon(8, 1, Route(1, 1, 1, 0), life=8), 0.0)
    agent.step(1.0)
    assert node.routing.next_hop == 8
    [status] = [s for s in agent.services if type(s).__name__ == "Statuses"]
    status.step(2000.0)
    [said] = statuses(agent)
    assert said.next_hop == 8
    assert set(said.neighbours) == {8, 9}
