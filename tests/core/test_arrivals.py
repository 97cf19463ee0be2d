"""What need not move: data that have arrived, as beacons say, and data that a nearer node is heard to move."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from zlib import crc32

import pytest

from rass_mav.core.custody.custody_store import STATED_TURNS
from rass_mav.core.custody.holdings import State
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import (
    BROADCAST,
    MAX_ARRIVALS,
    Beacon,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    PassedOn,
    Route,
)
from rass_mav.core.news.arrivals import MAX_KNOWN, Arrivals, name
from rass_mav.core.news.deletion_reports import DeletionReports
from rass_mav.core.news.table import Statements
from rass_mav.core.node import Node
from rass_mav.core.pace import SPARED
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.wire import MAX_TUNNEL, decode, encode

from .books import check_node
from .build import beacon, data, datum, make_node, of, statement

ME, NEXT, OTHER = 1, 2, 3
ROUTE = Route(0, 9, 1, 1)


def hear(node: Node, now: float, *names: bytes, sender: int = NEXT, route: Route | None = ROUTE) -> None:
    said = beacon(sender, int(2 * now), route, policy=node.policy.tag, potential=POTENTIAL_ONE)
    node.receive(said._replace(arrivals=names), now)


def named(node: Node, now: float) -> tuple[bytes, ...]:
    """What the node's next beacon names."""
    [said] = of(Beacon, node.step(now))
    check_node(node)
    return tuple(said.arrivals)


def custodian(*sequences: int) -> Node:
    """A node with data in custody, and a neighbour that is nearer to the base."""
    node = make_node(ME, mirror=True)
    hear(node, 0.5)
    node.receive(data(OTHER, ME, *((7 + i, datum(sequence=i)) for i in sequences)), 0.6)
    assert len(node.holdings.custody) == len(sequences)
    return node


def test_a_name_is_three_bytes_of_the_id() -> None:
    # u16, u32, u32.
    id = bytes.fromhex("09004d00000002010000")
    assert int.from_bytes(name(DatumId(9, 77, 0x102)), "little") == crc32(id) % (1 << 24)
    assert len({name(DatumId(origin, 77, i)) for origin in range(10) for i in range(100)}) == 1000


def test_a_base_names_what_has_arrived_in_its_next_beacon_and_once() -> None:
    base = make_node(0, base=True)
    base.receive(data(ME, 0, (5, datum()), (6, datum(sequence=1))), 0.5)
    assert set(named(base, 1.0)) == {name(datum().id), name(datum(sequence=1).id)}
    assert named(base, 2.0) == ()


def test_a_beacon_names_the_latest_and_the_rest_follow() -> None:
    base = make_node(0, base=True)
    ids = [datum(sequence=i).id for i in range(MAX_ARRIVALS + 1)]
    for i, id in enumerate(ids):
        base.receive(data(ME, 0, (5 + i, datum(sequence=id.sequence))), 0.5)
    assert named(base, 1.0) == tuple(name(id) for id in reversed(ids[1:]))
    assert named(base, 2.0) == (name(ids[0]),)


def test_news_runs_back_to_those_who_have_a_copy_and_no_further() -> None:
    holder, stranger = custodian(0), make_node(4, mirror=True)
    for node in (holder, stranger):
        hear(node, 0.7, name(datum().id))
    assert named(holder, 1.0) == (name(datum().id),)
    assert named(stranger, 1.0) == ()
    # Heard again it is no news.
    hear(holder, 1.5, name(datum().id))
    assert named(holder, 2.0) == ()


def test_what_has_arrived_moves_on_in_one_turn_of_ten_only() -> None:
    waits, moves = custodian(0, 1), []
    hear(waits, 0.7, name(datum().id))
    for turn in range(1, 3 * SPARED):
        hear(waits, turn - 0.25)
        handed = [h.datum.id.sequence for d in of(Data, waits.step(float(turn))) for h in d.handovers]
        moves += [(turn, sequence) for sequence in handed]
        # Nobody answers.
        for pending in list(waits.exchange.open.values()):
            if pending.id in waits.holdings.custody:
                waits.holdings.put_off(waits.holdings.custody[pending.id])
    assert {turn for turn, sequence in moves if sequence == 1} == set(range(1, 3 * SPARED))
    arrived = sorted({turn for turn, sequence in moves if sequence == 0})
    assert 2 <= len(arrived) <= 3
    assert all(later - earlier == SPARED for earlier, later in pairwise(arrived))


def test_a_name_ends_no_copy_so_a_liar_that_takes_the_datum_cannot_lose_it() -> None:
    node = custodian(0)
    hear(node, 0.7, name(datum().id))
    taken = None
    for turn in range(1, 2 * SPARED):
        hear(node, turn - 0.25)
        for sent in of(Data, node.step(float(turn))):
            taken = taken or (turn, sent.handovers[0])
    assert taken is not None
    number = taken[1].number
    node.receive(Committed(NEXT, ME, ((number, datum().crc),), ()), 2.0 * SPARED)
    held = node.holdings.get(datum().id)
    assert held is not None
    assert held.state is State.REPLICA
    # A statement of the base does end it.
    node.receive(statement(datum().id), 2.0 * SPARED + 0.1)
    assert node.holdings.get(datum().id) is None


@pytest.mark.parametrize("stated", [False, True])
def test_what_has_arrived_is_looked_for_only_if_no_base_states_it(stated: bool) -> None:
    node, asked = custodian(0), []
    hear(node, 0.7, name(datum().id))
    node.custody_store.drop(node.holdings.custody[datum().id], Fate.CORRUPTED)
    check_node(node)
    if stated:
        node.receive(statement(datum().id), 0.8)
    for turn in range(1, STATED_TURNS + 5):
        hear(node, turn - 0.25)
        words = [entry.status for m in of(CopyStatuses, node.step(float(turn))) for entry in m.entries]
        asked += [(turn, word) for word in words]
        check_node(node)
    # The first turn is 1.5 turns after the node's start.
    assert asked[:1] == ([] if stated else [(STATED_TURNS + 2, CopyStatus.WANTED)])
    # What is not lost is not reported either.
    notes = node.custody_store.notes
    assert isinstance(notes, DeletionReports)
    assert bool(notes.suspected) is not stated


def test_a_name_does_not_end_the_replica_of_a_holder_that_asks() -> None:
    """It is neither told that the datum was passed on, nor asked to take it back."""
    for word_of, expected in ((None, [CopyStatus.AGAIN]), (NEXT, [])):
        node = make_node(ME, mirror=True)
        hear(node, 0.5, *([] if word_of is None else [name(datum().id)]))
        answers = node.receive(CopyStatuses(OTHER, ME, (CopyStatusEntry(datum().id, CopyStatus.STILL),)), 0.6)
        assert not of(PassedOn, answers + node.step(1.0))
        assert [entry.status for m in of(CopyStatuses, answers) for entry in m.entries] == expected


def test_as_many_names_as_a_node_says_fit_a_beacon_with_all_that_keys_add() -> None:
    full = beacon(ME)._replace(
        arrivals=(bytes(3),) * MAX_ARRIVALS, moves=1, proof=bytes(8), key=bytes(8), updates=1,
    )  # fmt: skip
    [payload] = encode(full, 0.0)
    assert len(payload) <= MAX_TUNNEL
    assert decode(payload, 0.0) == full


def test_a_node_remembers_so_many_names_whoever_sends_them() -> None:
    arrivals, held = Arrivals(Statements(1)), {name(datum(sequence=i).id) for i in range(3 * MAX_KNOWN)}
    for i in range(3 * MAX_KNOWN):
        arrivals.hear([name(datum(sequence=i).id)], held)
    known = [datum(sequence=i).id in arrivals for i in range(3 * MAX_KNOWN)]
    assert sum(known[:-MAX_KNOWN]) < MAX_KNOWN / 100
    assert all(known[-MAX_KNOWN:])
    said: list[bytes] = []
    while names := arrivals.latest():
        said += names
    assert len(said) == len(set(said)) == MAX_KNOWN


def test_without_receipts_nothing_is_named() -> None:
    base = make_node(0, base=True, receipts=False)
    base.receive(data(ME, 0, (5, datum())), 0.5)
    assert named(base, 1.0) == ()


# -- another copy that moves on ----------------------------------------------------------------------------------------


def handed(node: Node, turn: int, *, heard: Data | None = None) -> list[int]:
    """The sequences that the node hands over in this turn. `heard`: what it hears before. Nobody answers."""
    hear(node, turn - 0.25)
    if heard is not None:
        node.receive(heard, turn - 0.2)
    found = [h.datum.id.sequence for d in of(Data, node.step(float(turn))) for h in d.handovers if not d.replica]
    for pending in list(node.exchange.open.values()):
        if pending.id in node.holdings.custody:
            node.holdings.put_off(node.holdings.custody[pending.id])
    check_node(node)
    return found


def test_a_copy_waits_while_a_nearer_node_moves_another_one() -> None:
    node = custodian(0, 1)
    heard = data(NEXT, OTHER, (77, datum()))
    moves = [handed(node, turn, heard=heard if turn == 1 else None) for turn in range(1, STATED_TURNS + 10)]
    assert all(1 in found for found in moves)
    turns = [turn for turn, found in enumerate(moves, 1) if 0 in found]
    assert len([turn for turn in turns if turn <= STATED_TURNS]) == STATED_TURNS // SPARED
    assert turns[-8:] == [*range(STATED_TURNS + 2, STATED_TURNS + 10)], "if no base states it, it moves again"
    assert node.holdings.custody.keys() == {datum().id, datum(sequence=1).id}, "it stays in custody"


def test_whoever_repeats_such_frames_holds_nothing_back_for_good() -> None:
    node = custodian(0)
    heard = data(NEXT, OTHER, (77, datum()))
    moves = [turn for turn in range(1, 6 * SPARED) if handed(node, turn, heard=heard)]
    assert all(later - earlier <= SPARED for earlier, later in pairwise(moves))


NOTHING_MOVES: dict[str, Callable[[Data], Data]] = {
    "a replica": lambda said: said._replace(replica=True),
    "no custody is offered": lambda said: said._replace(handovers=(said.handovers[0]._replace(number=0),)),
    "another content": lambda said: data(NEXT, OTHER, (77, datum(payload=b"other"))),
    "noise": lambda said: data(NEXT, OTHER, (77, datum()._replace(payload=b"noise"))),
    "a stranger": lambda said: said._replace(sender=OTHER),
}


@pytest.mark.parametrize("change", NOTHING_MOVES)
def test_what_does_not_show_that_another_copy_moves_holds_nothing_back(change: str) -> None:
    node = custodian(0)
    assert handed(node, 1, heard=NOTHING_MOVES[change](data(NEXT, OTHER, (77, datum())))) == [0]


def test_a_copy_does_not_wait_for_one_that_is_farther_from_the_base() -> None:
    node = custodian(0)
    node.receive(beacon(OTHER, 1, ROUTE._replace(hops=5), policy=node.policy.tag, potential=1), 0.7)
    assert handed(node, 1) == [0]
    assert handed(node, 2, heard=data(OTHER, 9, (77, datum()))) == [0]


def test_a_datum_that_comes_back_waits_no_longer() -> None:
    """Somebody hands it over, and relies on the copy here."""
    node = custodian(0)
    node.receive(data(NEXT, 9, (77, datum())), 0.7)
    node.receive(data(OTHER, ME, (70, datum())), 0.75)
    assert handed(node, 1) == [0]


def test_a_corrupt_copy_of_which_another_moves_is_looked_for_later() -> None:
    node, asked = custodian(0), []
    node.receive(data(NEXT, 9, (77, datum())), 0.7)
    node.custody_store.drop(node.holdings.custody[datum().id], Fate.CORRUPTED)
    for turn in range(1, STATED_TURNS + 5):
        hear(node, turn - 0.25)
        words = [entry.status for m in of(CopyStatuses, node.step(float(turn))) for entry in m.entries]
        asked += [(turn, word) for word in words]
        check_node(node)
    assert asked[:1] == [(STATED_TURNS + 2, CopyStatus.WANTED)]


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
