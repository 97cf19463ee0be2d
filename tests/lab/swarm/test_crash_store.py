"""A restart of a `CrashStore` finds what a durable store with the same history would have had on its disk."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.store import Store
from rass_mav.errors import StoreFullError
from rass_mav.lab.swarm.crash_store import CrashStore
from rass_mav.store.quota import ROW_OVERHEAD
from rass_mav.store.sqlite import MAX_WAITING_REMOVALS, SqliteStore
from tests.extent import examples

EPOCH = 77


def datum(sequence: int) -> Datum:
    return make_datum(DatumId(1, EPOCH, sequence), 0, 0.0, b"datum %03d" % sequence)


def state(store: Store) -> dict[str, Any]:
    return {
        "data": {id: store.get(id) for id in store.ids()},
        "losses": dict(store.losses()),
        "announcement": store.get_meta("announcement"),
    }


CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.integers(0, 4)),
        st.tuples(st.just("remove"), st.integers(0, 4), st.sampled_from(Fate)),
        st.tuples(st.just("lose"), st.integers(0, 4), st.sampled_from([Fate.CORRUPTED, Fate.EXPIRED])),
        st.tuples(st.just("found"), st.integers(0, 4)),
        st.tuples(st.just("set_meta"), st.integers(0, 9)),
    ),
    max_size=8,
)


def change(store: Store, what: tuple[Any, ...]) -> None:
    name, argument, *fate = what
    if name == "put":
        store.put(datum(argument))
    elif name == "set_meta":
        store.set_meta("announcement", argument)
    else:
        getattr(store, name)(datum(argument).id, *fate)


@settings(max_examples=examples(25))
@example([("lose", 0, Fate.EXPIRED), ("found", 0), ("found", 0)], [])
@given(CHANGES, CHANGES)
def test_it_forgets_what_the_store_on_disk_forgets(first: list[tuple[Any, ...]], second: list[tuple[Any, ...]]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "node.db"
        memory = CrashStore(EPOCH)
        for life in (first, second):
            sqlite = SqliteStore.open(path, node_id=7, draw_epoch=lambda: EPOCH)
            try:
                for what in life:
                    for store in (memory, sqlite):
                        change(store, what)
                    # A driver commits after each turn.
                    batch = sqlite.take()
                    if batch is not None:
                        sqlite.write(batch)
                assert state(memory) == state(sqlite)
            finally:
                sqlite.abandon()
            memory.restart()
            found = SqliteStore.open(path, node_id=7, draw_epoch=lambda: EPOCH)
            try:
                assert state(memory) == state(found)
            finally:
                found.close()


def test_a_removal_waits_for_the_next_datum() -> None:
    store = CrashStore(EPOCH)
    store.put(datum(1))
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert list(store.ids()) == []
    store.restart()
    assert list(store.ids()) == [datum(1).id]
    store.remove(datum(1).id, Fate.PASSED_ON)
    store.put(datum(2))
    store.restart()
    assert list(store.ids()) == [datum(2).id]


def test_many_removals_are_written_without_company() -> None:
    store = CrashStore(EPOCH)
    for sequence in range(MAX_WAITING_REMOVALS + 1):
        store.put(datum(sequence))
    for sequence in range(MAX_WAITING_REMOVALS + 1):
        store.remove(datum(sequence).id, Fate.PASSED_ON)
    store.restart()
    assert list(store.ids()) == [datum(MAX_WAITING_REMOVALS).id]


def test_what_comes_back_counts_for_the_quota() -> None:
    store = CrashStore(EPOCH, quota_bytes=2 * (9 + ROW_OVERHEAD))
    store.put(datum(1))
    store.put(datum(2))
    store.remove(datum(1).id, Fate.PASSED_ON)
    store.remove(datum(2).id, Fate.PASSED_ON)
    store.restart()
    with pytest.raises(StoreFullError):
        store.put(datum(3))
