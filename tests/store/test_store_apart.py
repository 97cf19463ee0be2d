"""A second content under one id: kept beside the first, bounded, and told from it by its checksum."""

from __future__ import annotations

from pathlib import Path

import pytest

from rass_mav.app.payloads import parse_name
from rass_mav.core.datum import Datum, Fate, make_datum
from rass_mav.core.store import MAX_APART_OF_ONE, Store
from rass_mav.errors import DatumError
from rass_mav.store import memory, sqlite
from rass_mav.store.memory import MemoryStore
from rass_mav.store.quota import ROW_OVERHEAD
from rass_mav.store.reader import SqliteReader

from .store_helpers import EPOCH, commit, datum, open_store


def other(number: int, content: bytes = b"another") -> Datum:
    return make_datum(datum(number).id, 1, 2.5, content)._replace(hops=3, at_least=True)


@pytest.fixture(params=["memory", "sqlite"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return MemoryStore(EPOCH) if request.param == "memory" else open_store(tmp_path / "node.db")


@pytest.mark.parametrize("committed", [False, True])
def test_both_contents_are_there(store: Store, committed: bool) -> None:
    store.put(datum(1))
    assert store.keep_apart(other(1))
    # The same again is kept already; so is what is stored.
    assert store.keep_apart(other(1)._replace(hops=9))
    assert store.keep_apart(datum(1))
    if committed:
        commit(store)
    assert store.get(datum(1).id) == datum(1)
    (info,) = store.apart()
    assert (info.id, info.crc, info.size, info.hops, info.at_least) == (datum(1).id, other(1).crc, 7, 3, True)
    assert store.get_apart(info.id, info.crc) == other(1)
    assert store.get_apart(info.id, 5) is None
    assert [info.id for info in store.held()] == list(store.ids()) == [datum(1).id]
    store.remove(datum(1).id, Fate.DELIVERED)
    assert store.get_apart(info.id, info.crc) == other(1)
    assert store.used_bytes == 7 + ROW_OVERHEAD


def test_a_second_content_is_a_reason_to_commit_and_survives(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    store = open_store(path)
    store.put(datum(1))
    commit(store)
    assert store.keep_apart(other(1))
    assert store.unwritten
    assert commit(store, force=False)
    store.abandon()
    with open_store(path) as again:
        assert again.get_apart(datum(1).id, other(1).crc) == other(1)
        assert again.keep_apart(other(1))
        assert again.used_bytes == 50 + 7 + 2 * ROW_OVERHEAD
    with SqliteReader(path) as reader:
        assert reader.apart() == [other(1)]


def test_they_are_bounded(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    most = MAX_APART_OF_ONE + 40
    for module in (memory, sqlite):
        monkeypatch.setattr(module, "MAX_APART", most)
    for number in range(MAX_APART_OF_ONE):
        assert store.keep_apart(other(1, b"%d" % number))
    assert not store.keep_apart(other(1, b"one more"))
    for number in range(2, most - MAX_APART_OF_ONE + 2):
        assert store.keep_apart(other(number))
    assert not store.keep_apart(other(5000))
    assert store.keep_apart(other(2))
    assert len(list(store.apart())) == most


def test_the_quota_counts_them(tmp_path: Path) -> None:
    with open_store(tmp_path / "node.db", quota_bytes=2 * (50 + ROW_OVERHEAD)) as store:
        store.put(datum(1))
        assert store.keep_apart(other(1))
        assert not store.keep_apart(other(1, bytes(60)))
        assert not store.room_for(50)


def test_they_are_listed_with_their_checksum_and_found_by_it(store: Store) -> None:
    store.put(datum(1))
    store.keep_apart(other(1))
    (info,) = store.apart()
    assert info.crc == other(1).crc
    assert parse_name(f"7-fedc0001-1#{info.crc:08x}") == (datum(1).id, other(1).crc)
    assert parse_name("7-fedc0001-1") == (datum(1).id, None)
    with pytest.raises(DatumError):
        parse_name("7-fedc0001-1#12")
