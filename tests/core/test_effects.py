"""No part of a node holds another that holds it, and `Node` applies what they ask for, in one place and order."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from types import FrameType, MethodType
from typing import Any

import pytest

import rass_mav.core
from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.effects import Ask, Count, Drop, Effect, Take, Tell
from rass_mav.core.custody.replica_messages import ReplicaMessages
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import CopyStatus, CopyStatusEntry, CopyStatuses, Route
from rass_mav.core.node import Node

from .build import beacon, data, datum, make_node, passed_on

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


#: What changes a copy, or tells a neighbour something; only `Node` and those that do its work call these.
CHANGES_A_COPY = {
    *("drop", "rescue", "take_back", "retire", "count_on", "back", "chain", "give_up", "give_away", "ask", "keep"),
    *("keep_replica", "take_custody", "load"),
}


@pytest.mark.parametrize("module", ["replicas/replicas", "replicas/offers", "replicas/distant", "custody/percolation"])
def test_who_decides_changes_no_copy(module: str) -> None:
    """Their decisions are effects. Each name below exists, so a renamed method is noticed."""
    assert all(hasattr(CustodyStore, name) for name in CHANGES_A_COPY)
    tells = {name for name in vars(ReplicaMessages) if not name.startswith("_")}
    source = Path(rass_mav.core.__file__).parent / f"{module}.py"
    for call in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        match call:
            case ast.Attribute(value=ast.Name(id="custody_store") | ast.Attribute(attr="_custody_store"), attr=name):
                assert name not in CHANGES_A_COPY | {"messages"}
            case ast.Attribute(value=ast.Attribute(attr="messages"), attr=name):
                assert name not in tells


#: A datum that nobody here has.
ABSENT = DatumId(9, 1, 0)


def asked(node: Node, status: CopyStatus, id: DatumId, sender: int = 2) -> list[Effect]:
    """What replicas decide when a neighbour says this of a datum. Nothing of it is done."""
    message = CopyStatuses(sender, node.id, (CopyStatusEntry(id, status),))
    return list(node.replicas.on_copy_statuses(message, 1.0))


def test_a_decision_is_an_effect_and_changes_nothing_itself() -> None:
    node = make_node(3, mirror=True)
    node.receive(beacon(2, 1), 0.0)
    own = node.put(b"x", 0.0)
    holding = node.holdings.custody[own]
    assert asked(node, CopyStatus.STILL, own) == [Count(holding, 2)]
    assert asked(node, CopyStatus.STILL, ABSENT) == [Tell(2, ABSENT, CopyStatus.AGAIN)]
    assert asked(node, CopyStatus.WANTED, own) == [Tell(2, own, CopyStatus.TAKEN)]
    assert asked(node, CopyStatus.WANTED, ABSENT) == []
    take, none, ask = asked(node, CopyStatus.AGAIN, ABSENT)
    assert (take, none) == (Take(ABSENT), Tell(2, ABSENT, CopyStatus.NONE))
    assert isinstance(ask, Ask)
    # Nothing was applied: the copy has no holder, and no question is open.
    assert holding.partner is None
    assert not node.exchange.open


def test_a_replica_that_no_node_counts_on_is_dropped_as_an_effect() -> None:
    node = make_node(3, mirror=True, mirror_until_receipt=False)
    node.receive(beacon(2, 1), 0.0)
    replica = datum(origin=2)
    node.receive(data(2, 3, (7, replica))._replace(replica=True), 0.0)
    [drop] = asked(node, CopyStatus.PASSED_ON, replica.id)
    assert drop == Drop(node.holdings.replica[replica.id], Fate.PASSED_ON)
    node.receive(passed_on(2, 3, replica.id), 1.0)
    assert replica.id not in node.holdings


def test_a_base_releases_the_replica_of_what_has_arrived() -> None:
    base = make_node(0, base=True)
    base.receive(beacon(2, 1), 0.0)
    arrived = datum(origin=2)
    base.receive(data(2, 0, (7, arrived)), 0.0)
    assert asked(base, CopyStatus.STILL, arrived.id) == [Tell(2, arrived.id, CopyStatus.PASSED_ON)]
