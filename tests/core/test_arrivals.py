"""What has arrived by a base's statement need not move; and who answers for a datum that another node looks for."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rass_mav.core.messages import (
    BROADCAST,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Route,
)
from rass_mav.core.node import Node
from rass_mav.core.pace import SPARED
from rass_mav.core.policy import POTENTIAL_ONE

from .books import check_node
from .build import beacon, data, datum, make_node, of, statement

ME, NEXT, OTHER = 1, 2, 3
ROUTE = Route(0, 9, 1, 1)


def hear(node: Node, now: float, sender: int = NEXT, route: Route | None = ROUTE) -> None:
    said = beacon(sender, int(2 * now), route, policy=node.policy.tag, potential=POTENTIAL_ONE)
    node.receive(said, now)


def custodian(*sequences: int) -> Node:
    """A node with data in custody, and a neighbour that is nearer to the base."""
    node = make_node(ME, mirror=True)
    hear(node, 0.5)
    node.receive(data(OTHER, ME, *((7 + i, datum(sequence=i)) for i in sequences)), 0.6)
    assert len(node.holdings.custody) == len(sequences)
    return node


def test_what_has_arrived_moves_on_in_one_turn_of_ten_only() -> None:
    """Its custody does not end: without keys anybody can make such a statement."""
    waits, moves = custodian(0, 1), []
    waits.receive(statement(datum().id), 0.7)
    for turn in range(1, 3 * SPARED):
        hear(waits, turn - 0.25)
        handed = [h.datum.id.sequence for d in of(Data, waits.step(float(turn))) for h in d.handovers]
        moves += [(turn, sequence) for sequence in handed]
        # Nobody answers.
        for pending in list(waits.exchange.open.values()):
            if pending.id in waits.holdings.custody:
                waits.holdings.put_off(waits.holdings.custody[pending.id])
        check_node(waits)
    assert {turn for turn, sequence in moves if sequence == 1} == set(range(1, 3 * SPARED))
    arrived = sorted({turn for turn, sequence in moves if sequence == 0})
    assert 2 <= len(arrived) <= 3
    assert all(later - earlier == SPARED for earlier, later in pairwise(arrived))
    assert datum().id in waits.holdings.custody


# -- searches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("asker", "word"), [(OTHER, CopyStatus.TAKEN), (NEXT, CopyStatus.HERE)])
def test_a_holder_answers_for_a_custodian_in_range_unless_that_one_asks(asker: int, word: CopyStatus) -> None:
    """Another node has lost a second copy: the replica here stays one, and no third custodian is made."""
    node = custodian(0)
    [sent] = [h.number for d in of(Data, node.step(1.0)) for h in d.handovers]
    node.receive(Committed(NEXT, ME, ((sent, datum().crc),), ()), 1.1)
    hear(node, 1.2, sender=OTHER, route=None)
    wanted = CopyStatuses(asker, BROADCAST, (CopyStatusEntry(datum().id, CopyStatus.WANTED),))
    said = [entry for m in of(CopyStatuses, node.receive(wanted, 1.3)) for entry in m.entries]
    assert said == [CopyStatusEntry(datum().id, word)]
    assert node.holdings.replica.keys() == {datum().id}


def test_a_holder_that_hears_its_custodian_no_more_has_the_copy_that_is_looked_for() -> None:
    node = custodian(0)
    [sent] = [h.number for d in of(Data, node.step(1.0)) for h in d.handovers]
    node.receive(Committed(NEXT, ME, ((sent, datum().crc),), ()), 1.1)
    for turn in range(2, 9):
        hear(node, turn - 0.25, sender=OTHER, route=None)
        node.step(float(turn))
    assert NEXT not in node.routing.neighbours
    wanted = CopyStatuses(OTHER, BROADCAST, (CopyStatusEntry(datum().id, CopyStatus.WANTED),))
    said = [entry for m in of(CopyStatuses, node.receive(wanted, 8.3)) for entry in m.entries]
    assert said == [CopyStatusEntry(datum().id, CopyStatus.HERE)]
