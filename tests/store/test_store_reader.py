"""Looking into a store from outside."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rass_mav.core.datum import Fate
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.store.reader import SqliteReader

from .store_helpers import EPOCH, commit, datum, open_store


def test_the_reader_sees_one_moment_of_a_running_node(tmp_path: Path) -> None:
    path = tmp_path / "a node's 100% store?.db"
    with open_store(path) as store:
        store.put(datum(store.next_sequence()))
        store.count("delivered")
        store.lose(datum(9).id, Fate.OVERFLOW)
        store.set_meta("announcement", 4)
        commit(store)
        with SqliteReader(path) as reader:
            store.put(datum(store.next_sequence()))
            store.remove(datum(0).id, Fate.PASSED_ON)
            store.count("delivered")
            commit(store)
            assert reader.epoch == EPOCH
            assert reader.assigned == 1
            assert [info.id for info in reader.held()] == reader.ids() == [datum(0).id]
            assert reader.get(datum(0).id) == datum(0)
            assert reader.get(datum(1).id) is None
            assert reader.counters() == {"delivered": 1}
            assert reader.losses() == [(datum(9).id, Fate.OVERFLOW)]
            assert reader.meta() == {"announcement": 4}
        with SqliteReader(path) as reader:
            assert reader.ids() == [datum(1).id]
            assert reader.counters() == {"delivered": 2}


def test_the_reader_works_on_a_closed_store_and_leaves_it_usable(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    with open_store(path) as store:
        store.put(datum(0))
    before = path.read_bytes()
    with SqliteReader(path) as reader:
        assert reader.get(datum(0).id) == datum(0)
    assert path.read_bytes() == before
    assert not list(tmp_path.glob("*-*")), "what SQLite needs to read it is gone"
    with open_store(path) as store:
        assert store.get(datum(0).id) == datum(0)


def test_a_node_that_starts_while_the_reader_reads_keeps_its_log(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    with open_store(path) as store:
        store.put(datum(0))
    reader = SqliteReader(path)
    with open_store(path) as store:
        reader.close()
        store.put(datum(1))
        commit(store)
        with SqliteReader(path) as other:
            assert other.ids() == [datum(0).id, datum(1).id]
    with open_store(path) as store:
        assert store.get(datum(1).id) == datum(1)


def test_many_data_are_listed_in_the_order_of_arrival(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    order = [(number * 7919) % 2000 for number in range(2000)]
    with open_store(path) as store:
        for number in order:
            store.put(datum(number, 5))
    with SqliteReader(path) as reader:
        assert [info.id.sequence for info in reader.held()] == order


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"missing\.db"):
        SqliteReader(tmp_path / "missing.db")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(StoreError):
        SqliteReader(tmp_path)
    (tmp_path / "text.db").write_text("hello" * 1000)
    with pytest.raises(StoreDamagedError, match=r"text\.db: file is not a database"):
        SqliteReader(tmp_path / "text.db")
    with closing(sqlite3.connect(tmp_path / "other.db")) as other:
        other.execute("CREATE TABLE bookmark (url TEXT)")
    with pytest.raises(StoreDamagedError, match="another program's"):
        SqliteReader(tmp_path / "other.db")
