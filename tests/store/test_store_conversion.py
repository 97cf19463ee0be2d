"""Stores of earlier versions are opened. One of the first version stays beside the new one, whole; one of the last
version goes on as it is.

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

`data/version-2.db` and its mark were made by the program as of commit 3b30022 with the same, except for

    epochs = iter((0xFEDC0001, 0xFEDC0002))  # the second is the life
    store = SqliteStore.open("v2.db", node_id=7, draw_epoch=lambda: next(epochs))
    ...
    put(store, 100, origin=9, epoch=0xABCD)
    store.keep_apart(make_datum(DatumId(9, 0xABCD, 100), 1, 2.5, bytes(5000)))
    ...
    store.close()
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from random import Random

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.errors import StoreError
from rass_mav.lab.disk import Disk
from rass_mav.store import drafts
from rass_mav.store.reader import SqliteReader
from rass_mav.store.report import OpenReport
from rass_mav.store.schema import LAST_VERSION, SCHEMA_VERSION
from rass_mav.store.sqlite import SqliteStore

from .store_helpers import EPOCH, commit, datum, open_store, payload

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
    assert store.assigned == 0
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


def test_a_store_of_the_first_version_is_converted(path: Path) -> None:
    before = path.read_bytes()
    with open_store(path) as store:
        assert not store.report.created
        assert store.report.converted == path.with_name("node.db.version-1")
        assert_converted(store)
        store.put(datum(store.next_sequence(), epoch=store.epoch))
    assert path.with_name("node.db.version-1").read_bytes() == before
    with open_store(path) as store:
        assert (store.report.reason, store.assigned, store.life) == ("", 1, EPOCH)
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
    with pytest.raises(StoreError, match="first version"):
        open_store(path)
    assert path.read_bytes() == before
    assert not [file for file in path.parent.iterdir() if "version-1" in file.name or "new" in file.name]
    monkeypatch.undo()
    with open_store(path) as store:
        assert_converted(store)


def test_a_damaged_store_of_the_first_version_is_salvaged(path: Path) -> None:
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


# -- the last version --------------------------------------------------------------------------------------------------

APART = make_datum(DatumId(9, 0xABCD, 100), 1, 2.5, bytes(5000))


def last_version(folder: Path) -> Path:
    for ending in ("", ".mark"):
        shutil.copy(Path(__file__).parent / "data" / f"version-2.db{ending}", folder / f"node.db{ending}")
    return folder / "node.db"


def version(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def content(store: SqliteStore | SqliteReader) -> list[Datum | None]:
    return [store.get(info.id) for info in store.held()]


EXPECTED = [
    *map(expected, (0, 2, 3, 4, 5)), expected(100, origin=9, epoch=0xABCD), expected(6),
]  # fmt: skip


def test_a_store_of_the_last_version_goes_on_as_it_is(tmp_path: Path) -> None:
    path = last_version(tmp_path)
    assert version(path) == LAST_VERSION
    with open_store(path) as store:
        assert store.report == OpenReport()
        assert (store.life, store.epoch, store.assigned) == (EPOCH + 1, EPOCH, 7)
        assert content(store) == EXPECTED
        assert store.get_apart(APART.id, APART.crc) == APART
        assert dict(store.losses()) == {DatumId(8, 5, 3): Fate.OVERFLOW, DatumId(7, EPOCH, 1): Fate.EXPIRED}
        assert (store.counters(), store.get_meta("announcement")) == ({"delivered": 5}, 4)
        store.mark_at_least()
        # What is replaced and what comes goes beside the database, the rest stays in its row.
        store.put(datum(4, 7000))
        store.put(datum(store.next_sequence(), 9000))
    assert version(path) == SCHEMA_VERSION
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert store.get(datum(4).id) == datum(4, 7000)
        assert store.get(datum(7).id) == datum(7, 9000)
        assert store.get(datum(0).id) == expected(0)._replace(at_least=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "node.db", "node.db.lock", "node.db.mark", "node.db.payloads",
    ]  # fmt: skip


def test_its_tables_are_those_of_a_new_store_afterwards(tmp_path: Path) -> None:
    path = last_version(tmp_path)
    for store in (path, tmp_path / "new.db"):
        open_store(store).close()

    def tables(path: Path) -> list[tuple[str, str]]:
        with closing(sqlite3.connect(path)) as connection:
            assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
            return connection.execute("SELECT name, sql FROM sqlite_master ORDER BY name").fetchall()

    assert tables(path) == tables(tmp_path / "new.db")


def test_it_is_read_unconverted_from_outside_and_where_nothing_can_be_written(tmp_path: Path) -> None:
    path = last_version(tmp_path)
    before = path.read_bytes()
    with SqliteReader(path) as reader:
        assert content(reader) == EXPECTED
        assert reader.apart() == [APART]
        assert [row is not None and row.head for row in reader.rows(3)] == [
            payload(number, 50)[:3] for number in (0, 2, 3, 4, 5, 100, 6)
        ]
    assert path.read_bytes() == before
    with Disk(Random(1)) as disk:
        inside = last_version(disk.directory)
        disk.read_only = True
        with open_store(inside, disk=disk) as store:
            assert store.report.unwritable
            assert content(store) == EXPECTED


def test_a_power_cut_at_any_change_of_its_conversion_leaves_one_of_the_two(tmp_path: Path) -> None:
    versions = []
    for after in range(40):
        with Disk(Random(after)) as disk:
            path = last_version(disk.directory)
            disk.cut(after=after)
            with suppress(StoreError):
                store = open_store(path, disk=disk)
                store.put(datum(store.next_sequence(), 9000))
                with suppress(StoreError):
                    commit(store)
                store.abandon()
            disk.restart()
            versions.append(version(path))
            with open_store(path, disk=disk) as store:
                assert store.report == OpenReport()
                assert content(store)[:7] == EXPECTED
    assert {LAST_VERSION, SCHEMA_VERSION} == set(versions)
