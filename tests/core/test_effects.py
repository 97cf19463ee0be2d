"""The parts of a node: none holds another that holds it, and `Node.step` applies what they ask for in one order."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from types import FrameType, MethodType
from typing import Any

import pytest

from rass_mav.core.messages import Route

from .build import beacon, make_node

#: What a turn consists of, from the top to the bottom of Alg. 1.
TURN = """
    CustodyStore.scrub
    Pace.begin_turn
    CustodyStore.expire
    Incoming.age
    Transfers.age
    Journal.step
    Node.update_routing_table
    Node.update_fitness
    Receipts.turn
    OwnNumbers.turn
    Replicas.step
    Percolation.scattered
    Percolation.detours
    Percolation.probes
    Percolation.plan
    Replicas.spread
    Replicas.spread_far
    ReplicaMessages.flush
"""


def held_by(part: object) -> Iterator[object]:
    """The parts that a part holds: in its attributes, or as the one whose method it was given."""
    for kind in type(part).__mro__:
        for name in getattr(kind, "__slots__", ()):
            value = getattr(part, name, None)
            value = value.__self__ if isinstance(value, MethodType) else value
            if type(value).__module__.startswith("rass_mav.core") and hasattr(type(value), "__slots__"):
                yield value


@pytest.mark.parametrize("settings", [{"mirror": True}, {"base": True}, {"mirror": False}])
def test_no_part_holds_another_that_holds_it(settings: dict[str, Any]) -> None:
    node = make_node(3, **settings)
    holds: dict[int, set[int]] = {}
    found: list[object] = [node]
    while found:
        part = found.pop()
        if id(part) not in holds:
            held = list(held_by(part))
            holds[id(part)] = {id(one) for one in held}
            found += held
    assert len(holds) > 15
    TopologicalSorter(holds).prepare()


def test_a_turn_follows_the_algorithm() -> None:
    """Alg. 1: update the routing table and the fitness, then evict. Each part is entered once, in this order."""
    node = make_node(3, mirror=True)
    node.receive(beacon(1, 1, Route(1, 1, 1, 0)), 0.0)
    node.step(0.0)
    node.put(b"x", 0.0)
    expected = TURN.split()
    entered: list[str] = []

    def note(frame: FrameType, event: str, arg: object) -> None:
        name = f"{type(frame.f_locals.get('self')).__name__}.{frame.f_code.co_name}"
        if event == "call" and name in expected and name not in entered:
            entered.append(name)

    sys.setprofile(note)
    try:
        node.step(1.0)
    finally:
        sys.setprofile(None)
    assert entered == expected
