"""Replicas: how many, where, and what is bounded. What nodes say about them: tests/conversations/replicas."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.effects import Search
from rass_mav.core.custody.repairs import MAX_SEARCHES
from rass_mav.core.custody.replica_messages import ReplicaMessages
from rass_mav.core.datum import DatumId
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
    Route,
)
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE, Dispatch, View
from rass_mav.core.replicas.distant import OFFER_TURNS
from rass_mav.core.replicas.replicas import ASK_STEPS, SILENT
from rass_mav.core.risk import DANGER
from rass_mav.errors import StoreFullError
from tests.extent import examples
from tests.some import some

from .books import check_node, holders, replicas
from .build import MANY, beacon, data, datum, make_node, of, passed_on, tries
from .replica_net import CHAIN, RISKS, Net, at_rest


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


@pytest.mark.parametrize("lost", [0, 3])
def test_a_datum_does_not_rest_alone_because_the_safest_neighbour_answers_nothing(lost: int) -> None:
    """The link to it may carry frames one way only. `lost`: so many of its answers are lost, and then no more."""
    node = make_node(1, mirror=True, policy=Stay())
    id = node.put(b"x", 0.0)
    asked: list[int] = []
    for turn in range(20):
        node.receive(beacon(2, turn, risk=0), turn)
        node.receive(beacon(3, turn, risk=9000), turn)
        for replica in of(Data, node.step(turn + 0.5)):
            asked.append(replica.target)
            if replica.target == 3 or 0 < lost < len(asked):
                [(number, copy)] = replica.handovers
                node.receive(Committed(replica.target, 1, ((number, copy.crc),), ()), turn + 0.6)
    partner = node.holdings.custody[some(id)].partner
    assert some(partner).id == (2 if lost else 3)
    assert 3 not in asked or not lost


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@tries(40)
@given(seed=st.integers(0, 1 << 32), loss=st.sampled_from([0.0, 0.1, 0.3]), immediate=st.booleans())
@example(seed=250, loss=0.3, immediate=False)
@example(seed=59, loss=0.3, immediate=True)
def test_one_copy_at_a_time_may_rot_and_no_datum_is_lost(seed: int, loss: float, immediate: bool) -> None:
    """While one copy of two is struck, then repaired, then the other, and frames get lost: nothing is ever lost."""
    rng = random.Random(seed)
    risks = {i: rng.random() for i in range(1, 6)}
    links = [(i, j) for i in risks for j in risks if i < j and (j == i + 1 or rng.random() < 0.4)]
    # Eight tries at a loss of 0.3 are in vain now and then, and then a datum is lost indeed.
    net = Net(risks, links, immediate=immediate)
    net.loses = lambda message: rng.random() < loss
    net.step(3)
    ids = [net.put(rng.choice(list(risks))) for _ in range(6)]
    for _ in range(8):
        net.step(25)
        id = rng.choice(ids)
        copies = [i for i, store in net.stores.items() if store.get(id) is not None]
        assert net.custody(id), "nobody has custody"
        if len(copies) > 1:
            net.strike(rng.choice(copies), id)
    net.step(25)
    for id in ids:
        assert net.custody(id)
        assert all(copy.intact for store in net.stores.values() if (copy := store.get(id)) is not None)


def test_a_holder_that_is_counted_on_again_is_not_told_that_it_is_not() -> None:
    """It would let its replica go."""
    rests, moved = DatumId(1, 1, 0), DatumId(1, 1, 1)
    replica_messages, out = ReplicaMessages(2), list[Message]()
    for holder, id in ((1, moved), (1, rests), (3, rests)):
        replica_messages.say(holder, id, CopyStatus.PASSED_ON)
    for holder in (1, 3):
        replica_messages.counts_on(holder, rests)
    replica_messages.flush(out)
    assert out == [passed_on(2, 1, moved)]


def test_a_datum_that_waits_though_a_base_can_be_reached_gets_another_holder() -> None:
    """Who gave it says nothing when its copy is gone."""
    node, offered = make_node(2, mirror=True), []
    for turn in range(SILENT * ASK_STEPS + 5):
        node.receive(beacon(1, turn), turn)
        node.receive(beacon(3, turn, Route(7, 9, turn, 1), free=0), turn)
        if turn == 1:
            node.receive(data(1, 2, (5, datum())), turn)
        offered += [turn for message in of(Data, node.step(turn + 0.5)) if message.replica]
        check_node(node)
    assert node.custody_store.holdings.custody.keys() == {datum().id}
    assert offered[0] == SILENT * ASK_STEPS


def test_a_custodian_that_lost_its_numbers_is_the_same_custodian() -> None:
    """It gives its new data another epoch, and has what it held."""
    net = Net(RISKS, CHAIN)
    id = at_rest(net)
    store = net.stores[3]
    net.stores[3] = store.crashed()
    net.stores[3].life, net.stores[3].epoch = store.life, store.epoch + 1
    net.start(3)
    net.step(15)
    assert (net.custody(id), net.active(id)) == ([3], [2])
    assert net.put(3).epoch == store.epoch + 1


def test_a_distant_replica_whose_custodian_is_gone_waits_for_the_receipt_where_a_base_is_in_reach() -> None:
    """In a line of drones of which the first is the safest."""
    net = Net({i: 0.1 * i for i in range(1, 7)}, [(i, i + 1) for i in range(1, 6)], mirror_until_receipt=True,
              distant=True)  # fmt: skip
    net.step()
    id = net.put(1)
    net.step(9)
    assert net.active(id) == [2, 3, 4, 5]
    net.off |= {3}
    for _ in range(40):
        net.step()
        number = int(net.now)
        net.nodes[4].receive(beacon(7, number, Route(7, 9, number, 0), flags=BEACON_BASE, potential=2), net.now)
    assert id in net.nodes[4].holdings.passed_on
    assert net.custody(id) == [1]


# -- bounds and room --------------------------------------------------------------------------------------------------


def test_replicas_yield_the_quota_and_the_beacon_counts_it_as_free() -> None:
    net = Net({2: 0.0}, [], capacity_items=None)
    net.stores[2] = type(net.stores[2])(5, quota_bytes=194)
    node = net.start(2)
    for s in range(2):
        node.receive(Data(1, 2, (Handover(s + 1, datum(sequence=s, payload=bytes(97))),), True), 0.0)
    assert replicas(node) == 2
    assert not node.store.room_for(97)
    [said] = node.step(1.0)
    assert said.free == MANY  # type: ignore[union-attr]
    for _ in range(2):
        node.put(bytes(97), 1.0)
    assert replicas(node) == 0
    [said, *_] = node.step(2.0)
    assert said.free == 0  # type: ignore[union-attr]


@pytest.mark.parametrize("word", list(CopyStatus))
@pytest.mark.parametrize("damaged", [False, True])
def test_words_that_name_a_datum_twice_are_words_about_one_datum(word: CopyStatus, damaged: bool) -> None:
    node, d = make_node(2, mirror=True), datum()
    node.receive(data(3, 2, (5, d)), 0.0)
    for sender in (3, 4):
        node.receive(beacon(sender), 0.0)
    node.step(1.0)
    node.store.commit()  # type: ignore[attr-defined]
    if damaged:
        node.store.flip_bit(d.id)  # type: ignore[attr-defined]
    node.receive(CopyStatuses(3, 2, (CopyStatusEntry(d.id, word),) * 2), 1.2)
    check_node(node)
    assert (d.id in node.holdings.custody) or damaged


@pytest.mark.parametrize("answered", [False, True])
def test_the_copy_that_a_neighbour_looks_for_stays_when_another_custodian_lets_it_go(answered: bool) -> None:
    """2 passed the datum on and forgot it; its present custodian, 3, has lost it. `answered`: 3 was told of this copy,
    but its request to take the datum back is lost."""
    node = make_node(1, mirror=True, mirror_until_receipt=False)
    lost = datum(2)
    node.receive(beacon(2, 0), 0.0)
    node.receive(beacon(3, 0), 0.0)
    node.receive(data(2, 1, (7, lost))._replace(replica=True), 0.1)
    wanted = CopyStatuses(3, BROADCAST, (CopyStatusEntry(lost.id, CopyStatus.WANTED),))
    for turn in range(1 + answered):
        node.receive(wanted, 1.0 + turn)
    node.receive(passed_on(2, 1, lost.id), 4.0)
    [answer] = of(CopyStatuses, node.receive(wanted, 5.0))
    assert answer == CopyStatuses(1, 3, (CopyStatusEntry(lost.id, CopyStatus.HERE),))
    node.receive(CopyStatuses(3, 1, (CopyStatusEntry(lost.id, CopyStatus.AGAIN),)), 6.0)
    assert lost.id in node.holdings.custody


def test_searches_are_bounded() -> None:
    node = make_node(1, mirror=True)
    for s in range(MAX_SEARCHES + 5):
        node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum(sequence=s).id, CopyStatus.AGAIN),)), 0.0)
    assert len(node.exchange.of(Search)) == MAX_SEARCHES
    for t in range(ASK_STEPS):
        # Neither is what is said in a step without bound.
        entries = sum(len(m.entries) for m in of(CopyStatuses, node.step(1.0 + t)))
        assert entries <= 3 * 33


def test_nobody_ends_a_nodes_own_search_by_asking_it_for_others() -> None:
    node = make_node(1, mirror=True)
    repairs = node.custody_store.repairs
    own = datum(sequence=5000).id
    repairs.begin(own, None)
    for s in range(MAX_SEARCHES + 5):
        node.receive(CopyStatuses(2, 1, (CopyStatusEntry(datum(sequence=s).id, CopyStatus.AGAIN),)), 0.0)
    repairs.begin(datum(sequence=5001).id, None)
    assert own in node.exchange.open
    assert len(node.exchange.of(Search)) == MAX_SEARCHES


# -- as many as the risk asks for --------------------------------------------------------------------------------------


#: The neighbours of node 1: 2 is a base, the others are drones with these risks.
NEAR = {3: 0.01, 4: 0.1, 5: 0.2}


def heard(risks: dict[int, float], number: int, *, base: bool = True) -> list[Beacon]:
    """Beacons of the drones with these risks, and of the base 2."""
    beacons = [beacon(id, number, life=id)._replace(risk=int(risk * 65535)) for id, risk in risks.items()]
    route = Route(2, 1, number // 30, 0)
    return beacons + (
        [beacon(2, number, route, flags=BEACON_BASE, free=0xFFFF, potential=POTENTIAL_BASE)] if base else []
    )


def surrounded(risk: float, *, base: bool = True, **settings: Any) -> tuple[Node, float]:
    """Node 1 at this risk amid `NEAR`."""
    node = make_node(1, risk=risk, mirror=True, immediate=True, **settings)
    now = 0.0
    for number in range(60):
        now = float(number)
        for said in heard(NEAR, number, base=base):
            node.receive(said, now)
        now += 0.5
        node.step(now)
    return node, now


def put(node: Node, now: float) -> tuple[list[Data], list[Data]]:
    """Make a datum: what is handed over, and what is sent as a replica."""
    node.put(b"reading", now)
    frames = of(Data, node.forward(now))
    return [f for f in frames if not f.replica], [f for f in frames if f.replica]


@pytest.mark.parametrize("risk", [0.0, DANGER / 2, DANGER, 0.9])
def test_what_rests_alone_gets_one_replica_and_what_moves_on_only_in_danger(risk: float) -> None:
    _, replicas = put(*surrounded(risk, base=False))
    assert [f.target for f in replicas] == [3]
    moved, replicas = put(*surrounded(risk))
    assert [f.target for f in moved] == [2]
    assert [f.target for f in replicas] == ([3] if risk >= DANGER else [])


@pytest.mark.parametrize("risk", [0.0, 0.9])
def test_on_a_full_air_only_what_is_in_danger_gets_a_replica(risk: float) -> None:
    node, now = surrounded(risk, base=False)
    node.pace.queue = 1
    _, replicas = put(node, now)
    assert bool(replicas) == (risk > 0.0)


def test_a_neighbour_that_takes_a_replica_is_its_holder() -> None:
    node, now = surrounded(0.9, base=False)
    id = node.put(b"reading", now)
    [frame] = of(Data, node.forward(now))
    [(number, held)] = frame.handovers
    assert node.receive(Committed(frame.target, 1, ((number, held.crc),), ()), now) == []
    assert holders(node)[id] == 3
    check_node(node)


def test_offers_that_nobody_answers_are_made_anew_and_stay_bounded() -> None:
    node, now = surrounded(0.9, base=False)
    node.put(b"reading", now)
    offers = node.forward(now)
    for number in range(60, 70):
        for said in heard(NEAR, number, base=False):
            node.receive(said, now)
        now += 1.0
        offers += node.step(now)
        check_node(node)
    assert len({f.handovers[0].number for f in of(Data, offers)}) == len(of(Data, offers)) >= 10 // OFFER_TURNS


# -- bandwidth and room for own measurements ---------------------------------------------------------------------------


def test_a_part_of_the_bandwidth_is_left_for_new_data() -> None:
    node, now = surrounded(0.5, bandwidth_items=10, capacity_items=None)
    for s in range(20):
        node.receive(data(3, 1, (s + 1, datum(sequence=s))), now)
    relayed = of(Data, node.forward(now))
    assert sum(len(f.handovers) for f in relayed) == 9
    # What waits has a holder, its sender.
    assert len(node.holdings.custody) == 20
    _, replicas = put(node, now)
    assert [len(f.handovers) for f in replicas] == [1]
    assert replicas[0].handovers[0].datum.id.origin == 1


def test_others_data_leave_room_for_own_measurements() -> None:
    node = make_node(1, capacity_items=5, own_share=0.4)
    assert node.holdings.free() == 5 - 2
    for s in range(4):
        node.receive(data(3, 1, (s + 1, datum(sequence=s))), 0.0)
    assert len(node.holdings.custody) == 3
    assert node.custody_store.refused == 1
    assert of(Beacon, node.step(1.0))[0].free == 0
    own = [node.put(b"own", 1.0) for _ in range(2)]
    assert set(own) < set(node.holdings.custody)
    with pytest.raises(StoreFullError):
        node.put(b"own", 1.0)


def test_the_same_with_bytes() -> None:
    node = make_node(1, capacity_items=None, capacity_bytes=100, own_share=0.4)
    node.receive(data(3, 1, (1, datum(payload=bytes(61)))), 0.0)
    assert len(node.holdings.custody) == 0
    node.receive(data(3, 1, (2, datum(payload=bytes(60)))), 0.0)
    assert len(node.holdings.custody) == 1
    assert node.holdings.free() == 0
    node.put(bytes(40), 0.0)
    assert node.holdings.custody_bytes == 100
