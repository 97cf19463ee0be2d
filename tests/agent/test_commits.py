"""Commit, then send: what a node says waits for the commit that covers what it rests on, and for no other."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import MAX_WAITING, CommitGate
from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.messages import (
    BROADCAST,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
)
from rass_mav.errors import RassError, StoreError
from rass_mav.station.node import build_node
from rass_mav.store.sqlite import SqliteStore
from tests.agent.build import heard, make, said
from tests.core.durable import DurableStore
from tests.some import some

ID = DatumId(9, 77, 0)
REPLICA = Data(2, 1, (Handover(100, make_datum(ID, 0, 0.0, b"reading")),), True)


@pytest.fixture
def agent(tmp_path: Path) -> Any:
    """A drone on a real disk."""
    with SqliteStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 7) as store:
        yield build_node(make(1).settings, store, random.Random(1), now=0.0)


def waiting(agent: Agent, message: Message) -> list[tuple[Any, bool]]:
    """What is answered to a message, and whether it waits."""
    answers = heard(agent, message, 0.0)
    return [(m, outgoing.promises) for m, outgoing in zip(said(answers), answers, strict=True)]


def test_who_takes_back_a_replica_that_is_not_on_disk_says_so_after_the_commit(agent: Agent) -> None:
    assert waiting(agent, REPLICA) == [(Committed(1, 2, ((100, REPLICA.handovers[0].datum.crc),), ()), True)]
    asked = CopyStatuses(2, 1, (CopyStatusEntry(ID, CopyStatus.AGAIN),))
    # After a crash now there would be no copy at all, and who asked would have dropped its deletion report.
    assert waiting(agent, asked) == [(CopyStatuses(1, 2, (CopyStatusEntry(ID, CopyStatus.TAKEN),)), True)]


def test_who_says_that_a_datum_was_passed_on_says_so_after_the_commit(agent: Agent) -> None:
    """The holder that asks may delete its replica."""
    heard(agent, REPLICA, 0.0)
    asked = CopyStatuses(9, 1, (CopyStatusEntry(ID, CopyStatus.STILL),))
    assert waiting(agent, asked) == [(CopyStatuses(1, 9, (CopyStatusEntry(ID, CopyStatus.PASSED_ON),)), True)]


def test_other_words_about_copies_do_not_wait(agent: Agent) -> None:
    heard(agent, REPLICA, 0.0)
    wanted = CopyStatuses(3, 1, (CopyStatusEntry(ID, CopyStatus.WANTED),))
    assert waiting(agent, wanted) == [(CopyStatuses(1, 3, (CopyStatusEntry(ID, CopyStatus.HERE),)), False)]
    other = CopyStatuses(2, 1, (CopyStatusEntry(ID._replace(sequence=1), CopyStatus.AGAIN),))
    none, search = waiting(agent, other)
    assert none == (CopyStatuses(1, 2, (CopyStatusEntry(other.entries[0].id, CopyStatus.NONE),)), False)
    assert search == (CopyStatuses(1, BROADCAST, (CopyStatusEntry(other.entries[0].id, CopyStatus.WANTED),)), False)


def test_a_refusal_promises_nothing_and_leaves_also_when_the_disk_does_not_take_anything(tmp_path: Path) -> None:
    full = make(1, store={"capacity_items": 1}).settings
    with SqliteStore.open(tmp_path / "node.db", node_id=7, draw_epoch=lambda: 7) as store:
        agent = build_node(full, store, random.Random(1), now=0.0)
        first, second = (Data(2, 1, (Handover(n, make_datum(ID._replace(sequence=n), 0, 0.0, b"x")),)) for n in (5, 6))
        assert [wait for _, wait in waiting(agent, first)] == [True]
        assert waiting(agent, second) == [(Committed(1, 2, (), (6,)), False)]


# -- the gate itself ---------------------------------------------------------------------------------------------------


def frame(promises: bool, name: str = "") -> Outgoing:
    return Outgoing(name.encode(), BROADCAST, promises)


def test_when_nothing_is_unwritten_all_leaves_at_once_in_its_order() -> None:
    gate = CommitGate(DurableStore(1))
    words = [frame(False, "a"), frame(True, "b"), frame(False, "c")]
    assert gate.say(words) == words
    assert gate.begin() is None
    assert gate.written() == []


def test_what_rests_on_nothing_does_not_wait() -> None:
    store = DurableStore(1)
    gate = CommitGate(store)
    store.set_meta("n", 1)
    assert gate.say([frame(True, "b"), frame(False, "a")]) == [frame(False, "a")]
    assert gate.waiting == 1
    batch = some(gate.begin())
    assert gate.say([frame(True, "c"), frame(False, "d")]) == [frame(False, "d")]
    with pytest.raises(RuntimeError):
        gate.begin()
    store.write(batch)
    assert gate.written() == [frame(True, "b")], "what was said meanwhile is covered by the next commit"
    assert gate.begin() is None
    assert gate.written() == [frame(True, "c")]


def test_what_waits_is_bounded() -> None:
    store = DurableStore(1)
    gate = CommitGate(store)
    store.set_meta("n", 1)
    assert gate.say([frame(True)] * (MAX_WAITING + 5)) == []
    assert (gate.waiting, gate.dropped) == (MAX_WAITING, 5)


def test_what_is_rolled_back_is_not_said_and_who_asked_is_told_while_the_batch_under_way_goes_on() -> None:
    store = DurableStore(1)
    gate = CommitGate(store)
    told: list[tuple[str, RassError | None]] = []
    store.set_meta("n", 1)
    gate.say([frame(True, "kept")])
    gate.ask(lambda error: told.append(("kept", error)))
    batch = gate.begin()
    store.set_meta("n", 2)
    gate.say([frame(True, "dropped")])
    gate.ask(lambda error: told.append(("dropped", error)))
    error = StoreError("dropped")
    gate.roll_back(error)
    assert (store.get_meta("n"), told) == (1, [("dropped", error)])
    store.write(batch)
    assert gate.written() == [frame(True, "kept")]
    assert told == [("dropped", error), ("kept", None)]
    assert gate.is_idle()


@given(st.lists(st.sampled_from(["change", "say", "ask", "begin", "written", "failed", "fault"]), max_size=60))
def test_nothing_leaves_before_what_it_rests_on_is_on_disk_and_nothing_waits_for_ever(events: list[str]) -> None:
    store = DurableStore(1)
    gate = CommitGate(store)
    changes = said = begun = 0
    waiting: list[int] = []
    batch: object | None = None
    hopes: list[int] = []

    def leaves(frames: Sequence[Outgoing]) -> None:
        nonlocal begun
        for outgoing in frames:
            number, rests_on = map(int, outgoing.frame.split())
            assert store.disk.meta.get("n", 0) >= rests_on
            assert number == waiting.pop(0), "in the order in which it was said"
            begun = max(0, begun - 1)

    def ask(rests_on: int) -> None:
        def tell(error: RassError | None) -> None:
            assert error is not None or store.disk.meta.get("n", 0) >= rests_on
            hopes.remove(rests_on)

        hopes.append(rests_on)
        gate.ask(tell)

    for event in [*events, "written", "begin", "written"]:
        if event == "change":
            changes += 1
            store.set_meta("n", changes)
        elif event == "say":
            waiting.append(said)
            said += 1
            leaves(gate.say([frame(True, f"{waiting[-1]} {changes}")]))
        elif event == "ask":
            ask(changes)
        elif event == "begin" and not gate.committing:
            batch, begun = gate.begin(), len(waiting)
            if batch is None:
                leaves(gate.written())
        elif event == "written" and gate.committing:
            store.write(batch)
            leaves(gate.written())
        elif event == "failed" and gate.committing:
            gate.failed(StoreError("I/O error"))
            assert not hopes, "all who asked are told"
        elif event == "fault":
            gate.roll_back(StoreError("dropped"))
            del waiting[begun:]
            changes = store.get_meta("n") or 0
    assert (waiting, hopes) == ([], [])
