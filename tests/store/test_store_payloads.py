"""Payloads of 4 KiB and more beside the database: written once, found by their rows, and lost one by one."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, Fate, make_datum
from rass_mav.errors import StoreError, StoreFullError
from rass_mav.ground.archive import Archive
from rass_mav.lab.disk import Disk
from rass_mav.store.extents import Extents
from rass_mav.store.payloads import TRIM_BYTES, life_in
from rass_mav.store.quota import BESIDE_BYTES, MOST_BESIDE_BYTES, ROW_OVERHEAD, SECTOR_BYTES, cost
from rass_mav.store.reader import SqliteReader
from rass_mav.store.repairs import OpenReport
from rass_mav.store.sqlite import SqliteStore
from tests.extent import extents
from tests.some import some

from .store_helpers import EPOCH, commit, datum, open_store

LARGE = 20_000
KIB = 1024


def beside(path: Path) -> Path:
    return path.with_name(path.name + ".payloads")


def fill(store: SqliteStore, sizes: list[int]) -> list[Datum]:
    """Store data of these sizes, each with a commit of its own."""
    data = []
    for size in sizes:
        data.append(datum(store.next_sequence(), size))
        store.put(data[-1])
        commit(store)
    return data


def held(store: SqliteStore | SqliteReader) -> list[Datum | None]:
    return [store.get(id) for id in store.ids()]


def positions(path: Path) -> dict[int, int]:
    """By sequence number, the sector at which a payload begins."""
    with closing(sqlite3.connect(path)) as connection:
        return dict(connection.execute("SELECT sequence, payload FROM datum WHERE typeof(payload) = 'integer'"))


def harm(path: Path, number: int, at: int = 100) -> None:
    """Damage the stored payload of a datum."""
    with beside(path).open("r+b") as file:
        file.seek(positions(path)[number] * SECTOR_BYTES + at)
        file.write(b"harm")


# -- where they are ----------------------------------------------------------------------------------------------------


def test_small_data_need_no_second_file(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [0, 1, 50, BESIDE_BYTES - 1])
        assert held(store) == data
    assert not beside(path).exists()


def test_large_ones_are_beside_the_database_each_from_a_sector_on(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [BESIDE_BYTES, 50, LARGE, MOST_BESIDE_BYTES, MOST_BESIDE_BYTES + 1])
        assert held(store) == data
        life = store.life
    content = beside(path).read_bytes()
    assert life_in(content[:SECTOR_BYTES]) == life
    at = positions(path)
    assert at.keys() == {0, 2, 3}
    for number, sector in at.items():
        payload = data[number].payload
        assert content[sector * SECTOR_BYTES :][: len(payload)] == payload
    with SqliteReader(path) as reader:
        assert held(reader) == data
        rows = list(reader.rows(10))
        assert [row is not None and row.head for row in rows] == [one.payload[:10] for one in data]
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert held(store) == data


def test_second_contents_too(path: Path) -> None:
    first, second = datum(1, LARGE), make_datum(datum(1).id, 1, 1.5, b"other" * 2000)
    with open_store(path) as store:
        store.put(first)
        assert store.keep_apart(second)
        commit(store)
        assert store.get_apart(second.id, second.crc) == second
        # It takes the place of the first, and both contents are stored once more under other sectors.
        store.put(second)
        commit(store)
    with SqliteReader(path) as reader:
        assert reader.apart() == [second]
        assert reader.get(second.id) == second
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()


def test_the_quota_counts_sectors(path: Path) -> None:
    with open_store(path, quota_bytes=2 * (8192 + ROW_OVERHEAD)) as store:
        fill(store, [8192, 7681])
        assert store.used_bytes == 2 * (8192 + ROW_OVERHEAD)
        assert not store.room_for(0)
        with pytest.raises(StoreFullError, match="quota"):
            store.put(datum(2, 1))
    assert beside(path).stat().st_size <= SECTOR_BYTES + 2 * 8192


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_its_permissions_are_those_of_the_database(path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        with open_store(path) as store:
            fill(store, [LARGE])
    finally:
        os.umask(before)
    mode = [file.stat().st_mode & 0o777 for file in (path, beside(path))]
    assert mode[0] == mode[1]
    beside(path).chmod(0o666)
    open_store(path).close()
    assert beside(path).stat().st_mode & 0o777 == 0o640


# -- how much is written -----------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("group", [1, 8])
@pytest.mark.parametrize(("size", "most"), [(16 * KIB, 1.3), (32 * KIB, 1.2), (64 * KIB, 1.1)])
def test_parts_are_written_once(size: int, most: float, group: int) -> None:
    """1,600 parts, each removed 200 parts later: log and checkpoints included. `group`: parts a commit."""
    with Disk(Random(1)) as disk:
        store = open_store(disk.directory / "node.db", disk=disk)
        before = disk.written
        numbers = []
        for _ in range(1600 // group):
            for _ in range(group):
                numbers.append(store.next_sequence())
                store.put(datum(numbers[-1], size))
            for number in numbers[-200 - group : -200]:
                store.remove(datum(number).id, Fate.PASSED_ON)
            commit(store)
        store.close()
        assert 1.0 < (disk.written - before) / (1600 * size) <= most


def test_the_space_of_what_goes_is_used_again(path: Path) -> None:
    with open_store(path) as store:
        for number in range(200):
            store.put(datum(number, LARGE))
            if number >= 5:
                store.remove(datum(number - 5).id, Fate.PASSED_ON)
            commit(store)
            assert beside(path).stat().st_size < 10 * LARGE
        assert held(store) == [datum(number, LARGE) for number in range(195, 200)]


def test_a_file_that_empties_shrinks(path: Path) -> None:
    with open_store(path) as store:
        fill(store, [200_000] * 20)
        full = beside(path).stat().st_size
        for number in range(1, 20):
            store.remove(datum(number).id, Fate.PASSED_ON)
        commit(store)
        assert beside(path).stat().st_size < full / 2
        store.remove(datum(0).id, Fate.PASSED_ON)
    assert beside(path).stat().st_size == SECTOR_BYTES
    assert not list(open_and_list(path))


def test_space_that_a_killed_node_left_is_cut_off_by_the_next_commit(path: Path) -> None:
    store = open_store(path)
    fill(store, [LARGE])
    store.abandon()
    with beside(path).open("ab") as file:
        file.write(bytes(2 * TRIM_BYTES))
    with open_store(path) as store:
        assert store.report == OpenReport()
        assert beside(path).stat().st_size > 2 * TRIM_BYTES
        fill(store, [50])
        assert beside(path).stat().st_size < TRIM_BYTES
        assert store.get(datum(0).id) == datum(0, LARGE)


def open_and_list(path: Path) -> list[Datum | None]:
    with open_store(path) as store:
        return held(store)


# -- readers -----------------------------------------------------------------------------------------------------------


def test_what_a_reader_may_read_stays_until_it_rests(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 4)
        with SqliteReader(path) as reader:
            for one in data:
                store.remove(one.id, Fate.PASSED_ON)
            commit(store)
            for number in range(4, 12):
                store.put(datum(number, LARGE))
                commit(store)
            assert held(reader) == data
            grown = beside(path).stat().st_size
            assert grown > 11 * LARGE
            reader.rest()
            for number in range(12, 16):
                store.put(datum(number, LARGE))
                commit(store)
            # The first of them found out that nobody reads any more.
            assert beside(path).stat().st_size < grown + 2 * LARGE
            reader.renew()
            assert held(reader) == [datum(number, LARGE) for number in range(4, 16)]


def test_a_reader_finds_a_file_that_came_after_it(path: Path) -> None:
    with open_store(path) as store, SqliteReader(path) as reader:
        (one,) = fill(store, [LARGE])
        assert held(reader) == []
        reader.renew()
        assert held(reader) == [one]


# -- damage ------------------------------------------------------------------------------------------------------------


def test_a_damaged_part_is_one_datum(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 5)
        harm(path, 2)
        assert store.corrupt(store.ids()) == [data[2].id]
    with open_store(path) as store:
        assert store.report == OpenReport()
        assert store.corrupt(store.ids()) == [data[2].id]
        store.remove(data[2].id, Fate.CORRUPTED)
        commit(store)
    assert open_and_list(path) == [one for one in data if one is not data[2]]


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
def test_a_file_that_is_gone_takes_its_data_with_it_and_nothing_else(path: Path, check_limit: int) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE, 50, LARGE])
    beside(path).unlink()
    with open_store(path, check_limit=check_limit) as store:
        assert held(store) == [data[1]]
        assert dict(store.losses()) == {data[0].id: Fate.CORRUPTED, data[2].id: Fate.CORRUPTED}
        assert store.report.remarks[0] == "node.db.payloads is missing: 2 data are lost"
        new = fill(store, [LARGE])
    assert open_and_list(path) == [data[1], *new]


@pytest.mark.parametrize("check_limit", [0, 1 << 30])
def test_a_file_that_was_cut_off_takes_what_lay_behind(path: Path, check_limit: int) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 4)
    os.truncate(beside(path), beside(path).stat().st_size - LARGE - 1000)
    with open_store(path, check_limit=check_limit) as store:
        assert held(store) == data[:2]
        assert dict(store.losses()).keys() == {data[2].id, data[3].id}
        assert "node.db.payloads is damaged or truncated: 2 data are lost" in store.report.remarks
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()


def test_the_file_of_another_store_is_set_aside(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    with open_store(path) as store:
        data = fill(store, [LARGE, 50])
    with open_store(other, draw_epoch=iter((55, 66)).__next__, node_id=9) as store:
        store.put(datum(5, LARGE))
    foreign = beside(other).read_bytes()
    beside(path).write_bytes(foreign)
    with SqliteReader(path) as reader:
        assert [row is not None and row.head for row in reader.rows(10)] == [b"", data[1].payload[:10]]
    with open_store(path) as store:
        assert held(store) == [data[1]]
        assert dict(store.losses()) == {data[0].id: Fate.CORRUPTED}
        assert store.report.remarks[0] == (
            "node.db.payloads belongs to another store and was set aside (node.db.damaged-1.payloads): 1 data are lost"
        )
        new = fill(store, [LARGE])
        assert held(store) == [data[1], *new]
    assert (tmp_path / "node.db.damaged-1.payloads").read_bytes() == foreign


def test_a_damaged_head_costs_nothing(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 3)
    with beside(path).open("r+b") as file:
        file.write(b"harm")
    harm(path, 1)
    with open_store(path) as store:
        assert held(store) == [data[0], data[2]]
        assert dict(store.losses()) == {data[1].id: Fate.CORRUPTED}
        life = store.life
    assert life_in(beside(path).read_bytes()[:SECTOR_BYTES]) == life
    assert open_and_list(path) == [data[0], data[2]]


def test_rows_that_claim_the_same_sectors_are_told_apart_by_their_checksum(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 4)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE datum SET payload = payload + 3 WHERE sequence = 1")
        connection.commit()
    for check_limit in (0, 1 << 30):
        with open_store(path, check_limit=check_limit) as store:
            assert held(store) == [data[0], data[2], data[3]]
            assert dict(store.losses()) == {data[1].id: Fate.CORRUPTED}


@pytest.mark.parametrize(
    "change", ["payload = -1", "payload = 0", "payload = 1 << 60", "size = 1 << 50", "size = 0", "size = 'x'"]
)
@pytest.mark.parametrize("check_limit", [0, 1 << 30])
def test_a_row_with_an_impossible_position_is_one_row(path: Path, change: str, check_limit: int) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE] * 3)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute(f"UPDATE datum SET {change} WHERE sequence = 1")
        connection.commit()
    with SqliteReader(path) as reader:
        assert [row is not None and row.head for row in reader.rows(9)][::2] == [data[i].payload[:9] for i in (0, 2)]
    with open_store(path, check_limit=check_limit, suspect=change == "size = 'x'") as store:
        assert held(store) == [data[0], data[2]]
        assert dict(store.losses()) == {data[1].id: Fate.CORRUPTED}


def test_payloads_of_a_damaged_database_are_salvaged(path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE, 50, LARGE, LARGE])
    harm(path, 2)
    content = bytearray(path.read_bytes())
    content[16:24] = bytes(8)
    path.write_bytes(content)
    with open_store(path) as store:
        assert store.report.set_aside is not None
        assert sorted(filter(None, held(store))) == [data[0], data[1], data[3]]
        new = datum(store.next_sequence(), LARGE, epoch=store.epoch)
        store.put(new)
        commit(store)
    assert beside(path.with_name("node.db.damaged-1")).exists()
    with open_store(path, suspect=True) as store:
        assert store.report == OpenReport()
        assert len(held(store)) == 4


def test_a_file_whose_database_is_gone_is_set_aside(path: Path) -> None:
    with open_store(path) as store:
        fill(store, [LARGE])
    for ending in ("", ".mark"):
        path.with_name(path.name + ending).unlink()
    with open_store(path) as store:
        assert store.report.reason == "payloads without their database"
        assert held(store) == []
    assert (path.parent / "node.db.damaged-1.payloads").exists()
    assert open_and_list(path) == []


def test_a_card_without_the_file_lists_what_it_can(path: Path, tmp_path: Path) -> None:
    with open_store(path) as store:
        data = fill(store, [LARGE, 50])
    copy = tmp_path / "card.db"
    shutil.copy(path, copy)
    with Archive(copy) as archive:
        entries = list(archive.entries())
        assert [entry.id for entry in entries] == [one.id for one in data]
        assert entries[0].malformed == "its content is missing"
        assert archive.payload(str(data[1].id)) == data[1].payload
        assert archive.remarks == [f"{copy}.payloads is missing: the contents of 1 data cannot be read"]
        with pytest.raises(StoreError, match="corrupt"):
            archive.payload(str(data[0].id))
    shutil.copy(beside(path), beside(copy))
    with Archive(copy) as archive:
        list(archive.entries())
        assert archive.remarks == []
        assert archive.payload(str(data[0].id)) == data[0].payload


# -- a full disk, and power cuts ---------------------------------------------------------------------------------------


def test_a_full_disk_refuses_them_and_goes_on_when_there_is_space() -> None:
    with Disk(Random(1)) as disk, open_store(disk.directory / "node.db", disk=disk) as store:
        for _ in range(1500):
            store.put(datum(store.next_sequence(), 3000))
        # Afterwards the log is used from its beginning again.
        commit(store)
        for id in list(store.ids()):
            store.remove(id, Fate.PASSED_ON)
        data = fill(store, [LARGE] * 3)
        disk.full = True
        store.put(datum(1, LARGE))
        # Still full: the same batch fails again.
        for _ in range(2):
            with pytest.raises(StoreFullError, match="No space left on device"):
                commit(store)
        assert not store.accepting
        assert store.get(datum(1).id) == datum(1, LARGE)
        assert [store.durable(one.id) for one in (*data, datum(1))] == [True, True, True, False]
        # What is handed over makes space.
        store.remove(data[0].id, Fate.PASSED_ON)
        commit(store)
        assert store.accepting
        assert store.durable(datum(1).id)
        assert held(store) == [*data[1:], datum(1, LARGE)]
        # One that is too large for the space of what goes: that goes all the same.
        store.remove(data[1].id, Fate.PASSED_ON)
        store.put(datum(2, 2 * LARGE))
        with pytest.raises(StoreFullError):
            commit(store)
        disk.full = False
        commit(store)
        assert held(store) == [data[2], datum(1, LARGE), datum(2, 2 * LARGE)]


def history(store: SqliteStore, after_commit: Callable[[], None]) -> None:
    """Large and small data come and go; space is used again, and the file is cut off."""
    draw = Random(4)
    for turn in range(14):
        ids = list(store.ids())
        for id in draw.sample(ids, len(ids) // 2) if turn != 9 else ids:
            store.remove(id, Fate.PASSED_ON)
        for _ in range(draw.randint(1, 3)):
            size = draw.choice((50, 3000, 5000, LARGE, 600_000 if turn < 9 else 700))
            store.put(datum(store.next_sequence(), size))
        store.count("commits")
        commit(store)
        after_commit()
    store.close()


def state(store: SqliteStore) -> tuple[dict[str, int], list[Datum | None]]:
    return store.counters(), sorted(held(store), key=str)


@pytest.mark.no_cover
@pytest.mark.parametrize("step", extents(7, 1))
def test_a_power_cut_at_any_change_leaves_one_commit_or_the_next(step: int) -> None:
    with Disk(Random(0)) as disk:
        store = open_store(disk.directory / "node.db", disk=disk)
        states = [state(store)]
        history(store, lambda: states.append(state(store)))
    seen: Counter[str] = Counter()
    for after in range(step - 1, 10_000, step):
        with Disk(Random(after)) as disk:
            path = disk.directory / "node.db"
            store = open_store(path, disk=disk)
            acknowledged = 0

            def count() -> None:
                nonlocal acknowledged
                acknowledged += 1

            disk.cut(after=after)
            try:
                history(store, count)
                break
            except StoreError:
                store.abandon()
            disk.restart()
            with open_store(path, disk=disk, suspect=after % 2 == 0) as store:
                assert store.report == OpenReport()
                found = state(store)
                assert found in states[acknowledged : acknowledged + 2]
                seen["last" if found == states[acknowledged] else "next"] += 1
                for _ in range(3):
                    store.put(datum(store.next_sequence(), LARGE))
                    commit(store)
                assert store.corrupt(store.ids()) == []
    else:
        pytest.fail("the history never ends")
    assert sum(seen.values()) > 10


@pytest.mark.no_cover
def test_a_failed_commit_keeps_its_sectors_until_one_succeeds() -> None:
    """A commit whose sync fails may be on the medium all the same. Nothing else may lie in its sectors then."""
    with Disk(Random(1)) as disk:
        path = disk.directory / "node.db"
        for seed in range(60):
            disk.rng.seed(seed)
            store = open_store(path, disk=disk)
            fill_from = store.assigned
            store.put(datum(store.next_sequence(), LARGE))
            batch = some(store.take())
            disk.error_rate = 0.15
            try:
                store.write(batch)
            except StoreError:
                disk.error_rate = 0.0
                store.put(datum(store.next_sequence(), LARGE))
                disk.cut(after=seed % 9)
                with suppress(StoreError):
                    commit(store)
            disk.error_rate = 0.0
            disk.cut()
            store.abandon()
            disk.restart()
            with open_store(path, disk=disk) as store:
                assert store.corrupt(store.ids()) == []
                assert store.assigned in range(fill_from, fill_from + 3)


# -- which sectors -----------------------------------------------------------------------------------------------------


@given(st.lists(st.one_of(st.integers(1, 40), st.sampled_from(["release", "recycle", "give back", "trim", "again"]))))
def test_sectors_are_never_taken_twice(calls: list[int | str]) -> None:
    table = Extents((), 1, 1)
    used: dict[int, int] = {}
    released: set[int] = set()
    for call in calls:
        if isinstance(call, int):
            start = table.take(call)
            taken = set(range(start, start + call))
            assert start >= 1
            assert not taken & released
            assert not any(taken & set(range(first, first + count)) for first, count in used.items())
            used[start] = call
        elif call in ("release", "give back") and used:
            start = sorted(used)[len(calls) % len(used)]
            count = used.pop(start)
            if call == "release":
                released |= set(range(start, start + count))
                table.release(start, count)
            else:
                table.give_back(start, count)
        elif call == "recycle":
            released.clear()
            table.recycle()
        elif call == "trim":
            table.trim()
        elif call == "again":
            # As after a restart.
            table = Extents(used.items(), 1, table.end)
            last = max((first + count for first, count in used.items()), default=1)
            released = set(range(1, table.end)) - {
                n for first, count in used.items() for n in range(first, first + count)
            }
            assert last <= table.end
        assert table.used == len(used)
        assert max((first + count for first, count in used.items()), default=1) <= table.end - table.tail
    table.recycle()
    table.trim()
    assert table.end == max((first + count for first, count in used.items()), default=1)


def test_ranges_that_cannot_be() -> None:
    for used, end in (([(1, 3), (3, 1)], 9), ([(0, 1)], 9), ([(5, 4)], 8), ([(-2, 1)], 9)):
        with pytest.raises(ValueError, match="are allocated twice or missing"):
            Extents(used, 1, end)


def test_the_cost_of_a_datum() -> None:
    assert [cost(size) for size in (0, 4095, 4096, 4097, 20_000)] == [
        ROW_OVERHEAD + real for real in (0, 4095, 4096, 4608, 20_480)
    ]
    assert datum(0).id.epoch == EPOCH
