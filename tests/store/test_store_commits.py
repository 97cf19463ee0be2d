"""How changes become durable in the store on disk."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from rass_mav.core.datum import Fate
from rass_mav.errors import StoreError, StoreFullError
from rass_mav.store.quota import ROW_OVERHEAD
from rass_mav.store.reader import SqliteReader
from rass_mav.store.sqlite import MAX_BUFFERED_BYTES, MAX_WAITING_REMOVALS, SqliteStore
from tests.some import some

from .store_helpers import commit, datum, epochs, open_store


@pytest.fixture
def store(path: Path) -> Iterator[SqliteStore]:
    store = open_store(path, busy_timeout=0.0)
    yield store
    store.abandon()


def on_disk(path: Path) -> list[int]:
    with SqliteReader(path) as reader:
        return [id.sequence for id in reader.ids()]


def test_a_batch_is_written_on_another_thread_while_changes_go_on(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    store.put(datum(2))
    batch = store.take()
    thread = threading.Thread(target=store.write, args=(batch,))
    thread.start()
    store.put(datum(3))
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert [store.get(datum(number).id) for number in (1, 2, 3)] == [None, datum(2), datum(3)]
    thread.join()
    assert [store.get(datum(number).id) for number in (1, 2, 3)] == [None, datum(2), datum(3)]
    assert on_disk(path) == [1, 2]
    commit(store)
    assert on_disk(path) == [2, 3]


def test_after_the_write_data_are_read_from_the_disk(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    commit(store)
    with closing(sqlite3.connect(path)) as radiation:
        radiation.execute("UPDATE datum SET payload = zeroblob(size)")
        radiation.commit()
    damaged = some(store.get(datum(1).id))
    assert damaged.payload == bytes(50)
    assert not damaged.intact


@pytest.mark.parametrize("fate", [Fate.PASSED_ON, Fate.DELIVERED])
def test_removals_wait_for_a_datum(store: SqliteStore, path: Path, fate: Fate) -> None:
    store.put(datum(1))
    commit(store)
    store.remove(datum(1).id, fate)
    store.count(fate.value)
    assert store.take() is None
    assert on_disk(path) == [1]
    store.put(datum(2))
    commit(store, force=False)
    assert on_disk(path) == [2]


def test_removals_do_not_wait_when_forced(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    commit(store)
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert commit(store, force=True)
    assert on_disk(path) == []


def test_many_removals_do_not_wait(store: SqliteStore, path: Path) -> None:
    for number in range(MAX_WAITING_REMOVALS):
        store.put(datum(number))
    commit(store)
    for number in range(MAX_WAITING_REMOVALS):
        assert store.take() is None
        store.remove(datum(number).id, Fate.PASSED_ON)
    assert commit(store, force=False)
    assert on_disk(path) == []


@pytest.mark.parametrize("fate", [Fate.CORRUPTED, Fate.EXPIRED])
def test_a_loss_does_not_wait_because_others_are_told_of_it(store: SqliteStore, path: Path, fate: Fate) -> None:
    store.put(datum(1))
    commit(store)
    store.remove(datum(1).id, fate)
    assert commit(store, force=False)
    with SqliteReader(path) as reader:
        assert reader.losses() == [(datum(1).id, fate)]


def test_a_meta_number_does_not_wait(store: SqliteStore, path: Path) -> None:
    store.set_meta("announcement", 3)
    assert commit(store, force=False)
    with SqliteReader(path) as reader:
        assert reader.meta() == {"announcement": 3}


@pytest.mark.parametrize("key", ["store.epoch", "store.next_sequence"])
def test_the_stores_own_numbers_cannot_be_set(store: SqliteStore, key: str) -> None:
    with pytest.raises(ValueError, match="reserved"):
        store.set_meta(key, 0)
    assert store.get_meta(key) is None


def test_put_and_removed_between_two_commits_leaves_no_trace(store: SqliteStore) -> None:
    store.put(datum(1))
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert store.take(force=True) is None


def test_an_older_row_goes_although_its_replacement_never_came(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    commit(store)
    store.put(datum(1)._replace(hops=1))
    store.remove(datum(1).id, Fate.PASSED_ON)
    assert commit(store)
    assert on_disk(path) == []


def test_a_number_whose_datum_never_became_durable_is_claimed_again(path: Path) -> None:
    store = open_store(path)
    store.put(datum(store.next_sequence()))
    commit(store)
    store.put(datum(store.next_sequence()))
    store.abandon()
    with open_store(path) as store:
        assert [id.sequence for id in store.ids()] == [0]
        assert store.next_sequence() == 1


def test_a_number_whose_datum_was_sent_without_custody_is_not_claimed_again(path: Path) -> None:
    store = open_store(path)
    first = datum(store.next_sequence())
    store.put(first)
    store.remove(first.id, Fate.PASSED_ON)
    # The frame with the datum waits for this commit, for it is not on disk.
    assert store.unwritten
    assert not store.durable(first.id)
    commit(store)
    store.abandon()
    with open_store(path) as store:
        assert store.next_sequence() == 1


def test_life_and_epoch_are_drawn_once(path: Path) -> None:
    draw = epochs(5)
    for _ in range(3):
        with open_store(path, draw_epoch=draw) as store:
            assert (store.epoch, store.life) == (5, 6)
    assert draw() == 7


def test_close_writes_what_is_buffered(path: Path) -> None:
    with open_store(path) as store:
        store.put(datum(1))
        batch = store.take()
        store.put(datum(2))
        assert batch is not None
    assert on_disk(path) == [1, 2]


def test_a_failed_write_loses_nothing(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    store.put(datum(2))
    commit(store)
    store.remove(datum(1).id, Fate.PASSED_ON)
    store.put(datum(3))
    store.put(datum(4))
    store.count("delivered", 2)
    batch = store.take()
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match=r"node\.db: database is locked \(while writing\)"):
            store.write(batch)
        assert on_disk(path) == [1, 2]
        # What comes in meanwhile is applied after what could not be written.
        store.remove(datum(3).id, Fate.PASSED_ON)
        store.put(datum(2)._replace(hops=1))
        store.count("delivered")
        assert [info.id.sequence for info in store.held()] == [4, 2]
        assert store.get(datum(4).id) == datum(4)
        other.execute("ROLLBACK")
    assert commit(store, force=False)
    assert on_disk(path) == [4, 2]
    with SqliteReader(path) as reader:
        assert reader.counters() == {"delivered": 3}
        assert reader.get(datum(2).id) == datum(2)._replace(hops=1)


def test_a_failed_batch_may_be_written_again(store: SqliteStore, path: Path) -> None:
    store.put(datum(1))
    batch = store.take()
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError):
            store.write(batch)
    store.write(batch)
    assert on_disk(path) == [1]
    with pytest.raises(RuntimeError, match="written already"):
        store.write(batch)


def test_a_driver_that_takes_twice_is_told(store: SqliteStore) -> None:
    store.put(datum(1))
    batch = store.take()
    with pytest.raises(RuntimeError, match="not been written"):
        store.take()
    store.restore(batch)
    with pytest.raises(RuntimeError, match="not the batch"):
        store.write(batch)
    with pytest.raises(RuntimeError, match="not the batch"):
        store.restore(batch)
    assert commit(store)


def test_what_waits_for_a_commit_is_bounded(store: SqliteStore) -> None:
    size = 1 << 20
    waiting = MAX_BUFFERED_BYTES // (size + ROW_OVERHEAD)
    for number in range(waiting):
        store.put(datum(number, size))
    assert not store.room_for(size)
    with pytest.raises(StoreFullError, match="are waiting to be written"):
        store.put(datum(waiting, size))
    assert len(list(store.ids())) == waiting
    # A replaced and a removed datum give their bytes back.
    store.put(datum(0, 1))
    store.put(datum(waiting, size - 1000))
    store.remove(datum(1).id, Fate.PASSED_ON)
    store.put(datum(waiting + 1, size))
    batch = store.take()
    store.put(datum(waiting + 2, size))
    store.restore(batch)
    with pytest.raises(StoreFullError):
        store.put(datum(waiting + 3, size))
    commit(store)
    store.put(datum(waiting + 3, size))


def test_nothing_is_lost_when_closing_fails(path: Path) -> None:
    store = open_store(path, busy_timeout=0.0)
    store.put(datum(1))
    commit(store)
    store.put(datum(2))
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError):
            store.close()
    with open_store(path) as store:
        assert [id.sequence for id in store.ids()] == [1]
