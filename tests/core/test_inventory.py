from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.custody.holdings import Inventory
from rass_mav.core.datum import Fate
from rass_mav.errors import StoreFullError

from .build import datum
from .durable import DurableStore


def test_the_order_is_least_recently_used_first() -> None:
    inventory = Inventory(DurableStore(1))
    a, b, c = (datum(sequence=s) for s in range(3))
    for d in (a, b, c):
        inventory.add(d)
    assert list(inventory) == [a.id, b.id, c.id]
    inventory.touch(a.id)
    assert list(inventory) == [b.id, c.id, a.id]
    inventory.add(b)
    assert list(inventory) == [c.id, a.id, b.id]
    assert inventory.oldest(1, 5) == [a.id, b.id]


def test_a_restart_finds_the_data_in_their_order() -> None:
    store = DurableStore(1)
    inventory = Inventory(store)
    for s in (2, 0, 1):
        inventory.add(datum(sequence=s, payload=b"x" * (s + 1)))
    store.commit()
    again = Inventory(store.crashed())
    assert list(again) == list(inventory)
    assert again.bytes == 6
    assert len(Inventory(store, load=False)) == 0


def test_capacity_by_items() -> None:
    inventory = Inventory(DurableStore(1), capacity_items=2)
    assert inventory.free() == 2
    inventory.add(datum(sequence=0))
    assert inventory.room_for(1 << 20, own=False)
    inventory.add(datum(sequence=1))
    assert inventory.free() == 0
    assert not inventory.room_for(1, own=False)


def test_capacity_by_bytes() -> None:
    inventory = Inventory(DurableStore(1), capacity_bytes=10)
    inventory.add(datum(payload=b"123456"))
    assert inventory.room_for(4, own=False)
    assert not inventory.room_for(5, own=False)
    assert inventory.free() == 0xFFFF
    inventory.add(datum(sequence=1, payload=b"1234"))
    assert inventory.free() == 0
    inventory.remove(datum().id, Fate.PASSED_ON)
    assert inventory.bytes == 4


def test_free_items_fit_the_wire() -> None:
    assert Inventory(DurableStore(1)).free() == 0xFFFF
    assert Inventory(DurableStore(1), capacity_items=1 << 20).free() == 0xFFFE


def test_over_the_stores_quota_nothing_changes() -> None:
    inventory = Inventory(DurableStore(1, quota_bytes=10))
    inventory.add(datum(payload=b"12345678"))
    with pytest.raises(StoreFullError):
        inventory.add(datum(sequence=1, payload=b"123"))
    assert list(inventory) == [datum().id]
    assert inventory.bytes == 8


def test_spares_lie_in_the_room_that_custody_leaves() -> None:
    inventory = Inventory(DurableStore(1), capacity_items=3, capacity_bytes=30)
    a, b, c, d = (datum(sequence=s) for s in range(4))
    inventory.add(a)
    inventory.add(b)
    inventory.demote(a.id)
    inventory.add_spare(c)
    assert (len(inventory), inventory.spares) == (1, 2)
    assert (inventory.bytes, inventory.spare_bytes) == (7, 14)
    assert (inventory.free(), inventory.room_for(23, own=False)) == (2, True)
    assert list(inventory) == [b.id]
    assert list(inventory.everything()) == [b.id, a.id, c.id]
    # Three places are taken, so a spare has to go before another datum comes.
    assert inventory.crowded(1)
    assert inventory.yielding() == a.id
    assert inventory.yielding(active=False) is None
    inventory.pass_by(c.id)
    assert inventory.yielding() == inventory.yielding(active=False) == c.id
    inventory.remove(c.id, Fate.PASSED_ON)
    assert not inventory.crowded(16)
    assert inventory.crowded(17)
    inventory.promote(a.id)
    assert list(inventory) == [b.id, a.id]
    assert not inventory.holds(d.id)


def test_spares_yield_for_the_stores_quota() -> None:
    inventory = Inventory(DurableStore(1, quota_bytes=14))
    inventory.add_spare(datum())
    assert not inventory.crowded(7)
    assert inventory.crowded(8)


def test_after_a_restart_all_is_custody() -> None:
    store = DurableStore(1)
    inventory = Inventory(store)
    inventory.add(datum())
    inventory.demote(datum().id)
    inventory.add_spare(datum(sequence=1))
    store.commit()
    again = Inventory(store.crashed())
    assert (len(again), again.spares) == (2, 0)


OPERATIONS = ["add", "remove", "touch", "demote", "promote", "pass_by", "activate", "add_spare"]


@given(st.lists(st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 5), st.integers(1, 9))))
def test_it_agrees_with_the_store_whatever_happens(operations: list[tuple[str, int, int]]) -> None:
    store = DurableStore(1)
    inventory = Inventory(store)
    for operation, sequence, size in operations:
        d = datum(sequence=sequence, payload=bytes(size))
        spare = inventory.holds(d.id) and d.id not in inventory
        if operation == "add":
            if not spare:
                inventory.add(d)
        elif operation == "add_spare":
            if not inventory.holds(d.id):
                inventory.add_spare(d)
        elif operation == "remove":
            if inventory.holds(d.id):
                inventory.remove(d.id, Fate.PASSED_ON)
        elif operation in ("touch", "demote"):
            if d.id in inventory:
                getattr(inventory, operation)(d.id)
        elif spare and (operation == "promote" or inventory.is_active(d.id) == (operation == "pass_by")):
            getattr(inventory, operation)(d.id)
        sizes = {info.id: info.size for info in store.held()}
        assert sorted(inventory.everything()) == sorted(sizes)
        assert len(inventory) + inventory.spares == len(sizes)
        assert inventory.bytes == sum(sizes[id] for id in inventory)
        assert inventory.bytes + inventory.spare_bytes == sum(sizes.values())
        assert all(inventory.info(info.id) == info for info in store.held() if info.id in inventory)
        assert all(inventory.created(id) == 0.0 for id in sizes)
