"""Durable hand-overs a second between two nodes on SQLite, and how often each of them syncs its disk for them.

    python -m benchmarks.handover            a table
    python -m benchmarks.handover --json     one JSON object

A drone holds many data on its disk and hands them over to a base: two real drivers on one event loop, joined by a
loopback link. A hand-over is complete when the base has the datum on disk and has confirmed it, and the drone has
recorded the confirmation. The clock runs from the first step to the last such record. Bandwidth limits the rate to
`BANDWIDTH / STEP_S` a second.

The syncs of the disk are counted in two ways. `commits` is the drivers' own count: one commit syncs the write-ahead log
once. `fsyncs` is the true count, if the system has `strace`. One more run under strace counts every fsync and fdatasync
by its file, from opening the two stores to closing them, checkpoints included. The data are put into the drone's store
before that.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rass_mav.trust.trust import Trust

SIDES = {"drone": 1, "base": 2}
STEP_S = 0.01
PAYLOAD_BYTES = 60
#: Data that may leave in a step: more than a step has time for, but fewer frames than a link queues.
BANDWIDTH = 100
GIVE_UP_S = 120.0
#: How many held data the drone verifies in a step. The default is all of them, which costs a read of each.
SCRUBS = {"scrub all": None, "scrub 50": 50}
_SYNC = re.compile(r"\b(?:fsync|fdatasync)\(\d+<[^>]*/(drone|base)\.db")


def _agent_settings(side: str, scrub_items: int | None) -> Any:
    from rass_mav.app.config import NodeSection, RunConfig, RunDataSettings, RunStoreSettings

    config = RunConfig(
        node=NodeSection(id=SIDES[side], role="base" if side == "base" else "drone", step_s=STEP_S),
        store=RunStoreSettings(capacity_items=None, bandwidth_items=BANDWIDTH, scrub_items=scrub_items),
        data=RunDataSettings(interval_steps=0, status_s=0.0),
    )
    return replace(config.agent_settings(), without=("receipts",))


def opened(directory: Path, side: str) -> Any:
    """The store of a side."""
    from rass_mav.store.sqlite import SqliteStore

    return SqliteStore.open(directory / f"{side}.db", node_id=7, draw_epoch=lambda: SIDES[side])


def fill(directory: Path, count: int) -> None:
    """Put `count` new data into the drone's store."""
    from rass_mav.core.datum import DatumId, make_datum

    with opened(directory, "drone") as store:
        generator = random.Random(1)
        for _ in range(count):
            id = DatumId(SIDES["drone"], store.epoch, store.next_sequence())
            store.put(make_datum(id, 0, 0.0, generator.randbytes(PAYLOAD_BYTES)))


async def _hand_over(directory: Path, scrub_items: int | None, trusts: dict[str, Trust]) -> dict[str, float]:
    from rass_mav.app.clock import Clock
    from rass_mav.app.driver import Driver
    from rass_mav.core.datum import DatumId, Fate
    from rass_mav.core.observer import Observer
    from rass_mav.station.node import build_node
    from tests.link.loopback import LoopbackHub

    done = asyncio.Event()

    class Watch(Observer):
        def __init__(self) -> None:
            self.left = 0

        def dropped(self, id: DatumId, fate: Fate) -> None:
            if fate is not Fate.PASSED_ON:
                raise RuntimeError(f"{id} was {fate.value}")
            self.left -= 1
            if not self.left:
                done.set()

    clock, hub, watch = Clock(), LoopbackHub(), Watch()
    links = {side: hub.endpoint(side) for side in SIDES}
    hub.connect(*links.values())
    with opened(directory, "drone") as drone, opened(directory, "base") as base:
        stores = {"drone": drone, "base": base}
        with ThreadPoolExecutor(1, "drone") as first, ThreadPoolExecutor(1, "base") as second:
            drivers = {}
            for (side, link), executor in zip(links.items(), (first, second), strict=True):
                agent = build_node(
                    _agent_settings(side, scrub_items), stores[side], random.Random(SIDES[side]), now=clock.now(),
                    observer=watch if side == "drone" else None, newborn=True, keys=trusts.get(side),
                )  # fmt: skip
                # An answer waits for the other's disk, so it counts as missing only after a second: half a turn.
                agent.node.pace.turn_s = 2.0
                drivers[side] = Driver(agent, [link], None, clock.now, executor)
            held = drivers["drone"].agent.node.holdings.custody
            count = watch.left = len(held)
            spent = time.process_time()
            begin = time.perf_counter()
            runs = [asyncio.create_task(driver.run()) for driver in drivers.values()]
            finished = asyncio.create_task(done.wait())
            await asyncio.wait([*runs, finished], timeout=GIVE_UP_S, return_when=asyncio.FIRST_COMPLETED)
            seconds = time.perf_counter() - begin
            spent = time.process_time() - spent
            for driver in drivers.values():
                driver.stop()
            await asyncio.gather(*runs)
            if watch.left:
                raise RuntimeError(f"{watch.left} of {count} data were not handed over")
            sent = drivers["drone"].agent.node.pace.sent
    return {
        "per_s": count / seconds,
        "cpu_us": spent / count * 1e6,
        "sent": sent / count,
        **{f"commits_{side}": driver.writer.gate.commits / count for side, driver in drivers.items()},
    }


def hand_over(directory: Path, scrub_items: int | None, trusts: dict[str, Trust] | None = None) -> dict[str, float]:
    """Hand over everything in the drone's store in `directory`. Figures are for one datum, except `per_s`.

    `trusts`: what its keys do for each side; None: there are no keys.
    """
    return asyncio.run(_hand_over(directory, scrub_items, trusts or {}))


def sync_seconds(directory: Path, rounds: int = 50) -> float:
    """Seconds that one small append and fsync take on this disk, median."""
    times = []
    with (directory / "sync").open("wb", buffering=0) as file:
        for _ in range(rounds):
            begin = time.perf_counter()
            file.write(bytes(4096))
            os.fsync(file.fileno())
            times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _traced(directory: Path, scrub_items: int | None) -> dict[str, float]:
    """Syncs per datum on each side, counted by strace."""
    trace = directory / "trace"
    strace = ["strace", "-f", "--seccomp-bpf", "-y", "-qq", "-e", "trace=fsync,fdatasync", "-o", str(trace)]
    python = [sys.executable, "-m", "benchmarks.handover", "--traced", str(directory), "--scrub", str(scrub_items or 0)]
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([*strace, *python], cwd=root, check=True, capture_output=True, text=True)
    count = json.loads(done.stdout)
    syncs = Counter(_SYNC.findall(trace.read_text()))
    return {f"fsyncs_{side}": syncs[side] / count for side in SIDES}


def measure(rounds: int, data: int, directory: Path | None = None) -> dict[str, dict[str, float]]:
    """For each value of `store.scrub_items`, medians over the rounds.

    `directory` decides which disk is measured (None: that of the temporary files).
    """
    return {name: _measure(rounds, data, directory, items) for name, items in SCRUBS.items()}


def _measure(rounds: int, data: int, directory: Path | None, scrub_items: int | None) -> dict[str, float]:
    results = []
    syncs: dict[str, float] = {}
    for turn in range(rounds + 1):
        with tempfile.TemporaryDirectory(dir=directory) as name:
            fill(Path(name), data)
            if turn < rounds:
                sync_s = sync_seconds(Path(name))
                one = hand_over(Path(name), scrub_items)
                results.append({**one, "sync_ms": sync_s * 1e3, "per_sync_time": one["per_s"] * sync_s})
            elif shutil.which("strace"):
                syncs = _traced(Path(name), scrub_items)
    medians = {key: statistics.median(one[key] for one in results) for key in results[0]}
    return {key: round(value, 4) for key, value in {**medians, **syncs}.items()}


#: Key of the result -> how it is shown.
_LINES = {
    "per_s": "hand-overs a second",
    "sync_ms": "one sync of this disk, ms",
    "per_sync_time": "hand-overs in the time of one sync",
    "cpu_us": "processor time a datum, both nodes, us",
    "sent": "transmissions a datum",
    "commits_drone": "commits a datum, drone",
    "commits_base": "commits a datum, base",
    "fsyncs_drone": "fsyncs a datum, drone",
    "fsyncs_base": "fsyncs a datum, base",
}


def show(results: dict[str, dict[str, float]]) -> None:
    """Print the table."""
    print(f"{'hand-over on SQLite':<42}" + "".join(f"{name:>14}" for name in results))
    for key, line in _LINES.items():
        if all(key in result for result in results.values()):
            print(f"  {line:<40}" + "".join(f"{result[key]:>14.4g}" for result in results.values()))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="bulks handed over (default: 5)")
    parser.add_argument("--data", type=int, default=2000, help="data in a bulk (default: 2000)")
    parser.add_argument("--directory", type=Path, help="where the databases are made (default: temporary files)")
    parser.add_argument("--traced", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--scrub", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.traced:
        with opened(options.traced, "drone") as store:
            count = len(list(store.ids()))
        hand_over(options.traced, options.scrub or None)
        print(count)
        return
    result = measure(options.rounds, options.data, options.directory)
    if options.json:
        print(json.dumps(result))
    else:
        show(result)


if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    main()
