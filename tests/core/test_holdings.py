from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.custody.holdings import CHANGES, Holding, Holdings, Partner, Pending, ReplicaOffer, State
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import Fate
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.core.settings import Capacity
from rass_mav.errors import StoreFullError

from .books import check
from .build import datum, node_settings
from .durable import DurableStore

UNBOUNDED = Capacity()


def holdings_of(store: DurableStore, capacity: Capacity = UNBOUNDED, *, load: bool = True) -> Holdings:
    return Holdings(store, node_settings(1), capacity, Exchange(0), load=load)


def test_the_order_is_least_recently_used_first() -> None:
    holdings = holdings_of(DurableStore(1))
    a, b, c = (datum(sequence=s) for s in range(3))
    for d in (a, b, c, b):
        holdings.add(d)
    assert list(holdings.custody) == list(holdings) == [a.id, c.id, b.id]


def test_a_restart_finds_the_data_in_their_order() -> None:
    store = DurableStore(1)
    holdings = holdings_of(store)
    for s in (2, 0, 1):
        holdings.add(datum(sequence=s, payload=b"x" * (s + 1)))
    store.commit()
    again = holdings_of(store.crashed())
    assert list(again) == list(holdings)
    assert again.custody_bytes == 6
    assert len(holdings_of(store, load=False)) == 0


def test_capacity_by_items() -> None:
    holdings = holdings_of(DurableStore(1), Capacity(items=2))
    assert holdings.free() == 2
    holdings.add(datum(sequence=0))
    assert holdings.room_for(1 << 20, own=False)
    holdings.add(datum(sequence=1))
    assert holdings.free() == 0
    assert not holdings.room_for(1, own=False)


def test_capacity_by_bytes() -> None:
    holdings = holdings_of(DurableStore(1), Capacity(bytes=10))
    first = holdings.add(datum(payload=b"123456"))
    assert holdings.room_for(4, own=False)
    assert not holdings.room_for(5, own=False)
    assert holdings.free() == 0xFFFF
    holdings.add(datum(sequence=1, payload=b"1234"))
    assert holdings.free() == 0
    holdings.remove(first, Fate.PASSED_ON)
    assert holdings.custody_bytes == 4


def test_free_items_fit_the_wire() -> None:
    assert holdings_of(DurableStore(1)).free() == 0xFFFF
    assert holdings_of(DurableStore(1), Capacity(items=1 << 20)).free() == 0xFFFE


def test_over_the_stores_quota_nothing_changes() -> None:
    holdings = holdings_of(DurableStore(1, quota_bytes=10))
    holdings.add(datum(payload=b"12345678"))
    with pytest.raises(StoreFullError):
        holdings.add(datum(sequence=1, payload=b"123"))
    assert list(holdings) == [datum().id]
    assert holdings.custody_bytes == 8
    check(holdings)


def test_replicas_lie_in_the_room_that_custody_leaves() -> None:
    holdings = holdings_of(DurableStore(1), Capacity(items=3, bytes=30))
    a, b, c, d = (datum(sequence=s) for s in range(4))
    first = holdings.add(a)
    holdings.add(b)
    holdings.change(first, State.REPLICA)
    third = holdings.add(c, State.REPLICA)
    assert (len(holdings.custody), len(holdings)) == (1, 3)
    assert (holdings.custody_bytes, holdings.replica_bytes) == (7, 14)
    assert (holdings.free(), holdings.room_for(23, own=False)) == (2, True)
    assert list(holdings.custody) == [b.id]
    assert list(holdings) == [b.id, a.id, c.id]
    # Three places are taken, so a replica has to go before another datum comes.
    assert holdings.crowded(1)
    assert holdings.yielding(distant=True, near=True) is first
    assert holdings.yielding(distant=True, near=False) is None
    holdings.pair(first, Partner(2, None, 0.0, 1.0), 0.0)
    first.custodian = 2
    holdings.pair(third, Partner(3, None, 0.0, 1.0), 0.0)
    third.custodian = 2
    # The third is kept for another replica: of its datum there are three copies.
    assert holdings.yielding(distant=True, near=False) is holdings.yielding(distant=True, near=True) is third
    assert holdings.yielding(distant=False, near=False) is None
    assert holdings.yielding(distant=False, near=True) is first
    holdings.unpair(first)
    holdings.unpair(third)
    holdings.change(first, State.PASSED_ON)
    assert holdings.yielding(distant=False, near=False) is holdings.yielding(distant=True, near=True) is first
    holdings.change(first, State.REPLICA)
    holdings.remove(third, Fate.PASSED_ON)
    assert not holdings.crowded(16)
    assert holdings.crowded(17)
    holdings.change(first, State.CUSTODY)
    assert list(holdings.custody) == [b.id, a.id]
    assert d.id not in holdings


def test_replicas_yield_for_the_stores_quota() -> None:
    holdings = holdings_of(DurableStore(1, quota_bytes=14))
    holdings.add(datum(), State.REPLICA)
    assert not holdings.crowded(7)
    assert holdings.crowded(8)


def test_after_a_restart_all_is_custody() -> None:
    store = DurableStore(1)
    holdings = holdings_of(store)
    holdings.change(holdings.add(datum()), State.REPLICA)
    holdings.add(datum(sequence=1), State.REPLICA)
    store.commit()
    again = holdings_of(store.crashed())
    assert len(again.custody) == len(again) == 2


def test_an_answer_counts_only_with_number_and_neighbour() -> None:
    holdings = holdings_of(DurableStore(1))
    holding = holdings.add(datum())
    exchange = holdings.exchange
    holdings.give(holding, first := Pending(5, holding.id, 2, 0.0))
    assert exchange.answered(5, 2) is first
    assert exchange.answered(5, 3) is None
    assert exchange.answered(6, 2) is None
    holdings.give(holding, second := Pending(6, holding.id, 3, 1.0))
    assert exchange.answered(5, 2) is None, "another hand-over took its place"
    assert exchange.answered(6, 3) is second
    holdings.cancel(holding)
    holdings.cancel(holding)
    assert exchange.answered(6, 3) is None


def test_a_datum_too_large_for_one_frame_is_never_handed_over_whole() -> None:
    holdings = holdings_of(DurableStore(1))
    holding = holdings.add(datum(payload=bytes(98)))
    with pytest.raises(AssertionError):
        holdings.give(holding, Pending(5, holding.id, 2, 0.0))


def test_what_is_not_in_the_table_of_changes_is_our_bug() -> None:
    holdings = holdings_of(DurableStore(1))
    holding = holdings.add(datum())
    with pytest.raises(AssertionError):
        holdings.change(holding, State.CUSTODY)


def test_a_scrub_goes_round() -> None:
    store = DurableStore(1)
    holdings = holdings_of(store)
    ids = [holdings.add(datum(sequence=s)).id for s in range(5)]
    store.flip_bit(ids[3])
    looks = [[h.id for h in holdings.damaged(2)] for _ in range(6)]
    assert looks == [[], [ids[3]], [], [], [ids[3]], []]
    assert [h.id for h in holdings.damaged(None)] == [ids[3]]


OPERATIONS = [
    "add", "spare", "remove", "change", "pair", "unpair", "ask", "give", "large", "cancel", "offer", "withdraw",
]  # fmt: skip


@given(st.lists(st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 5), st.integers(1, 9), st.integers(0, 2))))
def test_the_indexes_follow_from_the_records_whatever_happens(operations: list[tuple[str, int, int, int]]) -> None:
    store = DurableStore(1)
    holdings = holdings_of(store)
    for number, (operation, sequence, size, other) in enumerate(operations):
        d = datum(sequence=sequence, payload=bytes(INLINE_BYTES - 5 + size))
        holding = holdings.get(d.id)
        if holding is None:
            if operation in ("add", "spare"):
                holdings.add(d, State.CUSTODY if operation == "add" else State.REPLICA)
        elif operation == "add":
            if holding.state is State.CUSTODY:
                holdings.add(d)
        elif operation == "remove":
            holdings.remove(holding, Fate.PASSED_ON)
        elif operation == "change":
            to = list(State)[other]
            if (holding.state, to) in CHANGES:
                holdings.change(holding, to)
        elif operation == "pair":
            if holding.state is not State.PASSED_ON:
                holdings.pair(holding, holdings.partners.get(other) or Partner(other, None, 0.0, 1.0), float(number))
        elif operation == "unpair":
            holdings.unpair(holding)
        elif operation == "ask":
            if holding.state is State.REPLICA and holding.partner is not None:
                holdings.ask(holding, float(number))
        elif operation != "spare" and holding.state is State.CUSTODY:
            of_custody(holdings, holding, operation, number, other)
        check(holdings)
        assert sorted(holdings) == sorted(store.ids())


def of_custody(holdings: Holdings, holding: Holding, operation: str, number: int, other: int) -> None:
    if operation == "give":
        if holding.size <= INLINE_BYTES:
            holdings.give(holding, Pending(number, holding.id, other, 0.0))
    elif operation == "large":
        holdings.give(holding, Pending(number, holding.id, other, 0.0, Sending(datum(), other, number, 10)))
    elif operation == "cancel":
        holdings.cancel(holding)
    elif operation == "offer":
        holdings.offer(holding, ReplicaOffer(number, holding.id, other, 0.0))
    else:
        holdings.withdraw(holding)
