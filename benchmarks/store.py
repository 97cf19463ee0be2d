"""How many bytes the store writes to its disk for each byte of a datum, and how long a commit takes.

    python -m benchmarks.store [--directory DIR] [--json]

`DIR` determines which disk is measured. Data have random payloads, so they do not compress. Those of 100 bytes are
removed 100 data later, the parts of large data 64 parts later. Bytes are those of all write calls, from opening the
store to closing it: the log and checkpoints are included, the file system's own journal is not. Each row has stores of
its own.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from benchmarks.tables import spread, table
from rass_mav.core.datum import DatumId, Fate, make_datum
from rass_mav.store.sqlite import SqliteStore

#: Bytes of a datum, data in a commit, and after how many data one is removed.
CASES = [
    (100, 1, 100),
    (100, 10, 100),
    (100, 100, 100),
    *((kib << 10, group, 64) for kib in (16, 64) for group in (1, 8)),
]
#: Stores of each row, and commits in each.
ROUNDS, COMMITS = 3, 150


def written() -> int:
    """The bytes that this process has written with system calls."""
    counts = dict(line.split(": ") for line in Path("/proc/self/io").read_text(encoding="ascii").splitlines())
    return int(counts["wchar"])


def run(path: Path, size: int, group: int, lag: int) -> tuple[float, list[float]]:
    """A new store. Returns the bytes written for each byte of a datum, and the milliseconds of each commit."""
    held: list[DatumId] = []
    times = []
    before = written()
    # As large as epochs that are drawn: small numbers take fewer bytes.
    with SqliteStore.open(path, node_id=7, draw_epoch=count(0xFEDC0001).__next__) as store:
        for _ in range(COMMITS):
            begin = time.perf_counter()
            for _ in range(group):
                datum = make_datum(DatumId(1, store.epoch, store.next_sequence()), 1, 0.0, os.urandom(size))
                store.put(datum)
                held.append(datum.id)
            for id in held[:-lag]:
                store.remove(id, Fate.PASSED_ON)
            del held[:-lag]
            store.write(store.take())
            times.append(round(1000 * (time.perf_counter() - begin), 3))
    return (written() - before) / (COMMITS * group * size), times


def measure(directory: Path | None = None) -> dict[str, dict[str, list[float]]]:
    """By row: bytes written a byte of each store, and milliseconds of each commit."""
    found: dict[str, dict[str, list[float]]] = {}
    for size, group, lag in CASES:
        one: dict[str, list[float]] = {"bytes": [], "ms": []}
        for _ in range(ROUNDS):
            with tempfile.TemporaryDirectory(dir=directory) as name:
                ratio, times = run(Path(name) / "node.db", size, group, lag)
            one["bytes"].append(round(ratio, 3))
            one["ms"] += times
        found[f"{size >> 10} KiB, {group} a commit" if size >= 1024 else f"{size} bytes, {group} a commit"] = one
    return found


def show(results: dict[str, dict[str, list[float]]]) -> str:
    """The table."""
    rows = [[name, spread(one["bytes"], 2), spread(one["ms"], 2)] for name, one in results.items()]
    return table(["data", "bytes written a byte", "a commit, ms"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--directory", type=Path, help="where the stores are made (default: temporary files)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    results = measure(options.directory)
    print(json.dumps(results) if options.json else show(results))


if __name__ == "__main__":
    main()
