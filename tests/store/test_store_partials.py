"""Payloads of which only a part has come: where they stay, what a crash leaves of them, and that they harm nothing."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, Fate, make_datum
from rass_mav.core.store import PartialKey, key_of
from rass_mav.errors import StoreError, StoreFullError
from rass_mav.lab.disk import Disk
from rass_mav.store.partials import MAX_LOG_BYTES, MAX_RUNS, Partial, Run
from rass_mav.store.quota import SECTOR_BYTES
from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from rass_mav.store.sqlite import SqliteStore
from tests.extent import extents, seeds
from tests.some import some

from .store_helpers import commit, datum, open_store

LARGE = 20_000
KIB = 1024
#: As a chunk is.
PIECE = 123


def log_of(path: Path) -> Path:
    return path.with_name(path.name + ".partials")


def payloads_of(path: Path) -> Path:
    return path.with_name(path.name + ".payloads")


def keep(store: SqliteStore, one: Datum, *ranges: tuple[int, int]) -> None:
    """Pieces of a datum come, and are written."""
    for start, stop in ranges:
        store.keep_partial(key_of(one), start, one.payload[start:stop])
    commit(store, force=False)


def there(store: SqliteStore, one: Datum) -> int:
    """How many bytes of a datum are kept. They are its own."""
    seen = set[int]()
    for offset, data in store.partial(key_of(one)):
        assert data == one.payload[offset : offset + len(data)]
        seen.update(range(offset, offset + len(data)))
    return len(seen)


def sectors(path: Path) -> list[tuple[int, int]]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute("SELECT sequence, payload FROM datum").fetchall()


# -- what stays --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("killed", [False, True])
def test_pieces_survive_a_restart_and_the_rest_is_written_behind_them(path: Path, killed: bool) -> None:
    one, other = datum(1, LARGE), datum(2, LARGE)
    with open_store(path) as store:
        store.put(other)
        commit(store)
        keep(store, one, (0, 5000), (7000, 9000))
        if killed:
            store.abandon()
    with open_store(path) as store:
        assert store.report == OpenReport()
        assert there(store, one) == 7000
        keep(store, one, (4000, 8000))
    with open_store(path) as store:
        assert there(store, one) == 9000
        store.put(one)
        commit(store)
        assert store.corrupt([one.id, other.id]) == []
    assert log_of(path).stat().st_size == 0
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert [store.get(id) for id in store.ids()] == [other, one]
        assert there(store, one) == 0


def test_small_payloads_create_no_file(path: Path) -> None:
    with open_store(path) as store:
        keep(store, datum(1, 3000), (0, 2000))
    assert not log_of(path).exists()


def test_nothing_waits_for_them(path: Path) -> None:
    """Not what is said, and not removals, which wait for a commit with a sync."""
    with open_store(path) as store:
        store.put(datum(1))
        commit(store)
        store.remove(datum(1).id, Fate.PASSED_ON)
        store.keep_partial(key_of(datum(2, LARGE)), 0, b"piece")
        assert not store.unwritten
        batch = some(store.take())
        assert not store.unwritten
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            store.write(batch)
            other.execute("ROLLBACK")
        assert store.take() is None
        assert store.accepting
        with SqliteReader(path) as reader:
            assert reader.ids() == [datum(1).id]


def test_a_batch_that_fails_brings_them_again(path: Path) -> None:
    one = datum(1, LARGE)
    with open_store(path, busy_timeout=0.0) as store:
        store.put(datum(2))
        store.keep_partial(key_of(one), 0, one.payload[:600])
        store.forget_partial(key_of(datum(3, LARGE)))
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(StoreError, match="locked"):
                commit(store)
            other.execute("ROLLBACK")
        store.keep_partial(key_of(one), 600, one.payload[600:900])
        assert there(store, one) == 900
        commit(store)
        assert there(store, one) == 900
    with open_store(path) as store:
        assert there(store, one) == 900


def test_a_poisoned_piece_does_not_get_into_the_datum(path: Path) -> None:
    one = datum(1, LARGE)
    with open_store(path) as store:
        keep(store, one, (0, 5000))
        store.keep_partial(key_of(one), 5000, b"poison" * 100)
        keep(store, one, (9000, 20_000))
        store.put(one)
        commit(store)
        assert store.get(one.id) == one


def test_two_contents_of_one_id_have_places_of_their_own(path: Path) -> None:
    one = datum(1, LARGE)
    two = make_datum(one.id, 1, 1.5, bytes(LARGE))
    with open_store(path) as store:
        keep(store, one, (0, 5000))
        keep(store, two, (0, 9000))
        assert (there(store, one), there(store, two)) == (5000, 9000)
        store.put(one)
        assert store.keep_apart(two)
        commit(store)
        assert store.get(one.id) == one
        assert store.get_apart(two.id, two.crc) == two
    assert log_of(path).stat().st_size == 0


def test_a_reader_sees_nothing_of_them_and_they_leave_alone_what_it_reads(path: Path) -> None:
    data = [datum(number, LARGE) for number in range(4)]
    one = datum(9, LARGE)
    with open_store(path) as store:
        for each in data:
            store.put(each)
        commit(store)
        with SqliteReader(path) as reader:
            for each in data:
                store.remove(each.id, Fate.PASSED_ON)
            store.put(datum(8))
            commit(store)
            keep(store, one, (0, LARGE))
            assert [reader.get(id) for id in reader.ids()] == data
        assert there(store, one) == LARGE


def test_where_nothing_can_be_written_nothing_is_kept(path: Path) -> None:
    one = datum(1, LARGE)
    with Disk(Random(1)) as disk:
        path = disk.directory / "node.db"
        with open_store(path, disk=disk) as store:
            keep(store, one, (0, 5000))
        disk.read_only = True
        with open_store(path, disk=disk) as store:
            assert store.report.unwritable
            store.keep_partial(key_of(one), 0, one.payload[:100])
            store.forget_partial(key_of(one))
            assert store.partial(key_of(one)) == []
        disk.read_only = False
        with open_store(path, disk=disk) as store:
            assert there(store, one) == 5000


# -- how much is written -----------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize(("size", "turns"), [(16 * KIB, 3), (32 * KIB, 6), (64 * KIB, 12)])
def test_parts_that_come_in_pieces_are_written_once(size: int, turns: int, loss: float) -> None:
    """As over a link of 57,600 bit/s: two at a time, each saved every second, and after a loss with holes."""
    rng = Random(size)
    with Disk(Random(1)) as disk:
        store = open_store(disk.directory / "node.db", disk=disk)
        before = disk.written
        numbers: list[int] = []
        for _ in range(40):
            pair = [datum(store.next_sequence(), size) for _ in range(2)]
            missing = {one: list(range(0, size, PIECE)) for one in pair}
            for turn in range(turns):
                for one, left in missing.items():
                    due = left[: len(left) // (turns - turn)]
                    came = [at for at in due if rng.random() >= loss]
                    missing[one] = sorted({*left} - {*came})
                    for start, stop in joined(came):
                        store.keep_partial(key_of(one), start, one.payload[start:stop])
                commit(store, force=False)
            for one in pair:
                store.put(one)
                numbers.append(one.id.sequence)
                for number in numbers[-17:-16]:
                    store.remove(datum(number).id, Fate.PASSED_ON)
                commit(store)
        assert store.corrupt(store.ids()) == []
        store.close()
        assert 1.0 < (disk.written - before) / (80 * size) <= 1.3


def joined(starts: Iterable[int]) -> list[tuple[int, int]]:
    """Runs of pieces that begin there, as ranges."""
    runs: list[tuple[int, int]] = []
    for at in starts:
        if runs and runs[-1][1] == at:
            runs[-1] = runs[-1][0], at + PIECE
        else:
            runs.append((at, at + PIECE))
    return runs


@pytest.mark.no_cover
def test_the_log_stays_small(path: Path) -> None:
    """Data that come in pieces, always two at a time, so that it is never empty."""
    with open_store(path) as store:
        last, grown = None, 0
        for number in range(120):
            one = datum(number, 4096)
            for at in range(0, 4096, 32):
                store.keep_partial(key_of(one), at, one.payload[at : at + 25])
            commit(store, force=False)
            if last is not None:
                store.forget_partial(key_of(last))
            last = one
            size = log_of(path).stat().st_size
            assert size <= MAX_LOG_BYTES + 4 * KIB
            grown = max(grown, size)
        commit(store, force=False)
        assert grown > MAX_LOG_BYTES // 2
        assert there(store, some(last)) == 3200
        store.abandon()
    with open_store(path) as store:
        assert there(store, some(last)) == 3200


@pytest.mark.no_cover
def test_more_pieces_than_a_table_should_have_are_not_kept(path: Path) -> None:
    one = datum(1, 8 * MAX_RUNS)
    with open_store(path) as store:
        keep(store, one, *((at, at + 2) for at in range(0, 4 * MAX_RUNS, 4)))
        keep(store, one, (5 * MAX_RUNS, 5 * MAX_RUNS + 100))
        assert there(store, one) == 2 * MAX_RUNS
        store.put(one)
        commit(store)
        assert store.get(one.id) == one


# -- damage, and old logs ----------------------------------------------------------------------------------------------


def test_a_piece_that_is_damaged_on_the_disk_is_not_there(path: Path) -> None:
    one = datum(1, LARGE)
    with open_store(path) as store:
        keep(store, one, (0, 5000), (6000, 9000))
        with payloads_of(path).open("r+b") as file:
            file.seek(SECTOR_BYTES + 100)
            file.write(b"harm")
        assert there(store, one) == 3000
        store.abandon()
    with open_store(path) as store:
        assert there(store, one) == 3000
        keep(store, one, (0, 5000))
        assert there(store, one) == 8000
        store.put(one)
        commit(store)
        assert store.get(one.id) == one


def test_a_log_is_believed_up_to_its_first_damage(path: Path) -> None:
    one = datum(1, LARGE)
    sizes = [0]
    with open_store(path) as store:
        for at in range(0, 10_000, 1000):
            keep(store, one, (at, at + 1000))
            sizes.append(log_of(path).stat().st_size)
        store.abandon()
    content = log_of(path).read_bytes()
    rng = Random(5)
    for _ in range(25):
        at = rng.randrange(len(content))
        harmed = bytearray(content)
        harmed[at] ^= 1 << rng.randrange(8)
        log_of(path).write_bytes(harmed)
        sound = max(index for index, size in enumerate(sizes) if size <= at)
        with open_store(path) as store:
            assert there(store, one) == 1000 * sound
            keep(store, one, (15_000, 16_000))
            store.abandon()
        with open_store(path) as store:
            assert there(store, one) == 1000 * sound + 1000
            store.abandon()


def test_what_a_longer_log_left_behind_the_end_does_not_count(path: Path) -> None:
    one, two = datum(1, LARGE), datum(2, LARGE)
    with open_store(path) as store:
        keep(store, one, *((at, at + 500) for at in range(0, 10_000, 1000)))
        longer = log_of(path).read_bytes()
        store.forget_partial(key_of(one))
        keep(store, two, (0, 500), (1000, 1500))
        store.abandon()
    shorter = log_of(path).read_bytes()
    log_of(path).write_bytes(shorter + longer[len(shorter) :])
    with open_store(path) as store:
        assert there(store, two) == 1000
        assert there(store, one) == 0


@pytest.mark.parametrize("content", [b"", b"RASSPART", b"not a log at all", bytes(4096)])
def test_a_file_that_is_no_log_is_ignored(path: Path, content: bytes) -> None:
    open_store(path).close()
    log_of(path).write_bytes(content)
    one = datum(1, LARGE)
    for _ in range(2):
        with open_store(path) as store:
            assert store.report == OpenReport()
            keep(store, one, (0, 5000))
            assert there(store, one) == 5000


def test_the_log_of_another_store_is_ignored(path: Path, tmp_path: Path) -> None:
    one, other = datum(1, LARGE), tmp_path / "other.db"
    with open_store(other, draw_epoch=iter((55, 66)).__next__) as store:
        keep(store, one, (0, 5000))
        store.abandon()
    with open_store(path) as store:
        store.put(datum(2, LARGE))
    shutil.copy(log_of(other), log_of(path))
    with open_store(path) as store:
        assert there(store, one) == 0
        assert store.corrupt(store.ids()) == []


def test_rows_are_right_and_an_old_log_is_not(path: Path) -> None:
    """Its partials lie where rows are by now, or where a later partial is."""
    one = datum(1, LARGE)
    with open_store(path) as store:
        keep(store, one, (0, LARGE))
        old = log_of(path).read_bytes()
        store.forget_partial(key_of(one))
        commit(store, force=False)
        store.put(datum(2, LARGE))
        commit(store)
        assert sectors(path) == [(2, 1)]
        store.abandon()
    log_of(path).write_bytes(old)
    with open_store(path) as store:
        assert there(store, one) == 0
        for number in range(3, 9):
            keep(store, datum(number, LARGE), (0, LARGE))
        store.put(datum(9, LARGE))
        commit(store)
        assert store.corrupt(store.ids()) == []
        assert {there(store, datum(number, LARGE)) for number in range(3, 9)} == {LARGE}


def test_a_store_that_is_set_aside_takes_its_log_with_it(path: Path) -> None:
    one = datum(1, LARGE)
    with open_store(path) as store:
        store.put(datum(2, LARGE))
        commit(store)
        keep(store, one, (0, 5000))
        store.abandon()
    content = bytearray(path.read_bytes())
    content[16:24] = bytes(8)
    path.write_bytes(content)
    with open_store(path) as store:
        assert store.report.set_aside == path.with_name("node.db.damaged-1")
        assert [store.get(id) for id in store.ids()] == [datum(2, LARGE)]
        assert there(store, one) == 0
        keep(store, one, (0, 6000))
        assert there(store, one) == 6000
    assert log_of(path.with_name("node.db.damaged-1")).exists()


@pytest.mark.parametrize("ending", [".payloads", ".partials"])
def test_a_copy_without_one_of_the_files_has_no_partials(path: Path, ending: str) -> None:
    one = datum(1, LARGE)
    with open_store(path) as store:
        keep(store, one, (0, 5000))
    path.with_name(path.name + ending).unlink()
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert there(store, one) == 0
        keep(store, one, (0, 6000))
        assert there(store, one) == 6000


# -- a full disk, and power cuts ---------------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_on_a_full_disk_they_make_way_and_no_commit_fails_because_of_them() -> None:
    with Disk(Random(1)) as disk, open_store(disk.directory / "node.db", disk=disk) as store:
        for _ in range(1500):
            store.put(datum(store.next_sequence(), 3000))
        # Afterwards the log is used from its beginning again.
        commit(store)
        for id in list(store.ids()):
            store.remove(id, Fate.PASSED_ON)
        one, two = datum(1, LARGE), datum(2, LARGE)
        keep(store, one, (0, LARGE))
        disk.full = True
        # One for which there is no space is not kept, and nothing fails.
        keep(store, two, (0, LARGE))
        assert (there(store, one), there(store, two)) == (LARGE, 0)
        assert store.accepting
        store.put(datum(3, LARGE))
        commit(store)
        assert there(store, one) == 0
        assert store.get(datum(3).id) == datum(3, LARGE)
        store.put(datum(4, LARGE))
        with pytest.raises(StoreFullError):
            commit(store)
        disk.full = False
        commit(store)
        assert store.corrupt(store.ids()) == []


class SmallDisk(Disk):
    """It has so much space for all files together."""

    capacity = 1 << 30

    def _write(self, address: int, data: int, count: int, offset: int) -> int:
        self.full = sum(file.stat().st_size for file in self.directory.iterdir()) + count > self.capacity
        return super()._write(address, data, count, offset)


def test_the_database_has_the_space_before_them() -> None:
    disk = SmallDisk(Random(1))
    with disk, open_store(disk.directory / "node.db", disk=disk) as store:
        one = datum(1, 100_000)
        keep(store, one, (0, 100_000))
        disk.capacity = 300_000
        # More than fits beside the partial.
        for number in range(10, 50):
            store.put(datum(number, 3000))
            commit(store)
        assert there(store, one) == 0


def history(store: SqliteStore, committed: set[Datum]) -> None:
    """Data come in pieces, whole or not, and go. `committed` gets what must be on disk."""
    draw = Random(4)
    coming = [datum(number, draw.choice((4096, 9000, LARGE, 60_000))) for number in range(40)]
    under_way: dict[Datum, int] = {}
    for turn in range(60):
        while coming and len(under_way) < 3:
            under_way[coming.pop()] = 0
        for one, at in list(under_way.items()):
            stop = min(len(one.payload), at + draw.randrange(6000))
            if draw.random() < 0.9:
                store.keep_partial(key_of(one), at, one.payload[at:stop])
            under_way[one] = stop
            if stop == len(one.payload) or draw.random() < 0.02:
                del under_way[one]
                store.put(one)
            elif draw.random() < 0.03:
                del under_way[one]
                store.forget_partial(key_of(one))
        gone = draw.sample(list(store.ids()), len(list(store.ids())) // 3) if turn % 3 == 0 else []
        for id in gone:
            store.remove(id, Fate.PASSED_ON)
            committed -= {one for one in committed if one.id == id}
        if commit(store, force=turn % 2 == 0):
            committed |= {held for id in store.ids() if store.durable(id) and (held := store.get(id)) is not None}
    store.close()


@pytest.mark.parametrize("step", extents(37, 1))
def test_a_power_cut_at_any_change_damages_no_datum_and_leaves_only_right_pieces(step: int) -> None:
    """What was committed last is whole; what is said to be there is right; and the store goes on."""
    every = [datum(number, size) for number in range(40) for size in (4096, 9000, LARGE, 60_000)]
    kept = 0
    for after in range(step - 1, 10_000, step):
        with Disk(Random(after)) as disk:
            path = disk.directory / "node.db"
            store = open_store(path, disk=disk)
            committed: set[Datum] = set()
            disk.cut(after=after)
            try:
                history(store, committed)
                break
            except StoreError:
                store.abandon()
            disk.restart()
            with open_store(path, disk=disk, suspect=after % 2 == 0) as store:
                assert store.report == OpenReport()
                assert store.corrupt(store.ids()) == []
                assert committed <= {store.get(id) for id in store.ids()}
                pieces = {one: there(store, one) for one in every}
                kept += sum(map(bool, pieces.values()))
                found = dict.fromkeys(store.ids())
                for one, size in pieces.items():
                    if size and one.id not in found:
                        store.put(one)
                        commit(store)
                for number in range(100, 104):
                    store.put(datum(number, LARGE))
                    keep(store, datum(number + 10, LARGE), (0, 3000))
                commit(store)
                assert store.corrupt(store.ids()) == []
                disk.cut()
                store.abandon()
            disk.restart()
            with open_store(path, disk=disk) as store:
                # All of this was committed: the pieces that were there are on the medium now.
                assert store.corrupt(store.ids()) == []
                assert found.keys() <= dict.fromkeys(store.ids()).keys()
    else:
        pytest.fail("the history never ends")
    assert kept > 10


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", seeds(40, 600))
def test_whatever_fails_no_commit_that_succeeded_is_damaged(seed: int) -> None:
    with Disk(Random(seed)) as disk:
        path = disk.directory / "node.db"
        store = open_store(path, disk=disk)
        rng = Random(seed)
        durable: set[Datum] = set()
        for number in range(30):
            one = datum(number, rng.choice((5000, LARGE)))
            disk.error_rate = rng.choice((0.0, 0.1, 0.3))
            for at in range(0, 4000, 1000):
                store.keep_partial(key_of(one), at, one.payload[at : at + 1000])
                if rng.random() < 0.5:
                    with suppress(StoreError):
                        commit(store, force=False)
            if rng.random() < 0.7:
                store.put(one)
            with suppress(StoreError):
                commit(store)
            disk.error_rate = 0.0
            durable = {held for id in store.ids() if store.durable(id) and (held := store.get(id)) is not None}
        disk.cut()
        store.abandon()
        disk.restart()
        with open_store(path, disk=disk) as store:
            assert store.corrupt(store.ids()) == []
            assert durable <= {store.get(id) for id in store.ids()}


# -- what is missing ---------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 20))), st.integers(0, 60), st.integers(0, 60))
def test_gaps_are_what_no_run_has(runs: list[tuple[int, int]], start: int, stop: int) -> None:
    partial = Partial(1, tuple([Run(offset, size, 0) for offset, size in runs]))
    covered = {at for offset, size in runs for at in range(offset, offset + size)}
    gaps = partial.gaps(start, stop)
    assert [at for a, b in gaps for at in range(a, b)] == [at for at in range(start, stop) if at not in covered]
    assert all(a < b for a, b in gaps)


def test_a_key_is_a_content() -> None:
    one = datum(1, 100)
    assert key_of(one) == PartialKey(one.id, one.crc, 100)
    assert key_of(one._replace(hops=3, created=9.0)) == key_of(one)
