"""How much commits in groups gain, and what a datum costs in each of the two stores.

    python benchmarks/store.py [--directory DIR] [--seconds S]

`DIR` determines which disk is measured. The absolute figures say more about the disk than about the program, so look at
the ratios: a commit costs one fsync, two with large data, however many data it contains.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.core.store import Store
from rass_mav.store import MemoryStore, SqliteStore

PAYLOAD = os.urandom(100)


def new_datum(store: Store, payload: bytes = PAYLOAD) -> Datum:
    """A datum created by the node that owns the store."""
    return make_datum(DatumId(1, store.epoch, store.next_sequence()), 1, 0.0, payload)


def written() -> int:
    """The bytes that this process has written with system calls."""
    counts = dict(line.split(": ") for line in Path("/proc/self/io").read_text(encoding="ascii").splitlines())
    return int(counts["wchar"])


def parts(directory: Path, size: int, group: int, seconds: float) -> tuple[float, float]:
    """Store parts, `group` of them a commit, and remove each 64 parts later; from opening to closing. Returns bytes
    written for each byte stored, and milliseconds a commit."""
    before, commits, held = written(), 0, list[DatumId]()
    with SqliteStore.open(directory / f"{size}-{group}.db", node_id=7, draw_epoch=lambda: 1) as store:
        begin = time.perf_counter()
        while (spent := time.perf_counter() - begin) < seconds:
            for _ in range(group):
                datum = new_datum(store, os.urandom(size))
                store.put(datum)
                held.append(datum.id)
            for id in held[:-64]:
                store.remove(id, Fate.PASSED_ON)
            del held[:-64]
            store.write(store.take())
            commits += 1
    return (written() - before) / (commits * group * size), 1000 * spent / commits


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
        SqliteStore.open(Path(directory) / "node.db", node_id=7, draw_epoch=lambda: 1) as store,
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
    print("parts                   bytes written a byte  ms a commit")
    with tempfile.TemporaryDirectory(dir=options.directory) as directory:
        for size in (16 << 10, 32 << 10, 64 << 10):
            for group in (1, 4, 8):
                ratio, each = parts(Path(directory), size, group, options.seconds)
                print(f"{size >> 10} KiB, {group} a commit       {ratio:>10.2f} {each:>12.1f}")


if __name__ == "__main__":
    main()
