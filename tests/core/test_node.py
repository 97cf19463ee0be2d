from __future__ import annotations

import pytest

from rass_mav.core.custody.flow import Flow
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BEACON_BASE, UNBOUNDED_FREE, Accept, Beacon, Committed, Data, Route
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.policy import POTENTIAL_BASE, POTENTIAL_ONE
from rass_mav.errors import DatumError, StoreFullError

from .build import beacon, data, datum, make_node, of, statement, talk
from .durable import DurableStore

ROUTE = Route(0, 9, 1, 0)


class Book(Observer):
    """Keeps what a node tells."""

    def __init__(self) -> None:
        self.fates: list[tuple[DatumId, Fate]] = []
        self.overflows = 0

    def dropped(self, id: DatumId, fate: Fate) -> None:
        self.fates.append((id, fate))

    def overflow(self) -> None:
        self.overflows += 1


def with_base(node: Node, now: float = 0.0, number: int = 0) -> Node:
    """The node hears a base, node 0, of its own policy."""
    node.receive(
        beacon(0, number, ROUTE, flags=BEACON_BASE, free=UNBOUNDED_FREE, policy=node.policy.tag,
               potential=POTENTIAL_BASE), now,
    )  # fmt: skip
    return node


def fitter(node: Node, sender: int = 2, number: int = 0, *, free: int = 50, now: float = 0.0) -> Node:
    """The node hears a neighbour that is fitter than any drone without a route."""
    node.receive(beacon(sender, number, free=free, policy=node.policy.tag, potential=POTENTIAL_ONE), now)
    return node


# -- Alg. 1 and Eq. 3, 4 -----------------------------------------------------------------------------------------------


def test_a_step_updates_route_then_fitness_then_evicts() -> None:
    node = make_node(1, risk=0.2)
    id = node.put(b"x", 0.0)
    with_base(node)
    out = node.step(1.0)
    assert [type(m) for m in out] == [Beacon, Data]
    said = out[0]
    assert isinstance(said, Beacon)
    assert (said.base, said.hops) == (0, 1)
    # Eq. 3 with alpha 1, beta 10: 1 / (1 * 1 + 10 * 0.2).
    assert said.potential == round(POTENTIAL_ONE / 3.0)
    assert said.risk == round(0.2 * 65535)
    assert said.free == 49
    [sent] = of(Data, out)
    assert (sent.target, sent.handovers[0].datum.id) == (0, id)


def test_without_neighbours_nothing_is_evicted() -> None:
    node = make_node(1, risk=1.0)
    node.put(b"x", 0.0)
    assert [type(m) for m in node.step(1.0)] == [Beacon]


def test_equal_neighbours_do_not_exchange_data() -> None:
    # Fitness 1/3 is no binary fraction: what is compared must be rounded alike on both sides.
    nodes = {i: make_node(i, risk=0.2) for i in (1, 2)}
    for i, node in nodes.items():
        node.receive(beacon(0, 0, ROUTE, potential=0, policy=node.policy.tag), 0.0)
        node.put(b"x", 0.0)
        assert i == node.id
    for turn in range(3):
        beacons = [node.step(float(turn)) for node in nodes.values()]
        assert [len(out) for out in beacons] == [1, 1]
        for out in beacons:
            talk(nodes, out, float(turn))


def test_the_bandwidth_bounds_what_is_sent_retransmissions_included() -> None:
    node = fitter(make_node(1, bandwidth_items=3))
    for _ in range(8):
        node.put(b"x", 0.0)
    first = of(Data, node.step(1.0))
    assert sum(len(d.handovers) for d in first) == 3
    fitter(node, number=1, now=1.0)
    second = of(Data, node.step(2.0))
    assert sum(len(d.handovers) for d in second) == 3
    assert len(node.holdings.pending) == 6
    fitter(node, number=2, now=2.0)
    again = of(Data, node.step(3.0))
    assert [h.number for d in again for h in d.handovers] == [h.number for d in first for h in d.handovers]
    assert len(node.holdings.pending) == 6


def test_the_oldest_data_go_first_and_no_more_than_the_neighbour_has_room_for() -> None:
    node = fitter(make_node(1), free=2)
    ids = [node.put(b"x", 0.0) for _ in range(5)]
    [sent] = of(Data, node.step(1.0))
    assert [h.datum.id for h in sent.handovers] == ids[:2]


def test_data_that_nobody_takes_do_not_keep_back_the_others() -> None:
    """As data under numbers that their origin, which is the only way, has not assigned."""
    node = with_base(make_node(1, bandwidth_items=2))
    refused = {node.put(b"x", 0.0) for _ in range(4)}
    taken = node.put(b"y", 0.0)
    sent: list[DatumId] = []
    for t in range(1, 6):
        with_base(node, float(t), t)
        for message in of(Data, node.step(float(t))):
            sent += [h.datum.id for h in message.handovers]
            wrong = tuple(h.number for h in message.handovers if h.datum.id in refused)
            good = tuple((h.number, h.datum.crc) for h in message.handovers if h.datum.id == taken)
            node.receive(Committed(0, 1, good, wrong), float(t))
    assert taken in sent
    assert set(node.holdings.custody) == refused
    assert all(sent.count(id) >= 2 for id in refused), "they are offered again"


# -- custody -----------------------------------------------------------------------------------------------------------


# -- care of what is held ----------------------------------------------------------------------------------------------


def test_a_scrub_of_a_few_items_goes_round() -> None:
    node = make_node(1, scrub_items=2)
    ids = [node.put(b"x", 0.0) for _ in range(5)]
    for id in ids:
        node.store.flip_bit(id)  # type: ignore[attr-defined]
    left = []
    for turn in range(6):
        node.step(float(turn))
        left.append(len(node.holdings.custody))
    assert left[0] == 3
    assert left[-1] == 0


@pytest.mark.parametrize("size", [20, 300])
@pytest.mark.parametrize("mirror", [False, True])
def test_a_copy_that_somebody_made_out_to_be_old_does_not_end_the_datum(size: int, mirror: bool) -> None:
    node = make_node(2, lifetime_s=100.0, mirror=mirror)
    d = datum(payload=b"x" * size, created=1000.0)
    node.receive(beacon(9), 1000.0)
    made_old = Sending(d._replace(created=901.0), 2, 5, 123)
    if size > 97:
        [accept] = node.receive(made_old.offer(9, 1000.0), 1000.0)
        assert isinstance(accept, Accept)
        assert made_old.open(accept.handle, 0, 1000.0)
        for position in made_old.due(fresh=True):
            node.receive(made_old.chunk(position, Flow(1000.0), 1000.0), 1000.0)
        answers = node.receive(Sending(d, 2, 6, 123).offer(3, 1000.5), 1000.5)
    else:
        node.receive(data(9, 2, (5, made_old.datum)), 1000.0)
        answers = node.receive(data(3, 2, (6, d)), 1000.5)
    assert Committed(2, 3, ((6, d.crc),), ()) in answers
    node.step(1050.0)
    assert list(node.holdings.custody) == [d.id]
    # Nor does it live any longer than it should.
    node.receive(data(9, 2, (7, d._replace(created=950.0))), 1060.0)
    node.step(1100.5)
    assert not node.holdings.custody


def test_a_full_node_counts_its_own_measurement_as_overflow_and_gives_no_number_away() -> None:
    book = Book()
    node = make_node(1, capacity_items=1, observer=book)
    node.put(b"x", 0.0)
    with pytest.raises(StoreFullError):
        node.put(b"y", 0.0)
    assert book.overflows == node.store.counters()["overflow"] == 1
    node.custody_store.drop(next(iter(node.holdings.custody.values())), Fate.PASSED_ON)
    assert node.put(b"z", 0.0).sequence == 1


@pytest.mark.parametrize("payload", [b"", bytes((1 << 20) + 1)])
def test_impossible_data_are_refused(payload: bytes) -> None:
    with pytest.raises(DatumError):
        make_node(1).put(payload, 0.0)


def test_a_store_over_quota_refuses_and_says_so_in_its_beacon() -> None:
    node = make_node(1, store=DurableStore(1, quota_bytes=100))
    node.put(bytes(97), 0.0)
    [said] = node.step(0.0)
    assert isinstance(said, Beacon)
    assert (said.free, said.potential) == (0, 0)
    [answer] = node.receive(data(7, 1, (5, datum())), 0.0)
    assert answer == Committed(1, 7, (), (5,))


# -- bases -------------------------------------------------------------------------------------------------------------


def test_a_base_keeps_everything_once_and_says_so() -> None:
    base, d = make_node(0, base=True, capacity_items=1, receipt_steps=1), datum()
    for number in (5, 6):
        [answer] = base.receive(data(7, 0, (number, d), (number + 10, datum(sequence=1))), 0.0)
        assert len(answer.committed) == 2  # type: ignore[union-attr]
    assert set(base.store.ids()) == {d.id, datum(sequence=1).id}
    said, receipt = base.step(1.0)
    assert isinstance(said, Beacon)
    assert (said.hops, said.potential, said.free, said.flags) == (0, POTENTIAL_BASE, UNBOUNDED_FREE, BEACON_BASE)
    assert receipt == statement(d.id, datum(sequence=1).id, life=base.store.life)
    assert len(base.step(2.0)) == 1


def test_echoes_and_rivals_are_told_apart() -> None:
    node = make_node(1)
    [own] = node.step(0.0)
    node.receive(own, 0.0)
    node.receive(beacon(1, life=4242), 3.0)
    assert node.alarms.echoes == 1
    assert node.alarms.rivals == {4242: 3.0}
    assert node.routing.neighbours == {}
    for epoch in range(100):
        node.receive(beacon(1, life=epoch), 4.0)
    assert len(node.alarms.rivals) <= 16


class Failing(DurableStore):
    """A store on a disk that has begun to fail."""

    @property
    def accepting(self) -> bool:
        return False


def test_with_a_failing_disk_custody_is_refused_and_own_data_are_kept() -> None:
    node = make_node(2, store=Failing(epoch=5))
    [beacon_, *_] = node.step(0.0)
    assert isinstance(beacon_, Beacon)
    assert beacon_.free == 0
    [answer] = node.receive(data(3, 2, (7, datum())), 0.0)
    assert isinstance(answer, Committed)
    assert (answer.committed, answer.refused) == ((), (7,))
    assert node.put(b"measured", 0.0) in node.holdings.custody
