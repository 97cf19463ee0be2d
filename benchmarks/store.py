"""How much commits in groups gain, what a datum costs in each of the two stores, and how much is written to the disk.

    python benchmarks/store.py [--directory DIR] [--seconds S]

`DIR` determines which disk is measured. The absolute figures say more about the disk than about the program, so look at
the ratios: a commit costs one fsync, two with large data, however many data it contains. The last table compares with
stores that have the pages of earlier versions, in turns.
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from itertools import count
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.store import Store
from rass_mav.store.memory import MemoryStore
from rass_mav.store.schema import PAGE_BYTES
from rass_mav.store.sqlite import SqliteStore

#: Of the first stores with tables of version 3.
EARLIER_PAGE_BYTES = 4096
PAYLOAD = os.urandom(100)


def opened(path: Path) -> SqliteStore:
    """A store with an epoch as large as those that are drawn: small numbers take fewer bytes."""
    return SqliteStore.open(path, node_id=7, draw_epoch=count(0xFEDC0001).__next__)


def new_datum(store: Store, payload: bytes = PAYLOAD) -> Datum:
    """A datum created by the node that owns the store."""
    return make_datum(DatumId(1, store.epoch, store.next_sequence()), 1, 0.0, payload)


def written() -> int:
    """The bytes that this process has written with system calls."""
    counts = dict(line.split(": ") for line in Path("/proc/self/io").read_text(encoding="ascii").splitlines())
    return int(counts["wchar"])


class Series:
    """Data of one size that come, `group` of them a commit, and go again `lag` data later."""

    def __init__(self, path: Path, page_bytes: int, size: int, group: int, lag: int) -> None:
        """`page_bytes`: of the store, as this version or an earlier one creates it."""
        opened(path).close()
        with closing(sqlite3.connect(path, isolation_level=None)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE").fetchall()
            connection.execute(f"PRAGMA page_size = {page_bytes}")
            connection.execute("VACUUM")
            connection.execute("PRAGMA journal_mode = WAL").fetchall()
        self._size, self._group, self._lag = size, group, lag
        self._commits = 0
        self._held: list[DatumId] = []
        self._written = -written()
        self._store = opened(path)
        self._written += written()

    def turn(self, commits: int) -> float:
        """So many commits. Returns the milliseconds of one."""
        self._written -= written()
        begin = time.perf_counter()
        for _ in range(commits):
            for _ in range(self._group):
                datum = new_datum(self._store, os.urandom(self._size))
                self._store.put(datum)
                self._held.append(datum.id)
            for id in self._held[: -self._lag]:
                self._store.remove(id, Fate.PASSED_ON)
            del self._held[: -self._lag]
            self._store.write(self._store.take())
        spent = time.perf_counter() - begin
        self._written += written()
        self._commits += commits
        return 1000 * spent / commits

    def close(self) -> float:
        """Returns the bytes written for each byte stored, from opening to closing."""
        self._written -= written()
        self._store.close()
        self._written += written()
        return self._written / (self._commits * self._group * self._size)


def compare(directory: Path, size: int, group: int, lag: int, seconds: float) -> str:
    """A store and one with the pages of earlier versions, in turns: a row of the table."""
    now, before = (
        Series(directory / f"{page_bytes}-{size}-{group}.db", page_bytes, size, group, lag)
        for page_bytes in (PAGE_BYTES, EARLIER_PAGE_BYTES)
    )
    times = []
    end = time.perf_counter() + 2 * seconds
    while time.perf_counter() < end:
        # Either is first half of the time.
        first = now.turn(5)
        second, third = before.turn(5), before.turn(5)
        times += [(first, second), (now.turn(5), third)]
    each = statistics.median(time for time, _ in times)
    ratio = statistics.median(time / other for time, other in times)
    return f"{now.close():>10.2f} {before.close():>8.2f} {each:>10.2f} {ratio:>8.2f}"


def rate(work: Callable[[], int], seconds: float) -> float:
    """Data a second that `work` processes; it returns how many it processed."""
    done = 0
    begin = time.perf_counter()
    while (spent := time.perf_counter() - begin) < seconds:
        done += work()
    return done / spent


def in_groups(store: Store, group: int) -> Callable[[], int]:
    """Put `group` data, remove those of the previous group, and make all of this durable."""
    before: list[DatumId] = []

    def work() -> int:
        for id in before:
            store.remove(id, Fate.PASSED_ON)
        before.clear()
        for _ in range(group):
            datum = new_datum(store)
            store.put(datum)
            before.append(datum.id)
        batch = store.take()
        if batch is not None:
            store.write(batch)
        return group

    return work


def reads(store: Store) -> Callable[[], int]:
    """Get all stored data."""
    ids = list(store.ids())

    def work() -> int:
        for id in ids:
            store.get(id)
        return len(ids)

    return work


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure the stores of rass_mav.")
    parser.add_argument("--directory", type=Path, help="where the database is made (default: the temporary directory)")
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each figure (default 2)")
    options = parser.parse_args()
    print("put, commit and remove, 100 bytes each     data/s    ratio")
    first = 0.0
    with (
        tempfile.TemporaryDirectory(dir=options.directory) as directory,
        opened(Path(directory) / "node.db") as store,
    ):
        for group in (1, 10, 100):
            speed = rate(in_groups(store, group), options.seconds)
            first = first or speed
            print(f"SQLite, durable in groups of {group:>3}         {speed:>10.0f} {speed / first:>8.1f}")
        speed = rate(in_groups(MemoryStore(1), 100), options.seconds)
        print(f"memory, in groups of 100                 {speed:>10.0f} {speed / first:>8.1f}")
        targets: list[tuple[str, Store]] = [("SQLite", store), ("memory", MemoryStore(1))]
        for name, target in targets:
            for _ in range(1000):
                target.put(new_datum(target))
            batch = target.take()
            if batch is not None:
                target.write(batch)
            speed = rate(reads(target), options.seconds)
            print(f"{name}, get                              {speed:>10.0f} {speed / first:>8.1f}")
    print("                        bytes written a byte    ms a commit")
    print("                       now  4 KiB pages        now    ratio")
    with tempfile.TemporaryDirectory(dir=options.directory) as directory:
        for size, lag, groups in ((100, 100, (1, 10, 100)), *((kib << 10, 64, (1, 4, 8)) for kib in (16, 32, 64))):
            for group in groups:
                row = compare(Path(directory), size, group, lag, options.seconds)
                print(f"{size:>6} bytes, {group:>3} a commit {row}")


if __name__ == "__main__":
    main()
