from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import Fate
from rass_mav.core.errors import StoreFullError
from rass_mav.core.inventory import Inventory

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
    assert inventory.room_for(1 << 20)
    inventory.add(datum(sequence=1))
    assert inventory.free() == 0
    assert not inventory.room_for(1)


def test_capacity_by_bytes() -> None:
    inventory = Inventory(DurableStore(1), capacity_bytes=10)
    inventory.add(datum(payload=b"123456"))
    assert inventory.room_for(4)
    assert not inventory.room_for(5)
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


@given(st.lists(st.tuples(st.sampled_from(["add", "remove", "touch"]), st.integers(0, 5), st.integers(1, 9))))
def test_it_agrees_with_the_store_whatever_happens(operations: list[tuple[str, int, int]]) -> None:
    store = DurableStore(1)
    inventory = Inventory(store)
    for operation, sequence, size in operations:
        d = datum(sequence=sequence, payload=bytes(size))
        if operation == "add":
            inventory.add(d)
        elif d.id in inventory:
            if operation == "remove":
                inventory.remove(d.id, Fate.PASSED_ON)
            else:
                inventory.touch(d.id)
        assert set(inventory) == set(store.ids())
        assert inventory.bytes == sum(info.size for info in store.held())
        assert all(inventory.info(info.id) == info for info in store.held())
