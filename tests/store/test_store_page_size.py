"""Pages of a new store and of an older one: how large the log becomes, and salvage where nothing says their size."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from rass_mav.core.datum import Fate
from rass_mav.store.repairs import OpenReport
from rass_mav.store.schema import PAGE_BYTES

from .store_helpers import EPOCH, commit, datum, epochs, give_pages, open_store, page_bytes

#: Of the first stores with tables of version 3.
EARLIER_PAGE_BYTES = 4096
HALF = 60
#: What a damaged part of a file is full of.
ZEROS, ONES = b"\0", b"\xff"

both = pytest.mark.parametrize("size", [PAGE_BYTES, EARLIER_PAGE_BYTES])


def length(number: int) -> int:
    """Of a payload: small, more than a page of a new store, beside the database."""
    return (50, 50, 2500, 9000)[number % 4]


@pytest.fixture
def killed(tmp_path: Path) -> Callable[[int], Path]:
    """A store with pages of this size as `kill -9` leaves it: half of its data are in the database, half in the log."""

    def kill(size: int) -> Path:
        path = tmp_path / "working" / "node.db"
        path.parent.mkdir()
        open_store(path).close()
        give_pages(path, size)
        for turn in range(2):
            store = open_store(path)
            for _ in range(HALF):
                number = store.next_sequence()
                store.put(datum(number, length(number)))
                commit(store)
            if not turn:
                store.close()
        copy = tmp_path / "node.db"
        for ending in ("", "-wal", ".mark", ".payloads"):
            shutil.copy(f"{path}{ending}", f"{copy}{ending}")
        store.abandon()
        assert page_bytes(path) == size
        return copy

    return kill


def overwrite(path: Path, size: int, filler: bytes) -> None:
    """Damage the first bytes of a file."""
    with path.open("r+b") as file:
        file.write(filler * size)


def log_of(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


def assert_holds(path: Path, numbers: range) -> OpenReport:
    """Opening finds these data and no others."""
    with open_store(path, draw_epoch=epochs(77)) as store:
        assert {id.sequence for id in store.ids()} == {*numbers}
        assert [store.get(id) for id in store.ids()] == [datum(id.sequence, length(id.sequence)) for id in store.ids()]
        return store.report


@pytest.mark.no_cover
@pytest.mark.parametrize("filler", [ZEROS, ONES])
@pytest.mark.parametrize("damaged", [32, 100, 512])
def test_where_neither_the_file_nor_the_log_says_it(killed: Callable[[int], Path], damaged: int, filler: bytes) -> None:
    path = killed(PAGE_BYTES)
    for file in (path, log_of(path)):
        overwrite(file, damaged, filler)
    report = assert_holds(path, range(HALF))
    assert report.set_aside is not None
    assert report.lost >= HALF, "the log cannot be read without its head"


@pytest.mark.no_cover
@both
def test_where_only_the_log_is_left(killed: Callable[[int], Path], size: int) -> None:
    path = killed(size)
    path.unlink()
    with open_store(path, draw_epoch=epochs(77)) as store:
        found = {id.sequence for id in store.ids()}
        assert found >= {*range(HALF, 2 * HALF)}
        assert store.report.lost >= 2 * HALF - len(found)


@both
def test_where_only_the_log_is_left_without_its_head(killed: Callable[[int], Path], size: int) -> None:
    path = killed(size)
    path.unlink()
    overwrite(log_of(path), 32, ZEROS)
    assert assert_holds(path, range(0)).lost >= 2 * HALF


@pytest.mark.no_cover
@both
def test_a_log_says_it_where_the_file_does_not(killed: Callable[[int], Path], size: int) -> None:
    path = killed(size)
    overwrite(path, 512, ONES)
    assert assert_holds(path, range(2 * HALF)).set_aside is not None
    assert page_bytes(path) == PAGE_BYTES


@pytest.mark.no_cover
@both
@pytest.mark.parametrize("damaged", [32, 512, 4096])
def test_a_log_without_its_head_beside_a_sound_database(killed: Callable[[int], Path], size: int, damaged: int) -> None:
    path = killed(size)
    overwrite(log_of(path), damaged, ZEROS)
    report = assert_holds(path, range(HALF))
    assert (report.created, report.salvaged, report.lost) == (False, 0, HALF)
    assert report.closed == ((EPOCH, 2 * HALF),)


@pytest.mark.no_cover
@both
def test_without_a_mark_what_such_a_log_can_have_had_is_bounded(killed: Callable[[int], Path], size: int) -> None:
    path = killed(size)
    path.with_name("node.db.mark").unlink()
    overwrite(log_of(path), 32, ZEROS)
    length = log_of(path).stat().st_size
    assert assert_holds(path, range(HALF)).lost == length // 32


@both
def test_a_store_goes_on_with_its_pages(path: Path, size: int) -> None:
    open_store(path).close()
    assert page_bytes(path) == PAGE_BYTES
    give_pages(path, size)
    for _ in range(2):
        with open_store(path) as store:
            assert store.report == OpenReport()
            store.put(datum(store.next_sequence(), 3000))
        assert page_bytes(path) == size


@pytest.mark.no_cover
@both
def test_the_log_has_4_mib_whatever_the_page_size_is(path: Path, size: int) -> None:
    open_store(path).close()
    give_pages(path, size)
    with open_store(path) as store:
        for number in range(0, 3000, 100):
            for one in range(number, number + 100):
                store.put(datum(one, 4000))
                if number:
                    store.remove(datum(one - 100).id, Fate.PASSED_ON)
            commit(store)
        # A commit of 0.5 MB is the last before the log begins anew.
        assert 4.0 <= log_of(path).stat().st_size / (1 << 20) < 4.6
