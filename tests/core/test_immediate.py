"""Immediate forwarding: what comes in moves on at once."""

from __future__ import annotations

from rass_mav.core.messages import Data
from rass_mav.core.policy import POTENTIAL_ONE

from .build import beacon, make_node
from .replica_net import CHAIN, RISKS, Net


def test_data_move_on_when_they_come_in() -> None:
    net = Net(RISKS, CHAIN, immediate=True)
    net.step()
    id = net.put(1)
    assert net.custody(id) == [3]
    net.step()
    assert net.active(id) == [2]


def test_without_it_they_wait_for_the_next_step() -> None:
    net = Net(RISKS, CHAIN)
    net.step()
    id = net.put(1)
    assert net.custody(id) == [1]


def test_the_bandwidth_of_the_step_bounds_what_moves_on() -> None:
    net = Net(RISKS, CHAIN, immediate=True, bandwidth_items=2)
    net.step()
    ids = [net.put(1) for _ in range(5)]
    assert [net.custody(id) for id in ids] == [[3], [3], [1], [1], [1]]
    net.step()
    assert [net.custody(id) for id in ids] == [[3]] * 4 + [[1]]


def test_a_new_datum_that_has_no_way_to_go_is_replicated_at_once() -> None:
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)], immediate=True)
    net.step()
    id = net.put(1)
    assert net.custody(id) == [1]
    assert net.active(id) == [2]


def test_nothing_moves_on_when_nothing_came_in() -> None:
    node = make_node(1, immediate=True)
    node.step(0.0)
    node.put(b"x", 0.0)
    # There is no way to go; and when there is one, nothing has come in.
    assert node.forward(0.0) == []
    node.receive(beacon(2, policy=node.policy.tag, potential=POTENTIAL_ONE), 0.5)
    assert node.forward(0.5) == []
    node.put(b"y", 0.5)
    assert [type(m) for m in node.forward(0.5)] == [Data]
    assert node.forward(0.5) == []


def test_large_data_move_on_when_they_are_complete() -> None:
    net = Net(RISKS, CHAIN, immediate=True)
    net.step()
    id = net.put(1, bytes(2000))
    assert net.custody(id) == [3]
