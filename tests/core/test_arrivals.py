"""What need not move: what has arrived, and with keys what its receiver hands on. And who answers a search."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rass_mav.core.custody.custody_store import STATED_TURNS
from rass_mav.core.datum import Fate
from rass_mav.core.exchange import mark
from rass_mav.core.messages import (
    BROADCAST,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Route,
)
from rass_mav.core.news.deletion_reports import DeletionReports
from rass_mav.core.node import Node
from rass_mav.core.pace import RESERVED
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.trust.pairs import StrongContentHashes

from .books import check_node
from .build import beacon, data, datum, make_node, of, passed_on, statement

ME, NEXT, OTHER = 1, 2, 3
ROUTE = Route(0, 9, 1, 1)


def hear(node: Node, now: float, sender: int = NEXT, route: Route | None = ROUTE) -> None:
    said = beacon(sender, int(2 * now), route, policy=node.policy.tag, potential=POTENTIAL_ONE)
    node.receive(said, now)


def custodian(*sequences: int, lasting: bool = True) -> Node:
    """A node with data in custody, and a neighbour that is nearer to the base."""
    node = make_node(ME, mirror=True, mirror_until_receipt=lasting)
    hear(node, 0.5)
    node.receive(data(OTHER, ME, *((7 + i, datum(sequence=i)) for i in sequences)), 0.6)
    assert len(node.holdings.custody) == len(sequences)
    return node


def test_what_has_arrived_moves_on_in_one_turn_of_ten_only() -> None:
    """Its custody does not end: without keys anybody can make such a statement."""
    waits, moves = custodian(0, 1), []
    waits.receive(statement(datum().id), 0.7)
    for turn in range(1, 3 * RESERVED):
        hear(waits, turn - 0.25)
        handed = [h.datum.id.sequence for d in of(Data, waits.step(float(turn))) for h in d.handovers]
        moves += [(turn, sequence) for sequence in handed]
        # Nobody answers.
        for pending in list(waits.exchange.open.values()):
            if pending.id in waits.holdings.custody:
                waits.holdings.put_off(waits.holdings.custody[pending.id])
        check_node(waits)
    assert {turn for turn, sequence in moves if sequence == 1} == set(range(1, 3 * RESERVED))
    arrived = sorted({turn for turn, sequence in moves if sequence == 0})
    assert 2 <= len(arrived) <= 3
    assert all(later - earlier == RESERVED for earlier, later in pairwise(arrived))
    assert datum().id in waits.holdings.custody


# -- a receiver that is heard handing the datum on, with keys ---------------------------------------------------------


def handed(node: Node, turn: int, *, heard: bool = False) -> list[int]:
    """The sequences that the node hands over in this turn. `heard`: the receiver of the first datum is heard handing
    it on before that. Nobody answers, and the neighbour is given up each time."""
    hear(node, turn - 0.25)
    found = [h for d in of(Data, node.step(float(turn))) for h in d.handovers if not d.replica]
    if heard:
        [first] = [h for h in found if h.datum.id.sequence == 0] or [None]
        if first is not None:
            node.receive(data(NEXT, OTHER, (77 << 16 | mark(first.number), first.datum)), turn + 0.1)
    for pending in list(node.exchange.open.values()):
        if pending.id in node.holdings.custody:
            node.holdings.put_off(node.holdings.custody[pending.id])
    check_node(node)
    return [h.datum.id.sequence for h in found]


def with_keys(*sequences: int) -> Node:
    node = custodian(*sequences)
    node.numbers.content_hashes = StrongContentHashes()
    return node


def test_a_copy_that_its_receiver_is_heard_handing_on_moves_as_before() -> None:
    node = with_keys(0)
    assert [handed(node, turn, heard=True) for turn in range(1, 2 * RESERVED)] == [[0]] * (2 * RESERVED - 1)


@pytest.mark.parametrize("repeated", [1, 5])
def test_a_corrupt_copy_of_it_is_looked_for_later(repeated: int) -> None:
    """Whoever repeats such frames puts that off no further than 30 turns after the copy was struck."""
    node, asked = with_keys(0), []
    for turn in range(1, repeated + 1):
        handed(node, turn, heard=True)
    node.custody_store.drop(node.holdings.custody[datum().id], Fate.CORRUPTED)
    for turn in range(repeated + 1, repeated + STATED_TURNS + 5):
        hear(node, turn - 0.25)
        words = [entry.status for m in of(CopyStatuses, node.step(float(turn))) for entry in m.entries]
        asked += [(turn, word) for word in words]
        check_node(node)
    assert asked
    assert asked[0] == (repeated + STATED_TURNS + 2, CopyStatus.WANTED)


def test_a_datum_that_comes_back_is_looked_for_at_once() -> None:
    """Somebody hands it over, and relies on the copy here."""
    node = with_keys(0)
    handed(node, 1, heard=True)
    node.receive(data(OTHER, ME, (70, datum())), 1.5)
    node.custody_store.drop(node.holdings.custody[datum().id], Fate.CORRUPTED)
    assert [entry.status for m in of(CopyStatuses, node.step(2.0)) for entry in m.entries] == [CopyStatus.AGAIN]


@pytest.mark.parametrize("stated", [False, True])
def test_a_corrupt_copy_is_looked_for_unless_a_base_has_the_datum(stated: bool) -> None:
    node = custodian(0)
    if stated:
        node.receive(statement(datum().id), 0.7)
    node.custody_store.drop(node.holdings.custody[datum().id], Fate.CORRUPTED)
    check_node(node)
    words = [entry.status for m in of(CopyStatuses, node.step(1.0)) for entry in m.entries]
    assert words == [CopyStatus.PASSED_ON if stated else CopyStatus.AGAIN]
    # What has arrived is not lost, and is not reported so.
    notes = node.custody_store.notes
    assert isinstance(notes, DeletionReports)
    assert bool(notes.suspected) is not stated
    assert not notes.waiting


# -- searches ----------------------------------------------------------------------------------------------------------


def holder() -> Node:
    """A node that has handed the datum to `NEXT`, which it hears, and keeps its replica. It hears `OTHER` too."""
    node = custodian(0, lasting=False)
    [sent] = [h.number for d in of(Data, node.step(1.0)) for h in d.handovers]
    node.receive(Committed(NEXT, ME, ((sent, datum().crc),), ()), 1.1)
    hear(node, 1.2, sender=OTHER, route=None)
    return node


def answers(node: Node, sender: int, status: CopyStatus, now: float) -> list[tuple[int, CopyStatus]]:
    """What it says about the datum, and to whom, when a neighbour says this."""
    out = node.receive(CopyStatuses(sender, BROADCAST, (CopyStatusEntry(datum().id, status),)), now)
    return [(said.target, entry.status) for said in of(CopyStatuses, out) for entry in said.entries]


def test_a_holder_asks_its_custodian_before_it_answers_for_it() -> None:
    node = holder()
    assert answers(node, OTHER, CopyStatus.WANTED, 1.3) == [(NEXT, CopyStatus.WANTED)]
    assert answers(node, 7, CopyStatus.TAKEN, 1.35) == [], "it was not asked"
    assert answers(node, NEXT, CopyStatus.TAKEN, 1.4) == [(OTHER, CopyStatus.TAKEN)]
    assert node.holdings.replica.keys() == {datum().id}
    # It has lost it itself.
    assert answers(node, NEXT, CopyStatus.WANTED, 1.5) == [(NEXT, CopyStatus.HERE)]


def test_a_custodian_that_says_nothing_may_have_passed_the_datum_on() -> None:
    """Even to the one that looks for it, and this node has not heard so: without the replica here the datum would be
    gone, and nobody would report it lost."""
    node = holder()
    answers(node, OTHER, CopyStatus.WANTED, 1.3)
    assert answers(node, OTHER, CopyStatus.WANTED, 2.3) == [(OTHER, CopyStatus.HERE)]
    assert (OTHER, CopyStatus.TAKEN) in answers(node, OTHER, CopyStatus.AGAIN, 2.4)
    node.receive(passed_on(NEXT, ME, datum().id), 2.5)
    assert node.holdings.custody.keys() == {datum().id}
