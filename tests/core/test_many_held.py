"""A drone that has been away for days holds tens of thousands of data: its turns must not take longer for that.

Work is counted in instructions of Python's interpreter, which are the same on every machine.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest

from rass_mav.core.datum import Kind
from rass_mav.core.messages import BEACON_BASE, Committed, Data, Message, Route
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.costs import NO_COST
from rass_mav.policy.settings import PolicySettings
from rass_mav.store.memory import MemoryStore

from .build import beacon, node_settings, of, statement, talk

FEW, MANY = 1_500, 6_000
#: With four times as many data. Tables grow now and then, so it is not quite 1.
MOST = 1.3
Turn = Callable[[float], list[Message]]


def work(call: Callable[[], Any]) -> int:
    """How many instructions of Python a call executes."""
    count = 0

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal count
        frame.f_trace_lines = False
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def make(id: int, held: int, *, risk: float = 0.0, base: bool = False, **settings: Any) -> Node:
    """A node with the product's mechanisms that has so many measurements."""
    estimator = RiskEstimator(stale_s=1e9)
    estimator.observe(risk, 0.0)
    options = {
        "mirror": not base, "overhear": True, "distant": True, "immediate": True,
        "contacts": True, "queue_toll": True, "capacity_items": None, "scrub_items": 50, "receipt_steps": 1,
        "seq_period": 2,
    }  # fmt: skip
    node = Node(
        node_settings(id, base=base, **{**options, **settings}),
        MemoryStore(1000 + id), PolicySettings(name="survival").make(), estimator, random.Random(id), now=0.0,
        newborn=True,
    )  # fmt: skip
    for number in range(held):
        node.put(b"reading", number / held, Kind.MEASUREMENT)
    return node


def alone(node: Node) -> Turn:
    return node.step


def with_full_neighbours(node: Node) -> Turn:
    """Neighbours without a base, which refuse every replica."""

    def turn(now: float) -> list[Message]:
        for other in (2, 3):
            node.receive(beacon(other, int(now), policy=node.policy.tag, potential=NO_COST - 1), now)
        out = node.step(now)
        for data in of(Data, out):
            numbers = tuple(handover.number for handover in data.handovers)
            out += node.receive(Committed(data.target, data.sender, (), numbers), now) + node.forward(now)
        return out

    return turn


def with_a_silent_base(node: Node) -> Turn:
    """A base that takes nothing, so the air is full."""

    def turn(now: float) -> list[Message]:
        route = Route(9, 9, 1, 0)
        node.receive(beacon(9, int(now), route, life=9, flags=BEACON_BASE, free=65535, potential=POTENTIAL_BASE), now)
        out = node.step(now)
        node.pace.queue = 1
        node.put(b"reading", now, Kind.MEASUREMENT)
        return out + node.forward(now)

    return turn


def spent(node: Node, turn: Turn) -> int:
    """The work of some turns, when all has settled."""
    for now in range(2, 20):
        turn(float(now))
    return sum(work(lambda now=now: turn(float(now))) for now in range(20, 23))  # type: ignore[misc]


@pytest.mark.no_cover
@pytest.mark.parametrize("surroundings", [alone, with_full_neighbours, with_a_silent_base])
@pytest.mark.parametrize("settings", [{}, {"lifetime_s": 1e9}], ids=["usual", "lives"])
def test_a_turn_does_not_take_longer_with_many_data(
    surroundings: Callable[[Node], Turn], settings: dict[str, Any]
) -> None:
    few, many = (spent(node, surroundings(node)) for node in (make(1, held, **settings) for held in (FEW, MANY)))
    assert many < MOST * few


@pytest.mark.no_cover
def test_data_that_have_arrived_by_others_hold_up_no_turn() -> None:
    """All that a drone holds has reached a base by copies, and the air is full."""
    figures = []
    for held in (FEW, MANY):
        node = make(1, held)
        node.receive(statement(*node.holdings, base=9, life=9), 1.0)
        assert next(iter(node.holdings)) in node.receipts
        figures.append(spent(node, with_a_silent_base(node)))
    few, many = figures
    assert many < MOST * few


@pytest.mark.no_cover
def test_a_swarm_that_holds_much_still_has_routes() -> None:
    """What waits at a node makes routes by it dearer, but never so dear that they end: nothing would move any more."""
    chain = {id: make(id, 20_000 * (id > 0), risk=0.5, base=id == 0) for id in range(6)}
    for now in range(1, 14):
        for id, node in chain.items():
            said = node.step(float(now))[:1]
            talk({other: chain[other] for other in (id - 1, id + 1) if other in chain}, said, float(now))
    assert [node.routing.hops for node in chain.values()] == [0, 1, 2, 3, 4, 5]
    costs = [chain[id].potential for id in range(1, 6)]
    assert costs == sorted(set(costs)), "each node is dearer than the one before it"
