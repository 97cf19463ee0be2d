"""The simulated disk: what was synced is there after a power cut, the rest as chance has it; and it fails as told."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from rass_mav.core.datum import DatumId, Fate, make_datum
from rass_mav.errors import StoreDamagedError, StoreError, StoreFullError
from rass_mav.lab.disk import Disk
from rass_mav.lab.disk.disk import SECTOR, Image
from rass_mav.lab.disk.library import load
from rass_mav.store.log import FRAME_HEAD_BYTES
from rass_mav.store.repairs import OpenReport
from rass_mav.store.schema import PAGE_BYTES
from rass_mav.store.sqlite import SqliteStore
from tests.environment import environment
from tests.extent import extents
from tests.some import some

EPOCH = 0xFEDC0001
ROOT = Path(__file__).resolve().parents[3]


def payload(number: int) -> bytes:
    """Small and large, up to several pages; no two are alike."""
    return hashlib.shake_128(number.to_bytes(8, "little")).digest((50, 200, 1000, 20_000)[number % 4])


def open_store(disk: Disk, **options: object) -> SqliteStore:
    return SqliteStore.open(disk.directory / "node.db", node_id=7, draw_epoch=lambda: EPOCH, disk=disk, **options)  # type: ignore[arg-type]


def put(store: SqliteStore, count: int = 1) -> None:
    for _ in range(count):
        number = store.next_sequence()
        store.put(make_datum(DatumId(7, EPOCH, number), 1, 1.5, payload(number)))
        store.count("made")


def commit(store: SqliteStore) -> None:
    batch = some(store.take(force=True))
    store.write(batch)


def content(store: SqliteStore) -> tuple[frozenset[int], int]:
    """The numbers of the data that are stored, and how many have ever been made."""
    return frozenset(id.sequence for id in store.ids()), store.counters().get("made", 0)


def assert_intact(store: SqliteStore) -> None:
    for id in store.ids():
        datum = some(store.get(id))
        assert datum.payload == payload(id.sequence)


class Lives:
    """A store whose power is cut again and again, at any moment of a commit, an opening or a closing."""

    def __init__(self, disk: Disk, draw: Random, *, synchronous: bool = True) -> None:
        self.disk = disk
        self.synchronous = synchronous
        self.draw = draw
        self.possible: list[tuple[frozenset[int], int]] = [(frozenset(), 0)]
        """The last state that was acknowledged, and those that were to follow it."""
        self.failed = False
        """Whether the last life did not end in good order."""
        self.seen: Counter[str] = Counter()

    def live(self) -> None:
        """One life: the store is opened and used until the power goes, or closed before."""
        self.failed = True
        try:
            store = open_store(self.disk)
        except StoreError:
            return
        sync = Image.sync
        if not self.synchronous:
            Image.sync = lambda image: None  # type: ignore[assignment,method-assign]
        try:
            found = content(store)
            assert found in self.possible, store.report
            if found != self.possible[0]:
                self.seen["came through unacknowledged"] += 1
            elif len(self.possible) > 1:
                self.seen["was lost unacknowledged"] += 1
            assert store.report.set_aside is None
            assert_intact(store)
            self.possible = [found]
            for _ in range(self.draw.randrange(12)):
                for id in list(store.ids()):
                    if self.draw.random() < 1 / 3:
                        store.remove(id, Fate.PASSED_ON)
                if self.disk.full:
                    # What goes makes space for what comes.
                    self.possible.append((content(store)[0], found[1]))
                put(store, self.draw.randint(1, 5))
                self.possible.append(content(store))
                commit(store)
                self.seen["commits"] += 1
                self.possible = self.possible[-1:]
                found = self.possible[0]
            store.close()
            self.failed = False
        except StoreDamagedError:
            raise
        except StoreError:
            pass
        finally:
            Image.sync = sync  # type: ignore[method-assign]
            store.abandon()

    def cut(self) -> None:
        self.disk.restart()
        self.seen["cuts"] += 1


@pytest.mark.no_cover
@pytest.mark.parametrize("disks", extents(6, 300))
def test_what_was_acknowledged_is_there_after_a_cut_and_no_commit_in_part(disks: int) -> None:
    seen: Counter[str] = Counter()
    for seed in range(disks):
        with Disk(Random(seed)) as disk:
            lives = Lives(disk, Random(seed))
            for _ in range(60):
                disk.cut(after=lives.draw.randrange(150))
                lives.live()
                lives.cut()
            lives.live()
            seen += lives.seen
    assert seen["cuts"] == 60 * disks
    assert seen["commits"] > 60 * disks
    assert seen["came through unacknowledged"] > 0
    assert seen["was lost unacknowledged"] > 6 * disks


@pytest.mark.no_cover
def test_a_store_that_does_not_sync_loses_what_it_acknowledged() -> None:
    lost = 0
    for seed in range(20):
        with Disk(Random(seed)) as disk:
            lives = Lives(disk, Random(seed), synchronous=False)
            disk.cut(after=200)
            lives.live()
            lives.cut()
            try:
                lives.live()
            except AssertionError:
                lost += 1
    assert 5 < lost < 20


@pytest.mark.no_cover
@pytest.mark.parametrize("disks", extents(3, 200))
def test_faults_and_cuts_together_lose_nothing_either(disks: int) -> None:
    seen: Counter[str] = Counter()
    for seed in range(100, 100 + disks):
        with Disk(Random(seed)) as disk:
            lives = Lives(disk, Random(seed))
            for _ in range(100):
                disk.error_rate = lives.draw.choice((0.0, 0.0, 0.01, 0.1))
                disk.full = lives.draw.random() < 0.1
                disk.read_only = lives.draw.random() < 0.05
                if lives.draw.random() < 0.7:
                    disk.cut(after=lives.draw.randrange(150))
                lives.live()
                disk.full = disk.read_only = False
                disk.error_rate = 0.0
                if lives.failed:
                    lives.cut()
            disk.restart()
            lives.live()
            seen += lives.seen
    assert seen["commits"] > 60 * disks
    assert seen["cuts"] > 60 * disks


# -- power cuts --------------------------------------------------------------------------------------------------------


def test_unsynced_sectors_are_kept_or_lost_one_by_one() -> None:
    old, new = b"o" * 10 * SECTOR, b"n" * 5 * SECTOR
    seen: Counter[str] = Counter()
    for seed in range(300):
        image = Image(old)
        image.write(100, b"durable")
        image.sync()
        image.write(3 * SECTOR - 100, new)
        image.write(20 * SECTOR, b"last")
        image.lose(Random(seed))
        assert image.durable[: 3 * SECTOR - 100] == b"o" * 100 + b"durable" + b"o" * (3 * SECTOR - 207)
        pieces = [image.durable[start : start + SECTOR] for start in range(2 * SECTOR, 8 * SECTOR, SECTOR)]
        kinds = "".join("n" if set(piece[-100:]) == {ord("n")} else "o" for piece in pieces[:5])
        assert all(set(piece) <= set(b"on") for piece in pieces)
        assert all(len(set(piece)) == 1 for piece in pieces[1:5])
        assert image.durable[10 * SECTOR :] in (b"", bytes(10 * SECTOR) + b"last")
        last = len(image.durable) > 10 * SECTOR
        seen[{"ooooo": "nothing", "nnnnn": "all"}.get(kinds, "torn") + (" and the later write" if last else "")] += 1
    assert len(seen) == 6
    assert min(seen.values()) > 10


def test_truncations_are_kept_or_lost() -> None:
    found = set()
    for seed in range(50):
        image = Image(b"0123456789")
        image.truncate(5)
        image.write(7, b"x")
        image.lose(Random(seed))
        found.add(bytes(image.durable))
    assert found == {b"0123456789", b"01234", b"01234\0\0x", b"0123456x89"}


@pytest.mark.no_cover
def test_the_log_is_torn_and_reordered_and_read_as_far_as_it_is_whole() -> None:
    frame = FRAME_HEAD_BYTES + PAGE_BYTES
    seen: Counter[str] = Counter()
    for seed in range(60):
        logs = []
        for cut in (False, True):
            with Disk(Random(seed)) as disk:
                store = open_store(disk)
                put(store, 3)
                commit(store)
                log = disk.directory / "node.db-wal"
                before = log.stat().st_size
                for number in range(100, 120):
                    store.put(make_datum(DatumId(7, EPOCH, number), 1, 1.5, payload(4 * number + 2)))
                if cut:
                    # The sync that ends the commit is not reached.
                    disk.cut(after=2 * 20)
                    with pytest.raises(StoreError, match="disk I/O error"):
                        commit(store)
                    store.abandon()
                    disk.restart()
                    logs.append(log.read_bytes())
                    with open_store(disk) as store:
                        assert content(store) == (frozenset(range(3)), 3)
                        assert_intact(store)
                else:
                    commit(store)
                    logs.append(log.read_bytes())
                    store.close()
        whole, torn = logs
        kept = [whole[at : at + frame] == torn[at : at + frame] for at in range(before, len(torn), frame)]
        seen["nothing"] += not any(kept)
        seen["a later frame without an earlier one"] += any(a < b for a, b in pairwise(kept))
        for start in range(before + FRAME_HEAD_BYTES, len(torn) - PAGE_BYTES, frame):
            # No page lies in one sector.
            bound, end = -(-start // SECTOR) * SECTOR, start + PAGE_BYTES
            first, last = (whole[a:b] == torn[a:b] for a, b in ((start, bound), (bound, end)))
            seen["a torn page"] += first != last
    assert len(seen) == 3
    assert min(seen.values()) > 5


@pytest.mark.no_cover
def test_a_cut_while_a_store_is_made_leaves_none_or_a_whole_one() -> None:
    failed = 0
    for after in range(100):
        with Disk(Random(after)) as disk:
            disk.cut(after=after)
            try:
                open_store(disk).abandon()
            except StoreError:
                failed += 1
            disk.restart()
            with open_store(disk) as store:
                assert store.report.set_aside is None
                assert content(store) == (frozenset(), 0)
    assert 10 < failed < 90


def test_after_a_cut_nothing_more_is_written_until_the_restart() -> None:
    with Disk(Random(1)) as disk:
        store = open_store(disk)
        put(store)
        commit(store)
        disk.cut()
        assert disk.off
        files = {path: path.read_bytes() for path in disk.directory.iterdir()}
        put(store)
        with pytest.raises(StoreError, match="disk I/O error"):
            commit(store)
        store.abandon()
        with pytest.raises(StoreError, match="unable to open"):
            open_store(disk)
        files.pop(disk.directory / "node.db-shm")
        assert all(path.read_bytes() == content for path, content in files.items())
        disk.restart()
        assert not disk.off
        with open_store(disk) as store:
            assert content(store) == (frozenset({0}), 1)


@pytest.mark.no_cover
def test_the_index_of_the_log_is_gone_after_a_cut_and_a_deleted_log_may_be_back() -> None:
    back = 0
    for seed in range(20):
        with Disk(Random(seed)) as disk:
            store = open_store(disk)
            put(store, 5)
            store.close()
            log = disk.directory / "node.db-wal"
            assert not log.exists()
            disk.restart()
            assert not list(disk.directory.glob("*-shm"))
            back += log.exists()
            with open_store(disk) as store:
                assert content(store) == (frozenset(range(5)), 5)
                put(store)
                commit(store)
                disk.cut()
                store.abandon()
            disk.restart()
            with open_store(disk) as store:
                assert content(store) == (frozenset(range(6)), 6)
    assert 0 < back < 20


# -- faults ------------------------------------------------------------------------------------------------------------


def test_a_full_disk_refuses_what_grows_and_the_batch_is_kept() -> None:
    with Disk(Random(1)) as disk, open_store(disk) as store:
        put(store)
        commit(store)
        disk.full = True
        put(store, 8)
        with pytest.raises(StoreFullError, match="No space left"):
            commit(store)
        assert not store.accepting
        assert_intact(store)
        disk.full = False
        commit(store)
        assert store.accepting
        disk.cut()
        store.abandon()
        disk.restart()
        with open_store(disk) as again:
            assert content(again) == (frozenset(range(9)), 9)
            assert_intact(again)


def test_a_disk_that_cannot_be_written_any_more() -> None:
    with Disk(Random(1)) as disk:
        with open_store(disk) as store:
            put(store)
            commit(store)
            disk.read_only = True
            put(store)
            with pytest.raises(StoreError, match="disk I/O error"):
                commit(store)
            store.abandon()
        with open_store(disk) as store:
            put(store)
            with pytest.raises(StoreError, match="readonly database"):
                commit(store)
            store.abandon()
        disk.read_only = False
        with open_store(disk) as store:
            assert store.report == OpenReport()
            assert 0 in content(store)[0]
            put(store, 3)


def test_a_commit_that_fails_now_and_then_is_written_by_the_next() -> None:
    failures = 0
    with Disk(Random(3)) as disk, open_store(disk) as store:
        for _ in range(60):
            put(store)
            disk.error_rate = 0.03
            batch = some(store.take())
            try:
                store.write(batch)
            except (StoreDamagedError, StoreFullError):
                raise
            except StoreError:
                failures += 1
            disk.error_rate = 0.0
            assert_intact(store)
        put(store)
        commit(store)
        disk.cut()
        store.abandon()
        disk.restart()
        with open_store(disk) as again:
            assert content(again) == (frozenset(range(61)), 61)
            assert_intact(again)
    assert 10 < failures < 50


def test_a_store_made_on_a_failing_disk_is_whole_or_not_there() -> None:
    failures = 0
    for seed in range(100):
        with Disk(Random(seed)) as disk:
            disk.error_rate = 0.02
            try:
                store = open_store(disk)
            except StoreDamagedError:
                raise
            except StoreError:
                failures += 1
                continue
            disk.error_rate = 0.0
            put(store)
            commit(store)
            if seed % 2:
                disk.cut()
            store.abandon()
            disk.restart()
            with open_store(disk) as store:
                assert store.report == OpenReport()
                assert content(store) == (frozenset({0}), 1)
    assert 10 < failures < 90


@pytest.mark.no_cover
def test_a_page_that_the_disk_does_not_give_is_no_damage() -> None:
    failures = 0
    with Disk(Random(1)) as disk:
        store = open_store(disk)
        put(store, 40)
        commit(store)
        store.close()
        for _ in range(100):
            disk.error_rate = 0.01
            try:
                with open_store(disk) as store:
                    assert store.report == OpenReport()
            except StoreDamagedError:
                raise
            except StoreError:
                failures += 1
            disk.error_rate = 0.0
            with open_store(disk) as store:
                assert content(store) == (frozenset(range(40)), 40)
    assert 10 < failures < 90


@pytest.mark.parametrize("disks", extents(80, 5000))
def test_flipped_bits_end_in_a_store_set_aside_or_in_data_that_say_so(disks: int) -> None:
    seen: Counter[str] = Counter()
    for seed in range(disks):
        with Disk(Random(seed)) as disk:
            store = open_store(disk)
            for _ in range(4):
                put(store, 4)
                commit(store)
            if seed % 2:
                store.close()
            else:
                disk.cut()
                store.abandon()
                disk.restart()
            disk.flip_bits(disk.directory / ("node.db" if seed % 2 else "node.db-wal"), 1 + seed % 5)
            try:
                store = open_store(disk, check_limit=0 if seed % 4 > 1 else 1 << 30)
            except StoreError:
                # The version of the tables has grown.
                seen["refused"] += 1
                continue
            with store:
                made = content(store)[1]
                if store.report.set_aside is not None:
                    seen["set aside"] += 1
                    seen["salvaged"] += store.report.salvaged
                    assert_intact(store)
                    assert store.report.salvaged + store.report.lost >= 16
                elif seed % 2 == 0:
                    # A log that is not whole any more gives an earlier commit, and what stands behind it is salvaged.
                    seen["earlier" if made < 16 else "latest"] += 1
                    held = content(store)[0]
                    assert held >= frozenset(range(made))
                    assert len(held) + store.report.lost >= 16
                    assert made % 4 == 0
                    assert made == 16 or store.report.closed
                    assert_intact(store)
                else:
                    for id in store.ids():
                        try:
                            datum = store.get(id)
                        except StoreDamagedError:
                            seen["found late"] += 1
                            continue
                        assert datum is not None
                        seen["corrupted"] += not datum.intact
                        assert datum.payload == payload(id.sequence) or not datum.intact
    assert {"set aside", "earlier", "corrupted"} <= seen.keys()
    assert seen["refused"] < 5 + disks // 50


def test_flipped_bits_outlive_a_power_cut() -> None:
    with Disk(Random(1)) as disk:
        store = open_store(disk)
        put(store)
        commit(store)
        log = disk.directory / "node.db-wal"
        before = log.read_bytes()
        disk.flip_bits(log, 3)
        flipped = log.read_bytes()
        assert sum((a ^ b).bit_count() for a, b in zip(before, flipped, strict=True)) == 3
        # The commit that is lost makes the disk lay the file down anew.
        put(store, 8)
        disk.cut(after=3)
        with pytest.raises(StoreError):
            commit(store)
        store.abandon()
        disk.restart()
        assert log.read_bytes()[: len(flipped)] == flipped


# -- several, and the same again ---------------------------------------------------------------------------------------

HISTORY = """
import hashlib, sys
from random import Random
sys.path.insert(0, "tests/lab/swarm")
from test_disk import Disk, Lives

with Disk(Random(5)) as disk:
    lives = Lives(disk, Random(5))
    digest = hashlib.sha256()
    for _ in range(20):
        disk.cut(after=lives.draw.randrange(150))
        lives.live()
        lives.cut()
        for path in sorted(disk.directory.iterdir()):
            if path.suffix != ".lock":
                digest.update(path.name.encode() + path.read_bytes())
print(digest.hexdigest(), lives.seen["commits"] > 20)
"""


def test_the_same_seed_gives_the_same_bytes_in_any_process() -> None:
    said = {
        subprocess.run(
            [sys.executable, "-c", HISTORY],
            cwd=ROOT,
            env=environment(PYTHONHASHSEED=hash_seed),
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for hash_seed in ("1", "2")
    }
    assert len(said) == 1
    assert said.pop().endswith(" True\n")


def test_two_disks_do_not_touch_each_other() -> None:
    with Disk(Random(1)) as one, Disk(Random(1)) as other:
        assert one.vfs != other.vfs
        stores = [open_store(one), open_store(other)]
        for store in stores:
            put(store, 2)
            commit(store)
        one.full = True
        one.cut()
        put(stores[1])
        commit(stores[1])
        stores[0].abandon()
        one.restart()
        stores[1].close()
        with open_store(other) as store:
            assert content(store) == (frozenset(range(3)), 3)
        with open_store(one) as store:
            assert content(store) == (frozenset(range(2)), 2)


def test_files_must_be_closed_before_the_power_comes_back_or_the_disk_goes() -> None:
    disk = Disk(Random(1))
    store = open_store(disk)
    for end in (disk.restart, disk.close):
        with pytest.raises(RuntimeError, match="still open"):
            end()
    store.close()
    disk.close()
    assert not disk.directory.exists()


def test_a_disk_that_is_gone_is_no_reason_to_set_a_store_aside(tmp_path: Path) -> None:
    path = tmp_path / "node.db"
    SqliteStore.open(path, node_id=7, draw_epoch=lambda: EPOCH).close()
    with Disk(Random(1)) as disk:
        pass
    with pytest.raises(StoreError, match="no such vfs"):
        SqliteStore.open(path, node_id=7, draw_epoch=lambda: EPOCH, disk=disk)
    assert not list(tmp_path.glob("*damaged*"))


def test_a_library_that_is_not_the_one_of_sqlite3_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be reached"):
        load(str(tmp_path / "none.so"))
    with pytest.raises(StoreError, match="cannot be reached"):
        load(sys.modules["_hashlib"].__file__)
    mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()}
    libraries = [path for path in mapped if os.path.basename(path).startswith("libsqlite3")]
    if not libraries:
        pytest.skip("SQLite is built into the interpreter")
    with pytest.raises(StoreError, match="not the one"):
        load(str(shutil.copy(libraries[0], tmp_path / "copy.so")))
