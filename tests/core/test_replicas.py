"""Replicas: hand-overs, repair, and what rests."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import (
    BEACON_BASE,
    BROADCAST,
    UNBOUNDED_FREE,
    Beacon,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
    PassedOn,
    Route,
)
from rass_mav.core.policy import POTENTIAL_BASE, Dispatch, View
from rass_mav.core.replicas.replica_messages import ReplicaMessages
from rass_mav.core.replicas.replicas import ASK_STEPS
from tests.extent import examples

from .books import holders, replicas, replicas_of
from .build import beacon, data, datum, make_node, of, statement
from .replica_net import CHAIN, RISKS, Net, at_rest, handed_over

# -- hand-overs --------------------------------------------------------------------------------------------------------


def test_the_custodian_keeps_a_replica_that_counts_as_free() -> None:
    net = Net(RISKS, CHAIN, capacity_items=3)
    id = handed_over(net)
    custodian = net.nodes[1]
    assert net.active(id) == [1]
    assert net.holder(2, id) == 1
    assert custodian.holdings.free() == 3
    assert len(custodian.holdings.custody) == 0
    assert list(custodian.holdings.custody) == []
    assert custodian.store.get(id) is not None
    assert net.book.copies[id] == 2


def test_the_replica_goes_when_the_datum_is_passed_on_once_more() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    assert net.of(PassedOn) == [PassedOn(2, 1, (id,))]
    assert net.replicas(id) == [2]
    assert net.holder(3, id) == 2
    assert net.stores[1].get(id) is None
    assert net.book.fates == [(id, Fate.PASSED_ON)]


def test_until_a_receipt_the_replica_stays_but_nobody_counts_on_it() -> None:
    net = Net(RISKS, CHAIN, mirror_until_receipt=True)
    id = at_rest(net)
    assert net.replicas(id) == [1, 2]
    assert net.active(id) == [2]


def test_a_base_needs_no_holder() -> None:
    net = Net({0: 0.0, 1: 0.5, 2: 0.5}, [(0, 1), (1, 2)], base=0)
    net.step(12)
    id = net.put(2)
    net.step(3)
    assert id in net.nodes[0].custody_store.arrived
    assert net.replicas(id) == []
    assert not net.nodes[2].holdings.partners


def test_without_replicas_nothing_is_kept_and_nothing_more_is_said() -> None:
    net = Net(RISKS, CHAIN, mirror=False)
    id = at_rest(net)
    assert net.replicas(id) == []
    assert net.of(PassedOn) == net.of(CopyStatuses) == []


# -- repair ------------------------------------------------------------------------------------------------------------


def test_a_corrupt_copy_is_repaired_from_the_holder() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(3, id)
    net.step()
    # 3 found it, asked 2, and 2 has it in custody again.
    assert CopyStatuses(3, 2, (CopyStatusEntry(id, CopyStatus.AGAIN),)) in net.of(CopyStatuses)
    assert CopyStatuses(2, 3, (CopyStatusEntry(id, CopyStatus.TAKEN),)) in net.of(CopyStatuses)
    assert net.custody(id) == [2]
    net.step()
    assert net.custody(id) == [3]
    assert net.replicas(id) == [2]
    taken = net.stores[3].get(id)
    assert taken is not None
    assert taken.intact
    # It was never lost.
    assert list(net.stores[3].losses()) == []
    assert "corrupted" not in net.stores[3].counters()
    assert not replicas_of(net.nodes[3])._repairs.searches


def test_what_is_taken_back_gets_a_replica_at_once() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(3, id)
    net.step()
    assert net.custody(id) == [2]
    assert len(net.active(id)) == 1


def test_with_both_copies_corrupt_the_datum_is_lost() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(3, id)
    net.strike(2, id)
    net.step()
    assert net.custody(id) == net.replicas(id) == []
    # Both look for another copy for as long as a hand-over is tried; only the custodian holds the datum for lost then.
    assert "corrupted" not in net.stores[3].counters()
    net.step(net.nodes[3].settings.max_tries)
    assert list(net.stores[3].losses()) == [(id, Fate.CORRUPTED)]
    assert net.stores[3].counters()["corrupted"] == 1
    assert list(net.stores[2].losses()) == []
    net.step(3)
    assert net.of(CopyStatuses) == []


def test_what_a_holder_answers() -> None:
    net = Net(RISKS, CHAIN)
    id = handed_over(net)
    node, ask = net.nodes[1], CopyStatuses(2, 1, (CopyStatusEntry(id, CopyStatus.AGAIN),))
    # It finds only now that its replica is no better, and looks for one.
    net.strike(1, id)
    assert node.receive(ask, net.now) == [
        CopyStatuses(1, 2, (CopyStatusEntry(id, CopyStatus.NONE),)),
        CopyStatuses(1, BROADCAST, (CopyStatusEntry(id, CopyStatus.WANTED),)),
    ]
    assert id not in node.holdings
    # Of what it never had it has no copy either.
    other = DatumId(7, 7, 7)
    assert node.receive(CopyStatuses(2, 1, (CopyStatusEntry(other, CopyStatus.AGAIN),)), net.now) == [
        CopyStatuses(1, 2, (CopyStatusEntry(other, CopyStatus.NONE),)),
        CopyStatuses(1, BROADCAST, (CopyStatusEntry(other, CopyStatus.WANTED),)),
    ]
    # What it has handed to somebody else may have gone on to the one that asks: rather a copy too many.
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    said = net.nodes[2].receive(CopyStatuses(1, 2, (CopyStatusEntry(id, CopyStatus.AGAIN),)), net.now)
    assert said[-1] == CopyStatuses(2, 1, (CopyStatusEntry(id, CopyStatus.TAKEN),))
    assert net.custody(id) == [2, 3]
    # 1 has no copy any more. It gave the datum to 2, but 2 may have given it to the one that asks.
    for asker in (3, 2):
        said = net.nodes[1].receive(CopyStatuses(asker, 1, (CopyStatusEntry(id, CopyStatus.AGAIN),)), net.now)
        assert said[0] == CopyStatuses(1, asker, (CopyStatusEntry(id, CopyStatus.NONE),))


def test_a_lost_request_is_repeated() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(3, id)
    net.loses = lambda message: type(message) is CopyStatuses
    net.step(3)
    assert net.custody(id) == []
    net.loses = lambda message: False
    net.step()
    assert net.custody(id) == [2]


def test_a_lost_answer_does_no_harm() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(3, id)
    net.loses = lambda message: type(message) is CopyStatuses and message.sender == 2
    net.step()
    assert net.custody(id) == [2]
    net.loses = lambda message: False
    net.step(3)
    assert net.custody(id) == [3]
    assert list(net.stores[3].losses()) == []


def test_a_request_that_nobody_answers_ends() -> None:
    net = Net(RISKS, CHAIN, max_tries=3)
    id = at_rest(net)
    net.strike(3, id)
    net.loses = lambda message: type(message) is CopyStatuses
    asked = 0
    for _ in range(6):
        net.step()
        asked += len([m for m in net.of(CopyStatuses) if m.sender == 3])
    assert asked == 3
    assert list(net.stores[3].losses()) == [(id, Fate.CORRUPTED)]
    # 2 still has its replica, and asks after it in the end.
    net.loses = lambda message: False
    net.step(ASK_STEPS + 1)
    assert net.custody(id) == [3]
    assert list(net.stores[3].losses()) == []


def test_a_corrupt_replica_is_told_and_replaced() -> None:
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    net.strike(2, id)
    net.step()
    assert CopyStatuses(2, 3, (CopyStatusEntry(id, CopyStatus.NONE),)) in net.of(CopyStatuses)
    assert net.custody(id) == [3]
    # 2 is the only neighbour that 3 has.
    assert net.active(id) == [2]
    assert net.holder(3, id) == 2
    copy = net.stores[2].get(id)
    assert copy is not None
    assert copy.intact


# -- data that rest ----------------------------------------------------------------------------------------------------


def resting(net: Net, i: int) -> DatumId:
    """A new datum of a node that has no way to go."""
    net.step()
    return net.put(i)


def test_a_datum_at_rest_is_replicated_on_the_safest_neighbour() -> None:
    net = Net({1: 0.0, 2: 0.5, 3: 0.2, 4: 0.3}, [(1, 2), (1, 3), (1, 4), (2, 3)])
    id = resting(net, 1)
    sent = net.nodes[1].pace.sent
    net.step()
    [replica] = net.of(Data)
    assert (replica.target, replica.replica) == (3, True)
    assert net.custody(id) == [1]
    assert net.active(id) == [3]
    assert net.holder(1, id) == 3
    assert net.nodes[1].pace.sent == sent + 1
    assert net.book.copies[id] == 2
    net.step(5)
    assert net.of(Data) == []


def test_replicas_take_what_moves_leave_of_the_bandwidth() -> None:
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)], bandwidth_items=3)
    net.step()
    ids = [net.put(1) for _ in range(5)]
    net.step()
    assert sum(len(d.handovers) for d in net.of(Data)) == 3
    net.step()
    assert all(net.active(id) == [2] for id in ids)


def test_a_full_neighbour_is_offered_none_and_a_refusal_leads_to_another() -> None:
    net = Net({1: 0.0, 2: 0.0, 3: 0.2}, [(1, 2), (1, 3)])
    net.start(2, capacity_items=1)
    resting(net, 2)
    # 2 was empty when it was last heard.
    net.loses = lambda message: type(message) is Beacon
    id = net.put(1)
    net.step()
    assert [m.sender for m in net.of(Committed) if m.refused] == [2]
    assert net.active(id) == [3]
    assert net.nodes[1].pace.sent == 2


def test_a_neighbour_without_replicas_refuses() -> None:
    node = make_node(2)
    d = datum()
    [answer] = node.receive(Data(1, 2, (Handover(5, d),), True), 0.0)
    assert answer == Committed(2, 1, (), (5,))
    assert node.store.get(d.id) is None


@pytest.mark.parametrize("custodian", [1, 3])
def test_of_two_custodians_of_data_that_rest_each_counts_on_the_other_and_on_no_third_node(custodian: int) -> None:
    node = make_node(2, mirror=True)
    d = datum()
    node.receive(data(1, 2, (4, d)), 0.0)
    [answer] = node.receive(Data(custodian, 2, (Handover(5, d),), True), 0.0)
    assert answer == (Committed(2, 1, ((5, d.crc),), ()) if custodian == 1 else Committed(2, 3, (), (5,)))
    assert d.id in node.holdings.custody
    assert replicas(node) == 0
    # When the other one hands its copy on, or has lost it, nobody backs this one any more.
    assert holders(node) == {d.id: 1}
    node.receive(PassedOn(custodian, 2, (d.id,)), 0.0)
    assert holders(node) == ({} if custodian == 1 else {d.id: 1})


def test_a_holder_that_asks_for_the_datum_has_none() -> None:
    for word in (CopyStatus.AGAIN, CopyStatus.WANTED):
        node = make_node(2, mirror=True)
        d = datum()
        node.receive(data(1, 2, (4, d)), 0.0)
        node.receive(CopyStatuses(1, 2, (CopyStatusEntry(d.id, word),)), 0.0)
        assert d.id in node.holdings.custody
        assert holders(node) == {}


def test_a_replica_of_data_that_rest_which_moves_on_is_no_replica_for_its_custodian() -> None:
    """Another custodian of the same datum hands it over."""
    node = make_node(2, mirror=True)
    d = datum()
    node.receive(Data(3, 2, (Handover(4, d),), True), 0.0)
    assert replicas(node) == 1
    answers = node.receive(data(1, 2, (5, d)), 0.0)
    assert CopyStatuses(2, 3, (CopyStatusEntry(d.id, CopyStatus.NONE),)) in answers
    assert d.id in node.holdings.custody


def test_another_datum_under_the_same_id_is_refused() -> None:
    node = make_node(2, mirror=True)
    d = datum()
    other = datum(payload=b"other")
    assert other.id == d.id
    node.receive(Data(1, 2, (Handover(4, d),), True), 0.0)
    for replica in (True, False):
        [answer] = node.receive(Data(3, 2, (Handover(5, other),), replica), 0.0)
        assert answer == Committed(2, 3, (), (5,))
    kept = node.store.get(d.id)
    assert kept is not None
    assert kept.payload == b"reading"


def test_a_replica_sent_to_a_base_has_arrived() -> None:
    node = make_node(0, base=True)
    d = datum()
    [answer] = node.receive(Data(1, 0, (Handover(4, d),), True), 0.0)
    assert answer == Committed(0, 1, ((4, d.crc),), ())
    assert d.id in node.custody_store.arrived


def test_the_word_for_a_replica_never_ends_custody() -> None:
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)])
    id = resting(net, 1)
    net.step()
    [said] = net.of(Committed)
    for _ in range(3):
        net.nodes[1].receive(said, net.now)
    assert net.custody(id) == [1]


def test_an_offer_that_is_not_answered_is_repeated_after_two_steps() -> None:
    # Beacons repeat no answers.
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)], measured=False)
    net.loses = lambda message: type(message) is Committed
    id = resting(net, 1)
    offers = []
    for _ in range(3):
        net.step()
        offers.append(len(net.of(Data)))
    assert offers == [1, 0, 1]
    assert net.active(id) == [2]
    assert net.holder(1, id) is None
    net.loses = lambda message: False
    net.step(2)
    assert net.holder(1, id) == 2


def test_only_who_was_offered_a_replica_becomes_the_holder() -> None:
    net = Net({1: 0.0, 2: 0.5}, [(1, 2)])
    id = resting(net, 1)
    net.loses = lambda message: type(message) is Committed
    net.step()
    [offered] = net.of(Data)
    [handover] = offered.handovers
    for sender, crc in ((3, handover.datum.crc), (2, handover.datum.crc ^ 1)):
        net.nodes[1].receive(Committed(sender, 1, ((handover.number, crc),), ()), net.now)
        assert net.holder(1, id) is None
    net.nodes[1].receive(Committed(2, 1, ((handover.number, handover.datum.crc),), ()), net.now)
    assert net.holder(1, id) == 2


class Stay:
    """Nothing ever moves."""

    name = "stay"
    tag = 9
    replicates = False
    costs = None
    risk_gain = 1.0
    seq_period = 30
    own_share = 0.0

    def potential(self, hops: int, risk: float, free: int) -> int:
        return 1

    def plan(self, view: View) -> list[Dispatch]:
        return []


def test_a_base_is_asked_to_keep_no_replica() -> None:
    node = make_node(1, mirror=True, policy=Stay())
    node.receive(beacon(0, 0, flags=BEACON_BASE, free=UNBOUNDED_FREE), 0.0)
    node.put(b"x", 0.0)
    assert of(Data, node.step(0.5)) == []
    node.receive(beacon(2, 0), 0.6)
    [replica] = of(Data, node.step(1.0))
    assert replica.target == 2


def test_large_data_rest_without_a_replica_but_their_custodian_keeps_a_copy() -> None:
    net = Net(RISKS, CHAIN)
    net.step()
    id = net.put(1, bytes(500))
    net.step()
    assert net.custody(id) == [2]
    assert net.active(id) == [1]
    net.step()
    assert net.custody(id) == [3]
    net.step()
    assert net.active(id) == [2]
    net.strike(3, id)
    net.step(2)
    assert net.custody(id) == [3]
    net.strike(2, id)
    net.step(3)
    assert net.replicas(id) == []


# -- all together ------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@given(seed=st.integers(0, 1 << 32), loss=st.sampled_from([0.0, 0.1, 0.3]), immediate=st.booleans(), auto=st.booleans())
def test_one_copy_at_a_time_may_rot_and_no_datum_is_lost(seed: int, loss: float, immediate: bool, auto: bool) -> None:
    """While one copy of two is struck, then repaired, then the other, and frames get lost: nothing is ever lost."""
    rng = random.Random(seed)
    risks = {i: rng.random() for i in range(1, 6)}
    links = [(i, j) for i in risks for j in risks if i < j and (j == i + 1 or rng.random() < 0.4)]
    # Eight tries at a loss of 0.3 are in vain now and then, and then a datum is lost indeed.
    net = Net(risks, links, immediate=immediate, copies_auto=auto, max_tries=40)
    net.loses = lambda message: rng.random() < loss
    net.step(3)
    ids = [net.put(rng.choice(list(risks))) for _ in range(6)]
    for _ in range(8):
        net.step(25)
        id = rng.choice(ids)
        holders = [i for i, store in net.stores.items() if store.get(id) is not None]
        assert net.custody(id), "nobody has custody"
        if len(holders) > 1:
            net.strike(rng.choice(holders), id)
    net.step(25)
    for id in ids:
        copies = [copy for store in net.stores.values() if (copy := store.get(id)) is not None]
        assert net.custody(id)
        assert all(copy.intact for copy in copies)


@pytest.mark.parametrize("until_receipt", [False, True])
def test_a_replicated_swarm_delivers_and_forgets(until_receipt: bool) -> None:
    risks = {i: 0.1 * i for i in range(5)}
    net = Net(risks, [(i, i + 1) for i in range(4)], base=0, mirror_until_receipt=until_receipt, receipts=True)
    net.step(15)
    ids = [net.put(4) for _ in range(5)]
    net.step(10)
    assert all(id in net.nodes[0].custody_store.arrived for id in ids)
    assert all(net.custody(id) == [] for id in ids)
    left = [i for id in ids for i in net.active(id)]
    assert left == []


@pytest.mark.parametrize(
    ("settings", "kept"),
    [({}, True), ({"mirror_until_receipt": False}, False), ({"receipts": False}, False)],
)
def test_what_a_base_has_taken_is_kept_until_a_receipt_for_anybody_may_say_that_it_is_a_base(
    settings: dict[str, Any], kept: bool
) -> None:
    node = make_node(1, mirror=True, **settings)
    route = Route(0, 9, 1, 0)
    node.receive(
        beacon(0, 0, route, flags=BEACON_BASE, free=UNBOUNDED_FREE, policy=node.policy.tag, potential=POTENTIAL_BASE),
        0.0,
    )
    id = node.put(b"x", 0.0)
    [sent] = of(Data, node.step(0.5))
    [handover] = sent.handovers
    node.receive(Committed(0, 1, ((handover.number, handover.datum.crc),), ()), 0.5)
    assert id not in node.holdings.custody
    assert (id in node.holdings) == kept
    node.receive(statement(id), 1.0)
    assert (id in node.holdings) == (kept and not node.settings.receipts)


def test_two_holders_of_one_datum_are_told_in_one_frame() -> None:
    replica_messages, out = ReplicaMessages(2, lambda id: False), list[Message]()
    id = DatumId(1, 1, 0)
    replica_messages.passed_on(1, id)
    replica_messages.passed_on(3, id)
    replica_messages.flush(out)
    assert out == []
    replica_messages.step()
    replica_messages.flush(out)
    assert out == [PassedOn(2, BROADCAST, (id,), (1, 3))]


def test_a_holder_that_is_counted_on_is_not_told_what_others_are() -> None:
    """It would take it for its own, and let its replica go."""
    rests, moved = DatumId(1, 1, 0), DatumId(1, 1, 1)
    replica_messages, out = ReplicaMessages(2, lambda id: id == rests), list[Message]()
    replica_messages.passed_on(1, moved)
    replica_messages.passed_on(3, moved)
    replica_messages.passed_on(1, rests)
    replica_messages.step()
    replica_messages.flush(out)
    assert out == [PassedOn(2, BROADCAST, (moved,), (1, 3)), PassedOn(2, 1, (rests,))]
