"""Repairs: a datum whose custodian and holder have no good copy is found with whoever had it before."""

from __future__ import annotations

import pytest

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BROADCAST, Committed, CopyStatus, CopyStatusEntry, CopyStatuses, Data, PassedOn
from rass_mav.core.replicas.repairs import MAX_SEARCHES
from rass_mav.core.replicas.replicas import ASK_STEPS

from .books import replicas_of
from .build import datum, make_node, of, statement
from .replica_net import CHAIN, RISKS, Net, at_rest


def said(net: Net, word: CopyStatus) -> list[tuple[int, int]]:
    """Who said a word in the last step, and to whom."""
    return [(m.sender, m.target) for m in net.of(CopyStatuses) for entry in m.entries if entry.status == word]


def meet(net: Net, a: int, b: int) -> None:
    """Two nodes come into each other's range."""
    net.links.add(frozenset((a, b)))
    net.step()


def test_who_had_the_datum_before_the_holder_takes_it_back() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    meet(net, 1, 3)
    # 1 left it behind, 2 backs it, 3 has custody.
    assert net.replicas(id) == [1, 2]
    net.strike(2, id)
    net.strike(3, id)
    net.step()
    assert net.custody(id) == [1]
    net.step(3)
    assert net.custody(id) == [3]
    assert list(net.stores[3].losses()) == []
    assert "corrupted" not in net.stores[3].counters()


def test_a_holder_that_was_asked_in_vain_asks_those_out_of_the_custodians_range() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    net.strike(2, id)
    net.strike(3, id)
    net.step()
    # Only 2 hears 1.
    assert net.custody(id) == [1]
    net.step(3)
    assert net.custody(id) == [3]


def test_only_the_first_who_has_a_replica_takes_it_back() -> None:
    net = Net({**RISKS, 4: 0.9, 5: 0.9}, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    for other in (1, 4, 5):
        meet(net, other, 3)
    copy = net.stores[1].get(id)
    assert copy is not None
    for other in (4, 5):
        assert net.nodes[other].custody_store.keep_replica(3, 1, copy)
        net.nodes[other].receive(PassedOn(3, other, (id,)), net.now)
    assert net.replicas(id) == [1, 2, 4, 5]
    net.strike(2, id)
    net.strike(3, id)
    net.step()
    assert len(net.custody(id)) == 1
    assert {(1, 3), (4, 3), (5, 3)} <= set(said(net, CopyStatus.HERE))


def test_a_datum_without_a_holder_is_looked_for_too() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    meet(net, 1, 3)
    # The holder has lost its replica, and before there is another, the copy in custody is struck as well.
    net.loses = lambda message: type(message) is Data
    net.strike(2, id)
    net.step()
    assert net.holder(3, id) is None
    net.strike(3, id)
    net.step()
    assert net.custody(id) == [1]


def test_alone_with_no_holder_the_datum_is_lost_at_once() -> None:
    net = Net({3: 0.1}, [])
    net.step()
    id = net.put(3)
    net.strike(3, id)
    net.step()
    assert list(net.stores[3].losses()) == [(id, Fate.CORRUPTED)]
    assert net.stores[3].counters()["corrupted"] == 1


def test_what_a_neighbour_says_to_a_search() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    wanted = CopyStatuses(9, BROADCAST, (CopyStatusEntry(id, CopyStatus.WANTED),))
    # 3 has custody, 2 a replica of what 3 has. 1 was told that it is not counted on.
    for node, word in ((3, CopyStatus.TAKEN), (2, CopyStatus.HERE), (1, CopyStatus.HERE)):
        assert net.nodes[node].receive(wanted, net.now) == [CopyStatuses(node, 9, (CopyStatusEntry(id, word),))]
    unknown = CopyStatuses(9, BROADCAST, (CopyStatusEntry(DatumId(7, 7, 7), CopyStatus.WANTED),))
    assert net.nodes[1].receive(unknown, net.now) == []
    # A receipt is no reason to say that somebody has it.
    net.nodes[1].receive(statement(DatumId(7, 7, 7)), net.now)
    assert net.nodes[1].receive(unknown, net.now) == []


def test_a_late_answer_to_a_search_is_ignored() -> None:
    node = make_node(1, mirror=True)
    assert node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum().id, CopyStatus.HERE),)), 0.0) == []


def test_who_says_here_and_then_has_nothing_does_not_end_the_search() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    net.strike(3, id)
    net.loses = lambda message: type(message) is CopyStatuses
    net.step()
    node = net.nodes[3]
    node.receive(CopyStatuses(2, 3, (CopyStatusEntry(id, CopyStatus.NONE),)), net.now)
    assert node.receive(CopyStatuses(8, 3, (CopyStatusEntry(id, CopyStatus.HERE),)), net.now) == [
        CopyStatuses(3, 8, (CopyStatusEntry(id, CopyStatus.AGAIN),))
    ]
    assert node.receive(CopyStatuses(8, 3, (CopyStatusEntry(id, CopyStatus.NONE),)), net.now) == [
        CopyStatuses(3, BROADCAST, (CopyStatusEntry(id, CopyStatus.WANTED),))
    ]
    net.loses = lambda message: False
    net.step()
    assert net.custody(id) == [2]


def test_a_search_on_anothers_behalf_ends_without_a_loss() -> None:
    node = make_node(1, mirror=True, max_tries=2)
    node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum().id, CopyStatus.AGAIN),)), 0.0)
    asked = [of(CopyStatuses, node.step(float(t))) for t in range(1, 5)]
    assert [len(step) for step in asked] == [0, 1, 0, 0]
    assert not replicas_of(node)._repairs.searches
    assert list(node.store.losses()) == []


def test_it_never_says_that_custody_is_where_it_only_looks_for_the_datum() -> None:
    node = make_node(1, mirror=True)
    ask = CopyStatuses(2, 1, (CopyStatusEntry(datum().id, CopyStatus.AGAIN),))
    node.receive(ask, 0.0)
    [answer] = node.receive(ask, 0.0)
    assert answer == CopyStatuses(1, 2, (CopyStatusEntry(datum().id, CopyStatus.NONE),))
    [still] = node.receive(CopyStatuses(3, 1, (CopyStatusEntry(datum().id, CopyStatus.STILL),)), 0.0)
    assert still == CopyStatuses(1, 3, (CopyStatusEntry(datum().id, CopyStatus.AGAIN),))


def test_searches_are_bounded() -> None:
    node = make_node(1, mirror=True)
    for s in range(MAX_SEARCHES + 5):
        node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum(sequence=s).id, CopyStatus.AGAIN),)), 0.0)
    assert len(replicas_of(node)._repairs.searches) == MAX_SEARCHES
    for t in range(ASK_STEPS):
        # Neither is what is said in a step without bound.
        entries = sum(len(m.entries) for m in of(CopyStatuses, node.step(1.0 + t)))
        assert entries <= 3 * 33


def test_nobody_ends_a_nodes_own_search_by_asking_it_for_others() -> None:
    node = make_node(1, mirror=True)
    repairs = replicas_of(node)._repairs
    own = datum(sequence=5000).id
    repairs.begin(own, None)
    for s in range(MAX_SEARCHES + 5):
        node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum(sequence=s).id, CopyStatus.AGAIN),)), 0.0)
    repairs.begin(datum(sequence=5001).id, None)
    assert own in repairs.searches
    assert len(repairs.searches) == MAX_SEARCHES


@pytest.mark.parametrize("word", [CopyStatus.AGAIN, CopyStatus.WANTED])
def test_a_late_committed_does_not_end_the_custody_that_its_sender_was_told_of(word: CopyStatus) -> None:
    """A sender answers *taken* to the node that it is handing the datum over to: that node then relies on the
    sender."""
    net = Net({1: 0.9, 2: 0.1}, [(1, 2)], mirror_until_receipt=True)
    net.loses = lambda message: isinstance(message, Committed)
    net.step(2)
    custodian = net.nodes[1]
    id = custodian.put(b"x", net.now)
    net.step()
    (handover,) = (m.handovers[0] for m in net.of(Data) if m.sender == 1)
    answers = custodian.receive(
        CopyStatuses(2, 1 if word == CopyStatus.AGAIN else BROADCAST, (CopyStatusEntry(id, word),)), net.now
    )
    assert [entry.status for m in answers if isinstance(m, CopyStatuses) for entry in m.entries] == [CopyStatus.TAKEN]
    custodian.receive(Committed(2, 1, ((handover.number, handover.datum.crc),), ()), net.now)
    assert id in custodian.custody_store.holdings.custody


def test_a_holder_without_a_copy_does_not_answer_for_a_node_that_passed_the_datum_on() -> None:
    """1 gave the datum to 2, which gave it to 3. Since 3 sent its replica to 1, custody is where that came from."""
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    meet(net, 1, 3)
    copy = net.stores[1].get(id)
    assert copy is not None
    assert net.nodes[1].custody_store.keep_replica(3, 1, copy)
    net.strike(1, id)
    answers = net.nodes[1].receive(CopyStatuses(3, 1, (CopyStatusEntry(id, CopyStatus.AGAIN),)), net.now)
    assert answers[0] == CopyStatuses(1, 3, (CopyStatusEntry(id, CopyStatus.NONE),))
