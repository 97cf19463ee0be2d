"""A store of an earlier program is opened; one of an earlier or a later version is refused, and stays as it is.

`data/version-3.db` and the files beside it were made by the program as of commit 178de1b with

    def datum(number, origin=7, epoch=0xFEDC0001):
        payload = hashlib.shake_128(number.to_bytes(8, "little")).digest(6000 if number % 4 == 0 else 50)
        return make_datum(DatumId(origin, epoch, number), 1, 1.5 + number, payload)

    epochs = iter((0xFEDC0001, 0xFEDC0002))  # the second is the life
    store = SqliteStore.open("version-3.db", node_id=7, draw_epoch=lambda: next(epochs))
    for _ in range(6):
        store.put(datum(store.next_sequence()))
    store.put(datum(100, origin=9, epoch=0xABCD))
    store.keep_apart(make_datum(DatumId(9, 0xABCD, 100), 1, 2.5, bytes(5000)))
    store.lose(DatumId(8, 5, 3), Fate.OVERFLOW)
    store.count("delivered", 5)
    store.set_meta("announcement", 4)
    store.write(store.take(force=True))
    store.remove(DatumId(7, 0xFEDC0001, 1), Fate.EXPIRED)
    store.put(datum(store.next_sequence()))
    store.write(store.take(force=True))
    coming = datum(104, origin=9, epoch=0xABCD)
    store.keep_partial(key_of(coming), 0, coming.payload[:3000])
    store.write(store.take())
    store.close()
"""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.store import key_of
from rass_mav.errors import StoreError
from rass_mav.ground.archive import Archive
from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from rass_mav.store.schema import SCHEMA_VERSION
from rass_mav.store.sqlite import SqliteStore

from .store_helpers import EPOCH, datum, open_store

ENDINGS = ("", ".mark", ".partials", ".payloads")
APART = make_datum(DatumId(9, 0xABCD, 100), 1, 2.5, bytes(5000))


def expected(number: int, **options: int) -> Datum:
    return datum(number, 6000 if number % 4 == 0 else 50, created=1.5 + number, **options)


EXPECTED = [*map(expected, (0, 2, 3, 4, 5)), expected(100, origin=9, epoch=0xABCD), expected(6)]
COMING = expected(104, origin=9, epoch=0xABCD)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    for ending in ENDINGS:
        shutil.copy(Path(__file__).parent / "data" / f"version-3.db{ending}", tmp_path / f"node.db{ending}")
    return tmp_path / "node.db"


def content(store: SqliteStore | SqliteReader) -> list[Datum | None]:
    return [store.get(info.id) for info in store.held()]


def test_a_store_of_an_earlier_program_goes_on(path: Path) -> None:
    with SqliteReader(path) as reader:
        assert content(reader) == EXPECTED
        assert reader.apart() == [APART]
    with open_store(path) as store:
        assert store.report == OpenReport()
        assert (store.life, store.epoch, store.assigned) == (EPOCH + 1, EPOCH, 7)
        assert content(store) == EXPECTED
        assert store.get_apart(APART.id, APART.crc) == APART
        assert dict(store.losses()) == {DatumId(8, 5, 3): Fate.OVERFLOW, DatumId(7, EPOCH, 1): Fate.EXPIRED}
        assert (store.counters(), store.get_meta("announcement")) == ({"delivered": 5}, 4)
        assert store.partial(key_of(COMING)) == [(0, COMING.payload[:3000])]
        store.put(COMING)
        store.put(datum(store.next_sequence(), 9000))
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert content(store) == [*EXPECTED, COMING, datum(7, 9000)]


@pytest.mark.parametrize("version", [1, 2, 4])
def test_another_version_is_neither_used_nor_set_aside(path: Path, version: int) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    before = path.read_bytes()
    which = "older" if version < SCHEMA_VERSION else "newer"
    for use in (open_store, SqliteReader, Archive):
        with pytest.raises(StoreError, match=rf"{which} version \(schema {version}, this one supports 3\)"):
            use(path)
    assert path.read_bytes() == before
    assert not list(path.parent.glob("*damaged*"))
