"""How long a base with many data takes to start, and how much memory they cost it.

    python -m benchmarks.base [--data N] [--json]

The store's data are measurements of 100 drones. Each start is a process of its own. The store has just been
written, so it is read from memory.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.tables import spread, table
from rass_mav.app.config import NodeSection, RunConfig
from rass_mav.core.datum import DatumId, Kind, make_datum
from rass_mav.station.node import build_node
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire.measurement import Measurement, encode_measurement

DATA, DRONES = 300_000, 100
#: Starts of each.
ROUNDS = 5
#: Data that are written in one commit.
_COMMIT = 5000


def opened(path: Path) -> SqliteStore:
    """The base's store."""
    return SqliteStore.open(path, node_id=1, draw_epoch=lambda: random.getrandbits(32))


def fill(path: Path, data: int) -> None:
    """Write a base's store with so many data."""
    payload = encode_measurement(Measurement(47.0, 8.0, 400.0, 1.0, 0.5, unit="usvh", error_m=2.0))
    with opened(path) as store:
        for number in range(data):
            drone = 2 + number % DRONES
            store.put(make_datum(DatumId(drone, drone, number // DRONES), Kind.MEASUREMENT, float(number), payload))
            if number % _COMMIT == _COMMIT - 1 and (batch := store.take(force=True)) is not None:
                store.write(batch)


def start(path: Path) -> tuple[float, float]:
    """Start a base on a store. Returns the processor time, seconds, and the memory (RSS) that is resident then, MiB."""
    settings = RunConfig(node=NodeSection(id=1, role="base")).agent_settings()
    begin = time.process_time()
    with opened(path) as store:
        build_node(settings, store, random.Random(1), now=1e6, forgiving=True).step(1e6)
        spent = time.process_time() - begin
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return spent, pages * 4096 / (1 << 20)


def measure(data: int) -> dict[str, dict[str, list[float]]]:
    """A base with so many data, and an empty one: `start_s` and `rss` of each start."""
    found: dict[str, dict[str, list[float]]] = {}
    with tempfile.TemporaryDirectory(prefix="rass-mav-") as folder:
        for number in (0, data):
            path = Path(folder) / f"{number}.db"
            fill(path, number)
            runs = []
            for _ in range(ROUNDS):
                with ProcessPoolExecutor(1, get_context("spawn")) as process:
                    runs.append(process.submit(start, path).result())
            spent, mib = zip(*runs, strict=True)
            found[f"{number:,}"] = {"start_s": [round(s, 3) for s in spent], "rss": [round(m, 1) for m in mib]}
    return found


def show(results: dict[str, dict[str, list[float]]]) -> str:
    """The table. The process that starts a base has more in its memory, so only the difference counts."""
    empty, *_ = results.values()
    rows = [
        [
            data,
            spread(one["start_s"], 2),
            spread([mib - base for mib, base in zip(one["rss"], empty["rss"], strict=True)], 1),
        ]
        for data, one in results.items()
    ]
    return table(["data", "processor time of a start, s", "RSS more than the empty one, MiB"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=int, default=DATA, help=f"how many data the store has ({DATA:,})")
    parser.add_argument("--json", action="store_true", help="print a JSON object")
    options = parser.parse_args(arguments)
    found = measure(options.data)
    print(json.dumps(found) if options.json else show(found))


if __name__ == "__main__":
    main()
