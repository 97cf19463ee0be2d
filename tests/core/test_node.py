from __future__ import annotations

import pytest

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import BEACON_BASE, UNBOUNDED_FREE, Beacon, Committed, Data, Route
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.policy import POTENTIAL_BASE, POTENTIAL_ONE
from rass_mav.errors import DatumError, StoreFullError

from .build import beacon, data, datum, make_node, of, statement
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
