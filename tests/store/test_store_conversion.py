"""A store of the last version is opened; the old one stays beside it, whole.

`data/version-1.db` was made by the program as of commit 5a6cdbb with

    def put(store, number, origin=7, epoch=0xFEDC0001):
        payload = hashlib.shake_128(number.to_bytes(8, "little")).digest(6000 if number % 4 == 0 else 50)
        store.put(make_datum(DatumId(origin, epoch, number), 1, 1.5 + number, payload))

    store = SqliteStore.open("v1.db", draw_epoch=lambda: 0xFEDC0001)
    for _ in range(6):
        put(store, store.next_sequence())
    put(store, 100, origin=9, epoch=0xABCD)
    store.lose(DatumId(8, 5, 3), Fate.OVERFLOW)
    store.count("delivered", 5)
    store.set_meta("announcement", 4)
    store.write(store.take(force=True))
    store.remove(DatumId(7, 0xFEDC0001, 1), Fate.EXPIRED)
    put(store, store.next_sequence())
    store.write(store.take(force=True))
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.errors import StoreError
from rass_mav.store import SqliteReader, SqliteStore, drafts

from .store_helpers import EPOCH, datum, open_store

NUMBERS = (0, 2, 3, 4, 5, 6)


def expected(number: int, **options: int) -> Datum:
    return datum(number, 6000 if number % 4 == 0 else 50, created=1.5 + number, **options)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    shutil.copy(Path(__file__).parent / "data" / "version-1.db", tmp_path / "node.db")
    return tmp_path / "node.db"


def assert_converted(store: SqliteStore) -> None:
    assert store.life == EPOCH
    assert store.epoch not in (EPOCH, store.life)
    assert store.given == 0
    assert {id: store.get(id) for id in store.ids()} == {
        datum.id: datum for datum in (*map(expected, NUMBERS), expected(100, origin=9, epoch=0xABCD))
    }
    assert [info.id.sequence for info in store.held()] == [0, 2, 3, 4, 5, 100, 6]
    assert dict(store.losses()) == {
        DatumId(8, 5, 3): Fate.OVERFLOW,
        DatumId(7, EPOCH, 1): Fate.EXPIRED,
        # Numbers up to 7 are known; the last version kept no mark, so there may be more.
        DatumId(7, EPOCH, 7): Fate.UNKNOWN,
    }
    assert store.counters() == {"delivered": 5}
    assert store.get_meta("announcement") == 4


def test_a_store_of_the_last_version_is_converted(path: Path) -> None:
    before = path.read_bytes()
    with open_store(path) as store:
        assert not store.report.created
        assert store.report.converted == path.with_name("node.db.version-1")
        assert_converted(store)
        store.put(datum(store.next_sequence(), epoch=store.epoch))
    assert path.with_name("node.db.version-1").read_bytes() == before
    with open_store(path) as store:
        assert (store.report.reason, store.given, store.life) == ("", 1, EPOCH)
    with SqliteReader(path) as reader:
        assert reader.life == EPOCH


def test_what_stands_in_its_log_is_converted_too(path: Path, tmp_path: Path) -> None:
    source = tmp_path / "source.db"
    path.rename(source)
    with closing(sqlite3.connect(source)) as running:
        running.execute("UPDATE counter SET value = 6, inverse = -7")
        running.commit()
        for ending in ("", "-wal"):
            shutil.copy(f"{source}{ending}", f"{path}{ending}")
    with open_store(path) as store:
        assert store.counters() == {"delivered": 6}
    assert path.with_name("node.db.version-1-wal").exists()


class Killed(BaseException):
    pass


def test_a_conversion_killed_at_any_point_leaves_the_old_or_the_new_store(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = path.read_bytes()
    rename, reached = Path.rename, 0

    for point in range(20):
        folder = tmp_path / str(point)
        folder.mkdir()
        copy = folder / "node.db"
        copy.write_bytes(original)
        left = point

        def dying(self: Path, target: Path) -> Path:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            return rename(self, target)

        with monkeypatch.context() as patched:
            patched.setattr(Path, "rename", dying)
            patched.setattr(drafts, "_discard", lambda draft: None)
            try:
                open_store(copy).close()
            except Killed:
                reached += 1
        with open_store(copy) as store:
            assert_converted(store)
        assert any(file.read_bytes() == original for file in folder.iterdir())
    assert 4 <= reached < 20


def test_without_room_for_the_new_one_it_is_refused_unchanged(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()

    def full(path: Path, mark: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(drafts, "make_mark", full)
    with pytest.raises(StoreError, match="previous version"):
        open_store(path)
    assert path.read_bytes() == before
    assert not [file for file in path.parent.iterdir() if "version-1" in file.name or "new" in file.name]
    monkeypatch.undo()
    with open_store(path) as store:
        assert_converted(store)


def test_a_damaged_store_of_the_last_version_is_salvaged(path: Path) -> None:
    content = bytearray(path.read_bytes())
    # The root of the index over the data, which no row needs.
    with closing(sqlite3.connect(path)) as connection:
        (root,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name LIKE 'sqlite_autoindex_datum%'"
        ).fetchone()
    content[(root - 1) * 4096 : root * 4096] = bytes(4096)
    path.write_bytes(content)
    with open_store(path) as store:
        assert store.report.set_aside is not None
        assert {id.sequence for id in store.ids()} >= {*NUMBERS, 100}
        assert store.get(expected(4).id) == expected(4)
        assert dict(store.losses())[DatumId(7, EPOCH, 7)] is Fate.UNKNOWN


def test_the_reader_says_that_a_store_is_not_converted_yet(path: Path) -> None:
    with pytest.raises(StoreError, match="not converted yet"):
        SqliteReader(path)
