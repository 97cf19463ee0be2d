"""Who takes data and brings no receipts loses rank, and what it has is handed over again; nobody else is blamed."""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.journal import (
    JUDGED_TURNS,
    LEAST,
    LONGEST_REST,
    MAX_ENTRIES,
    MAX_FORWARDERS,
    MOST_HOPS,
    NEWS_TURNS,
    Journal,
)
from rass_mav.core.datum import DatumId
from rass_mav.core.exchange import MAX_TRIES
from rass_mav.core.messages import (
    NO_ROUTE,
    Accept,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Offer,
    ReceiptEntry,
    Route,
)
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.statements import RECEIPT_BITS, entry_of, make_receipt
from rass_mav.core.node import Node
from rass_mav.core.routes.costs import COST_ONE
from tests.extent import examples
from tests.some import some

from .books import check_node
from .build import beacon, datum, make_node, of
from .durable import DurableStore
from .routing_harness import rough_times

OWN, NEAR, FAR, FARTHER = 2, 3, 4, 5
#: Turns until a datum is overdue at a neighbour that is one hop from the base.
WAIT = 2 * JUDGED_TURNS
#: An origin whose data arrive all the time without this node, so that there is news.
OTHERS = 99


class Drone:
    """Drone 2, which creates a datum a turn. Its neighbours say how far they are from the base, and take all they get.
    What is taken by those who deliver is confirmed some turns later."""

    def __init__(self, *, policy: str = "survival", store: DurableStore | None = None, **settings: Any) -> None:
        self.ways = {NEAR: 1, FAR: 2, FARTHER: 3}
        self.deliver = {NEAR, FAR, FARTHER}
        self.mute: set[int] = set()
        """They are heard, and answer nothing."""
        self.refuse: set[int] = set()
        """They take nothing."""
        self.stall: set[int] = set()
        """They accept large data, and report no chunk."""
        self.delay = 5
        self.news = True
        self.settings = {"capacity_items": 500, **settings, "policy": policy}
        self.now = 0.0
        self.node = self.start(store)
        self.serial = 0
        self.stated: defaultdict[tuple[int, int], Ranges] = defaultdict(Ranges)
        """What the base has stated, by origin and epoch."""
        self.due: dict[int, list[DatumId]] = {}
        self.given: Counter[int] = Counter()
        """Who got how many data since this was cleared."""
        self.arrived: set[DatumId] = set()
        self.dropped: list[DatumId] = []
        """Taken by those who do not deliver."""

    def start(self, store: DurableStore | None = None) -> Node:
        settings: dict[str, Any] = {"mirror": True, **self.settings}
        self.node = make_node(OWN, store=store, now=self.now, **settings)
        return self.node

    def turn(self, *, creates: int = 1) -> None:
        node = self.node
        self.now += 1.0
        turn = int(self.now)
        for id, hops in self.ways.items():
            way = (1, 1, turn, hops) if hops != NO_ROUTE else None
            cost = hops * COST_ONE // 10 if node.policy.costs is not None else (1 << 24) // hops
            said = beacon(id, turn, Route(*way) if way else None, policy=node.policy.tag, potential=cost)
            node.receive(said, self.now)
        if self.news:
            self.confirm([DatumId(OTHERS, 7, turn)])
        self.confirm(self.due.pop(turn, []))
        for _ in range(creates):
            node.put(b"x", self.now)
        self._take(node.step(self.now))
        check_node(node)

    def _take(self, out: list[Any]) -> None:
        for offer in of(Offer, out):
            if offer.target in self.stall:
                self.node.receive(Accept(OWN, offer.target, offer.number, 7, 0), self.now)
            else:
                self.node.receive(Committed(offer.target, OWN, ((offer.number, offer.crc),), ()), self.now)
        for data in of(Data, out):
            if data.replica:
                continue
            self.given[data.target] += len(data.handovers)
            if data.target in self.mute:
                continue
            if data.target in self.refuse:
                refused = tuple(number for number, _ in data.handovers)
                self.node.receive(Committed(data.target, OWN, (), refused), self.now)
                continue
            taken = tuple((number, datum.crc) for number, datum in data.handovers)
            self.node.receive(Committed(data.target, OWN, taken, ()), self.now)
            for _, taken_over in data.handovers:
                if data.target in self.deliver:
                    self.due.setdefault(int(self.now) + self.delay, []).append(taken_over.id)
                else:
                    self.dropped.append(taken_over.id)

    def confirm(self, ids: list[DatumId]) -> None:
        """As a base does it: a statement about all around that has arrived."""
        self.arrived.update(ids)
        for id in ids:
            self.serial += 1
            known = self.stated[id.origin, id.epoch]
            known.add(id.sequence, id.sequence + 1)
            entry = some(entry_of(id.origin, id.epoch, known, id.sequence // RECEIPT_BITS, lost=False))
            self.node.receive(make_receipt(1, 1, self.serial, [entry]), self.now)

    def turns(self, count: int, *, creates: int = 1) -> None:
        for _ in range(count):
            self.turn(creates=creates)

    @property
    def suspected(self) -> set[int]:
        return {id for id, n in self.node.routing.neighbours.items() if n.suspected}


def seasoned(**settings: Any) -> Drone:
    """A drone whose data have gone by the nearest neighbour, and arrived."""
    drone = Drone(**settings)
    drone.turns(30)
    assert drone.given[NEAR] == 30
    drone.given.clear()
    return drone


def test_a_base_is_not_suspected_while_its_receipts_take_long_from_the_beginning() -> None:
    """A base that reports about a hundred origins, ten in every third turn, has said nothing of the first datum for
    twenty-five turns."""
    drone = Drone()
    drone.confirm([DatumId(origin, 7, 0) for origin in range(OTHERS, OTHERS + 100)])
    drone.ways[NEAR], drone.delay = 0, 25
    for _ in range(60):
        drone.turn()
        assert not drone.suspected
    assert drone.given[NEAR] == 60


def test_a_neighbour_is_not_suspected_while_many_bases_have_much_to_report() -> None:
    """Eight bases report about a hundred origins each, and their statements pass the same neighbours one by one."""
    drone, first = Drone(), Ranges()
    first.add(0, 1)
    for base in range(1, 9):
        for origin in range(100 * base, 100 * base + 100):
            drone.serial += 1
            entry = some(entry_of(origin, 7, first, 0, lost=False))
            drone.node.receive(make_receipt(base, 1, drone.serial, [entry]), drone.now)
    drone.delay = 80
    for _ in range(200):
        drone.turn()
        assert not drone.suspected


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["survival", "rass", "hop-count"])
@pytest.mark.parametrize("mirror", [True, False])
def test_who_brings_no_receipts_is_given_no_more_than_a_datum_now_and_then(policy: str, mirror: bool) -> None:
    drone = seasoned(policy=policy, mirror=mirror)
    drone.deliver = {FAR, FARTHER}
    drone.turns(3 * WAIT)
    assert drone.suspected == {NEAR}
    # What it took until the first were overdue, and a few more until it was suspected.
    assert drone.given[NEAR] <= 3 * WAIT
    drone.given.clear()
    drone.turns(1000)
    assert drone.suspected == {NEAR}
    assert 2 <= drone.given[NEAR] <= 10
    assert drone.given[FAR] >= 990


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("silent", "mirror"),
    [
        (20 * WAIT, True),
        (0, False),
        pytest.param(0, True, marks=pytest.mark.soak),
        pytest.param(20 * WAIT, False, marks=pytest.mark.soak),
    ],
)
def test_a_drone_whose_only_neighbour_failed_for_long_hands_over_to_it_again(mirror: bool, silent: int) -> None:
    """There is no news of arrivals then, because nothing arrives. That must not keep it so."""
    drone = seasoned(mirror=mirror)
    drone.ways = {NEAR: 1}
    drone.deliver = set()
    drone.turns(20 * WAIT)
    assert drone.suspected == {NEAR}
    drone.news = False
    drone.turns(silent, creates=0)
    drone.deliver = {NEAR}
    drone.turns(40 * WAIT, creates=0)
    assert not drone.suspected
    assert not drone.node.holdings.custody


def test_who_is_given_what_has_arrived_already_is_not_blamed_for_it() -> None:
    """No base confirms it once more."""
    drone = seasoned()
    drone.ways = {NEAR: 1}
    drone.turns(drone.delay + 1, creates=0)
    drone.deliver = set()
    drone.confirm([drone.node.put(b"known", drone.now) for _ in range(20)])
    drone.turns(5 * WAIT, creates=0)
    assert not drone.node.holdings.custody
    assert not drone.suspected


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["survival", "rass"])
def test_what_it_has_goes_out_again_at_once(policy: str) -> None:
    drone = seasoned(policy=policy)
    drone.deliver = {FAR, FARTHER}
    while not drone.suspected:
        drone.turn()
    missing = len(set(drone.node.holdings) - drone.arrived)
    # A tenth of the bandwidth, and then the receipts.
    drone.turns(missing + 20)
    assert len(set(drone.node.holdings) - drone.arrived) <= drone.delay + 3


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["survival", pytest.param("rass", marks=pytest.mark.soak)])
def test_who_delivers_again_is_trusted_again(policy: str) -> None:
    drone = seasoned(policy=policy)
    drone.deliver = {FAR, FARTHER}
    drone.turns(200)
    assert drone.suspected == {NEAR}
    drone.deliver = {NEAR, FAR, FARTHER}
    drone.turns(600)
    assert not drone.suspected
    drone.given.clear()
    drone.turns(20)
    assert drone.given == {NEAR: 20}


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["survival", pytest.param("rass", marks=pytest.mark.soak)])
def test_the_only_way_is_tried_with_few_data_and_used_as_before_when_it_delivers(policy: str) -> None:
    drone = seasoned(policy=policy, capacity_items=2000)
    drone.ways = {NEAR: 1}
    drone.deliver = set()
    drone.turns(400)
    assert drone.suspected == {NEAR}
    drone.given.clear()
    drone.turns(100)
    assert drone.given[NEAR] <= 3
    drone.deliver = {NEAR}
    drone.turns(700)
    assert not drone.suspected
    assert len(drone.node.holdings.custody) <= 10


@pytest.mark.no_cover
@pytest.mark.parametrize("times", [3, 5])
def test_who_becomes_much_slower_is_trusted_again(times: int) -> None:
    drone = seasoned(mirror=False)
    drone.delay = times * WAIT
    drone.turns(500)
    assert not drone.suspected
    drone.given.clear()
    drone.turns(20)
    assert drone.given == {NEAR: 20}


def test_what_arrives_by_another_way_is_no_credit_to_who_has_dropped_it() -> None:
    """As beside a drone that drops what it takes: those that had the data before have sent them again."""
    drone = seasoned(mirror=False)
    drone.deliver = {FAR, FARTHER}
    while not drone.suspected:
        drone.turn()
    drone.confirm(drone.dropped)
    drone.turn()
    assert drone.suspected == {NEAR}


@pytest.mark.no_cover
def test_who_is_farther_has_more_time() -> None:
    first: dict[int, int] = {}
    for hops in (1, 2, MOST_HOPS, 200):
        drone = seasoned()
        drone.ways = {NEAR: hops}
        drone.deliver = set()
        while not drone.suspected:
            drone.turn()
        first[hops] = int(drone.now)
    assert first[1] < first[2] < first[MOST_HOPS] == first[200]


@pytest.mark.no_cover
@pytest.mark.parametrize("cause", ["no route", "no news", "forwarder not heard"])
def test_nobody_is_judged_while_receipts_cannot_come(cause: str) -> None:
    drone = seasoned()
    drone.deliver = set()
    drone.turns(10)
    ways = dict(drone.ways)
    if cause == "no news":
        drone.news = False
        drone.turns(NEWS_TURNS)
    elif cause == "forwarder not heard":
        # What goes out again meanwhile goes by another.
        del drone.ways[NEAR]
        drone.deliver = {FAR, FARTHER}
    else:
        drone.ways = dict.fromkeys(drone.ways, NO_ROUTE)
    drone.turns(210, creates=0)
    drone.ways, drone.news = ways, True
    drone.turns(2, creates=0)
    assert not drone.suspected


@pytest.mark.parametrize("settings", [{"receipts": False}, {"acknowledged": False, "mirror": False}])
def test_where_receipts_are_off_nobody_is_judged(settings: dict[str, Any]) -> None:
    drone = Drone(**settings)
    drone.deliver = set()
    drone.turns(200)
    assert drone.given[FAR] == drone.given[FARTHER] == 0
    assert "doubted" not in drone.node.figures()


@pytest.mark.no_cover
@pytest.mark.parametrize("names", ["invented", "ahead"])
@pytest.mark.parametrize("policy", ["survival", pytest.param("rass", marks=pytest.mark.soak)])
def test_junk_discredits_nobody(policy: str, names: str) -> None:
    """A neighbour hands over data that no base confirms: the drone that takes them from here is honest. They name
    origins that do not exist, or numbers that drones have not assigned yet."""
    drone = seasoned(policy=policy)
    if names == "ahead":
        drone.confirm([datum(50 + i, 0).id for i in range(3)])
    for sequence in range(1, 301):
        junk = Data(6, OWN, tuple(Handover(1 + 3 * sequence + i, datum(50 + i, sequence)) for i in range(3)))
        drone.node.receive(beacon(6, 1 + sequence), drone.now)
        drone.node.receive(junk, drone.now)
        known = dict(drone.due)
        drone.turn()
        # What is junk brings no receipt.
        for turn, ids in drone.due.items():
            drone.due[turn] = [id for id in ids if id.origin == OWN or turn in known]
    assert not drone.suspected
    drone.given.clear()
    drone.turns(5)
    assert drone.given[NEAR] >= 5


@pytest.mark.parametrize("is_known", [False, True])
@pytest.mark.parametrize("how", ["mute", "refuse"])
def test_who_is_heard_and_takes_nothing_holds_nothing_up_until_it_does(how: str, is_known: bool) -> None:
    """A link that carries frames one way only, or a captured drone that wants to hold data up."""
    drone = seasoned() if is_known else Drone()
    setattr(drone, how, {NEAR})
    drone.turns(200)
    # One that has delivered much and refuses is dearer than the next before it is suspected.
    assert NEAR in drone.suspected or (how, is_known) == ("refuse", True)
    assert FAR not in drone.suspected
    assert drone.node.figures()["handovers_pending"] <= 1
    drone.given.clear()
    drone.turns(LONGEST_REST)
    # Each probe is sent up to eight times.
    assert drone.given[NEAR] <= 2 * MAX_TRIES
    assert drone.given[FAR] >= LONGEST_REST - 2
    setattr(drone, how, set())
    drone.turns(2 * LONGEST_REST)
    assert NEAR not in drone.suspected
    drone.given.clear()
    drone.turns(20)
    assert drone.given[NEAR] + drone.given[FAR] >= 20


def test_who_takes_all_but_large_data_holds_none_of_them_up() -> None:
    """Its small data arrive, so it is not suspected."""
    drone = seasoned()
    drone.stall = {NEAR}
    id = some(drone.node.put(bytes(1000), drone.now))
    drone.turns(3 * MAX_TRIES)
    assert id not in drone.node.holdings.custody
    assert not drone.suspected


def test_who_refuses_now_and_then_is_not_suspected() -> None:
    """Its store was full for a moment, which its beacon did not say yet."""
    drone = seasoned()
    for _ in range(20):
        drone.refuse = {NEAR}
        drone.turns(MAX_TRIES - 1)
        drone.refuse = set()
        drone.turns(1)
    assert not drone.suspected


def test_forwarders_are_not_judged_by_statements_that_the_origin_denies() -> None:
    """Another node delivers data under numbers that this drone is about to assign, without keys: the base states that
    it has these too. No such statement is believed, so receipts cannot tell who delivers."""
    drone = seasoned()
    for _ in range(200):
        own = drone.node.store
        drone.stated[OWN, own.epoch].add(own.assigned + 1, own.assigned + 5)
        drone.turn()
    assert not drone.suspected
    assert drone.given[NEAR] >= 200
    assert not any(DatumId(OWN, own.epoch, number) in drone.node.receipts for number in range(60, own.assigned))


def test_data_reported_lost_count_as_not_delivered() -> None:
    drone = seasoned()
    drone.deliver = set()
    for _ in range(15):
        drone.dropped.clear()
        drone.turn()
        for id in drone.dropped:
            drone.serial += 1
            lost = ReceiptEntry(id.origin, id.epoch, id.sequence, 1, 0, True)
            drone.node.receive(make_receipt(1, 1, drone.serial, [lost]), drone.now)
    assert NEAR in drone.suspected


@pytest.mark.no_cover
def test_what_comes_back_is_not_judged() -> None:
    drone = seasoned()
    drone.deliver = set()
    for _ in range(200):
        drone.turn()
        again = tuple(CopyStatusEntry(id, CopyStatus.AGAIN) for id in drone.dropped)
        drone.dropped.clear()
        drone.node.receive(CopyStatuses(NEAR, OWN, again), drone.now)
    assert not drone.suspected


@pytest.mark.no_cover
def test_after_a_restart_nobody_is_suspected_and_the_same_is_learned_again() -> None:
    store = DurableStore(epoch=1000 + OWN)
    drone = Drone(store=store)
    drone.turns(30)
    drone.deliver = {FAR, FARTHER}
    drone.turns(100)
    assert drone.suspected == {NEAR}
    store.commit()
    drone.start(store)
    drone.turns(20)
    assert not drone.suspected
    drone.turns(4 * WAIT)
    assert drone.suspected == {NEAR}
    drone.turns(100)
    assert len(set(drone.node.holdings) - drone.arrived) <= 10


def test_a_suspected_neighbour_gets_no_replicas_if_another_can() -> None:
    drone = seasoned(capacity_items=500)
    drone.deliver = {FAR, FARTHER}
    drone.turns(200)
    assert drone.suspected == {NEAR}
    drone.ways = dict.fromkeys(drone.ways, NO_ROUTE)
    drone.turns(20, creates=0)
    drone.node.put(b"alone", drone.now)
    out = drone.node.step(drone.now + 1.0)
    assert {data.target for data in of(Data, out) if data.replica} <= {FAR, FARTHER}


class World:
    """Neighbours as `Journal.step` sees them: those of a node that hears no beacons but these."""

    def __init__(self) -> None:
        self.node = make_node(OWN)
        self.journal = Journal(self.node.receipts, judges=True)
        self.now = 0.0

    def step(self, hops: dict[int, int]) -> None:
        self.now += 1.0
        for id, h in hops.items():
            way = Route(1, 1, int(self.now), h) if h != NO_ROUTE else None
            self.node.receive(beacon(id, int(self.now), way, policy=self.node.policy.tag), self.now)
        self.node.routing.update(self.now)
        self.journal.step(self.node.routing)


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 1 << 32))
def test_whatever_happens_the_tables_agree_and_are_bounded(seed: int) -> None:
    rng, world = random.Random(seed), World()
    journal, receipts = world.journal, world.node.receipts
    ids = [DatumId(origin, 1, sequence) for origin in range(5) for sequence in range(60)]
    serial = 0
    for _ in range(300):
        kind = rng.random()
        id = rng.choice(ids)
        if kind < 0.5:
            journal.gave(id, rng.choice([None, 1, 2]), rng.randrange(3, 3 + rng.choice([4, 100])))
        elif kind < 0.6:
            journal.came_back(id)
        elif kind < 0.7:
            serial += 1
            entry = ReceiptEntry(id.origin, 1, id.sequence, rng.randint(1, 20), 0, rng.random() < 0.3)
            journal.apply(receipts.learn(make_receipt(1, 1, serial, [entry])))
        else:
            for _ in range(rng.choice([1, 5, 40])):
                world.step({n: rng.choice([1, 2, 9, NO_ROUTE]) for n in range(3, 10) if rng.random() < 0.8})
        assert journal.disagreement() == ""
        for neighbour in world.node.routing.neighbours.values():
            assert 1.0 <= neighbour.odds <= 1.0 / LEAST
            assert journal.allowance(neighbour.id) in (None, 0, 1)


def test_the_memory_is_shared_fairly_and_a_flood_of_names_pushes_out_no_doubt() -> None:
    world = World()
    journal, receipts = world.journal, world.node.receipts
    world.step({7: 1})
    for sequence in range(10):
        journal.gave(DatumId(1, 1, sequence), None, 7)
    for sequence in range(2 * MAX_ENTRIES):
        journal.gave(DatumId(2, 1, sequence), None, 8)
    for serial in range(3 * WAIT):
        entry = ReceiptEntry(OTHERS, 1, 2 * serial, 1, 0, False)
        journal.apply(receipts.learn(make_receipt(1, 1, serial, [entry])))
        world.step({7: 1})
    assert world.node.routing.neighbours[7].suspected, "what it took has been forgotten"
    for name in range(1000, 1000 + 2 * MAX_FORWARDERS):
        journal.gave(DatumId(3, 1, name), None, name)
    world.step({7: 1})
    assert world.node.routing.neighbours[7].suspected
    assert journal.disagreement() == ""


# -- routes ------------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 1 << 32))
@example(392)
def test_whoever_is_suspected_there_is_never_a_cycle_and_all_have_a_route_in_the_end(seed: int) -> None:
    """Next hops are checked at every step of every node."""
    swarm, rng = rough_times(seed), random.Random(seed)
    for turn in range(60):
        for node in swarm.nodes.values():
            for neighbour in node.routing.neighbours.values():
                if turn < 30 and rng.random() < 0.1:
                    neighbour.suspected, neighbour.odds = rng.choice(
                        [(False, 1.0), (False, 1.7), (True, 3.0), (True, 64.0)]
                    )
        swarm.turn()
    swarm.check()
    if swarm.seq_period:
        assert set(swarm.hops()) == set(swarm.distances())


@pytest.mark.no_cover
def test_who_comes_back_under_a_new_name_gets_one_datum() -> None:
    drone = seasoned()
    drone.ways = {FAR: 2}
    drone.turns(10)
    for name in range(100, 120):
        drone.given.clear()
        drone.ways = {FAR: 2, name: 1}
        drone.turns(20)
        if name >= 105:
            assert drone.given[name] <= 1
    # A new one that delivers is used as before.
    drone.deliver.add(200)
    drone.ways = {FAR: 2, 200: 1}
    drone.turns(50)
    assert 200 not in drone.suspected


# -- nothing rests because of a doubt ----------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_a_suspected_neighbour_is_given_first_what_can_prove_that_it_delivers() -> None:
    """No base confirms once more what has arrived, or is said to."""
    drone = seasoned(mirror=False)
    drone.ways = {NEAR: 1}
    drone.deliver = set()
    while not drone.suspected:
        drone.turn()
    drone.confirm([drone.node.put(b"said to have arrived", drone.now) for _ in range(300)])
    drone.deliver = {NEAR}
    drone.turns(1, creates=20)
    drone.turns(10 * WAIT, creates=0)
    assert not drone.suspected


@pytest.mark.no_cover
def test_however_slow_data_are_the_only_way_is_tried_again_soon() -> None:
    drone = Drone(mirror=False, capacity_items=5000)
    drone.ways = {NEAR: 1}
    drone.delay = 300
    drone.turns(700)
    drone.deliver = set()
    while not drone.suspected:
        drone.turn(creates=int(drone.now) % 4 == 0)
    given = []
    # Several of the longest rests.
    turns = 5 * LONGEST_REST
    for turn in range(turns):
        before = drone.given[NEAR]
        drone.turn(creates=turn % 20 == 0)
        if drone.given[NEAR] > before:
            given.append(turn)
    assert max(b - a for a, b in pairwise([0, *given, turns])) <= LONGEST_REST + 1


def test_who_may_count_on_this_node_makes_it_no_farther_than_its_suspected_neighbour() -> None:
    """By hops, data would rest at one that seems to be nearer, and has no other way than this node."""
    node = make_node(OWN, policy="hop-count", newborn=True)
    tag = node.policy.tag
    for t in range(1, 4):
        node.receive(beacon(NEAR, t, Route(1, 1, 1, 1), policy=tag, potential=1 << 24), float(t))
        node.receive(beacon(FAR, t, Route(1, 1, 1, 3), policy=tag, potential=(1 << 24) // 3), float(t))
        node.step(float(t))
        node.routing.neighbours[NEAR].suspected = True
    assert node.potential > (1 << 24) // 3
