"""Commit, then send: what a node says waits for the commit that covers what it rests on, and for no other."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
from test_agent import heard, make, said

from rass_mav.agent.agent import Agent
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.messages import BROADCAST, Committed, Corrupt, CorruptEntry, Data, Handover, Message, Word
from rass_mav.store import SqliteStore

ID = DatumId(9, 77, 0)
SPARE = Data(2, 1, (Handover(100, make_datum(ID, 0, 0.0, b"reading")),), True)


@pytest.fixture
def agent(tmp_path: Path) -> Any:
    """A drone on a real disk."""
    with SqliteStore.open(tmp_path / "node.db", draw_epoch=lambda: 7) as store:
        yield Agent(make(1).settings, store, random.Random(1), now=0.0)


def waiting(agent: Agent, message: Message) -> list[tuple[Any, bool]]:
    """What is answered to a message, and whether it waits."""
    answers = heard(agent, message, 0.0)
    return [(m, outgoing.promises) for m, outgoing in zip(said(answers), answers, strict=True)]


def test_who_takes_back_a_spare_that_is_not_on_disk_says_so_after_the_commit(agent: Agent) -> None:
    assert waiting(agent, SPARE) == [(Committed(1, 2, ((100, SPARE.handovers[0].datum.crc),), ()), True)]
    asked = Corrupt(2, 1, (CorruptEntry(ID, Word.AGAIN),))
    # After a crash now there would be no copy at all, and who asked would have dropped its loss note.
    assert waiting(agent, asked) == [(Corrupt(1, 2, (CorruptEntry(ID, Word.TAKEN),)), True)]


def test_other_words_about_copies_do_not_wait(agent: Agent) -> None:
    heard(agent, SPARE, 0.0)
    wanted = Corrupt(3, 1, (CorruptEntry(ID, Word.WANTED),))
    assert waiting(agent, wanted) == [(Corrupt(1, 3, (CorruptEntry(ID, Word.HERE),)), False)]
    other = Corrupt(2, 1, (CorruptEntry(ID._replace(sequence=1), Word.AGAIN),))
    none, search = waiting(agent, other)
    assert none == (Corrupt(1, 2, (CorruptEntry(other.entries[0].id, Word.NONE),)), False)
    assert search == (Corrupt(1, BROADCAST, (CorruptEntry(other.entries[0].id, Word.WANTED),)), False)


def test_a_refusal_promises_nothing_and_leaves_also_when_the_disk_does_not_take_anything(tmp_path: Path) -> None:
    full = make(1, store={"capacity_items": 1}).settings
    with SqliteStore.open(tmp_path / "node.db", draw_epoch=lambda: 7) as store:
        agent = Agent(full, store, random.Random(1), now=0.0)
        first, second = (Data(2, 1, (Handover(n, make_datum(ID._replace(sequence=n), 0, 0.0, b"x")),)) for n in (5, 6))
        assert [wait for _, wait in waiting(agent, first)] == [True]
        assert waiting(agent, second) == [(Committed(1, 2, (), (6,)), False)]
