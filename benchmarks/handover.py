"""Durable hand-overs a second between two nodes on SQLite, and how often each of them syncs its disk for them.

    python -m benchmarks.handover            a table
    python -m benchmarks.handover --json     one JSON object

A drone holds many data on its disk and hands them over to a base: two real drivers on one event loop, joined by a
loopback link. A hand-over is complete when the base has the datum on disk and has confirmed it, and the drone has
recorded the confirmation. The clock runs from the first step to the last such record. Bandwidth limits the rate to
`BANDWIDTH / STEP_S` a second.

With keys the frames are signed, data are sealed, answers tagged, and the base opens each datum. Receipts are off.

Syncs of the disk are counted if the system has `strace`. One more run under strace counts every fsync and fdatasync by
its file, from opening the two stores to closing them, checkpoints included. The data are put into the drone's store
before that.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import re
import shutil
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

from benchmarks.tables import ratios, spread, table

if TYPE_CHECKING:
    from rass_mav.trust.trust import Trust

SIDES = {"drone": 1, "base": 2}
STEP_S = 0.05
PAYLOAD_BYTES = 60
#: Data that may leave in a step: more than a step has time for, but fewer frames than a link queues.
BANDWIDTH = 240
GIVE_UP_S = 120.0
KINDS = ("without keys", "with keys")
_SYNC = re.compile(r"\b(?:fsync|fdatasync)\(\d+<[^>]*/(drone|base)\.db")


def _agent_settings(side: str) -> Any:
    from rass_mav.app.config import NodeSection, RunConfig, RunDataSettings, RunStoreSettings

    config = RunConfig(
        node=NodeSection(id=SIDES[side], role="base" if side == "base" else "drone", step_s=STEP_S),
        store=RunStoreSettings(capacity_items=None, bandwidth_items=BANDWIDTH),
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


async def _hand_over(directory: Path, trusts: dict[str, Trust]) -> dict[str, float]:
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
                    _agent_settings(side), stores[side], random.Random(SIDES[side]), now=clock.now(),
                    observer=watch if side == "drone" else None, newborn=True, keys=trusts.get(side),
                )  # fmt: skip
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
    return {"per_s": count / seconds, "cpu_us": spent / count * 1e6, "sent": sent / count}


def hand_over(directory: Path, trusts: dict[str, Trust] | None = None) -> dict[str, float]:
    """Hand over everything in the drone's store in `directory`. Figures are for one datum, except `per_s`.

    `trusts`: what its keys do for each side; None: there are no keys.
    """
    return asyncio.run(_hand_over(directory, trusts or {}))


def trusts_of(directory: Path) -> dict[str, Trust]:
    """What their keys do for the two nodes. The drone's data are sealed."""
    from rass_mav.core.datum import make_datum
    from rass_mav.core.seals import SEALED
    from rass_mav.trust.keys.identity import Ground
    from rass_mav.trust.keys.keyring import Keyring
    from rass_mav.trust.keys.sealing import Sealer
    from rass_mav.trust.keys.secret import Secret
    from rass_mav.trust.trust import trust_of

    drone, base = SIDES["drone"], SIDES["base"]
    ground = Ground(Secret(bytes(range(32))), serials={drone: 1})
    keyrings = {"drone": Keyring(ground.node(drone, 1), None), "base": Keyring(ground.node(base), ground)}
    with opened(directory, "drone") as store:
        sealer = Sealer(keyrings["drone"].own, store.epoch, 0)
        for id in sorted(store.ids()):
            datum = store.get(id)
            assert datum is not None
            sealed = sealer.seal(id.sequence, 0, datum.payload)
            store.put(make_datum(id, SEALED, datum.created, sealed))
    return {side: trust_of(keyring, random.Random(side)) for side, keyring in keyrings.items()}


def _traced(directory: Path) -> dict[str, list[float]]:
    """Syncs per datum on each side, counted by strace."""
    trace = directory / "trace"
    strace = ["strace", "-f", "--seccomp-bpf", "-y", "-qq", "-e", "trace=fsync,fdatasync", "-o", str(trace)]
    python = [sys.executable, "-m", "benchmarks.handover", "--traced", str(directory)]
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([*strace, *python], cwd=root, check=True, capture_output=True, text=True)
    count = json.loads(done.stdout)
    syncs = Counter(_SYNC.findall(trace.read_text()))
    return {f"fsyncs_{side}": [round(syncs[side] / count, 4)] for side in SIDES}


def measure(rounds: int, data: int, directory: Path | None = None) -> dict[str, dict[str, list[float]]]:
    """Figures of each round, without keys and with them. The two take turns.

    `directory` decides which disk is measured (None: that of the temporary files).
    """
    results: dict[str, dict[str, list[float]]] = {kind: {} for kind in KINDS}
    for _ in range(rounds):
        for kind, figures in results.items():
            with tempfile.TemporaryDirectory(dir=directory) as name:
                fill(Path(name), data)
                one = hand_over(Path(name), trusts_of(Path(name)) if kind == "with keys" else None)
            for key, value in one.items():
                figures.setdefault(key, []).append(round(value, 4))
    if shutil.which("strace"):
        with tempfile.TemporaryDirectory(dir=directory) as name:
            fill(Path(name), data)
            results["without keys"].update(_traced(Path(name)))
    return results


#: Key of the result -> how it is shown, and the digits after the point.
_LINES = {
    "per_s": ("hand-overs a second", 0),
    "cpu_us": ("processor time of one, both nodes, us", 0),
    "sent": ("transmissions a datum", 3),
}
_SYNCS = {"fsyncs_drone": "disk syncs a datum, drone (one run)", "fsyncs_base": "disk syncs a datum, base (one run)"}


def show(results: dict[str, dict[str, list[float]]]) -> str:
    """The table."""
    open_, keys = results.values()
    rows = [
        [name, spread(open_[key], digits), spread(keys[key], digits), spread(ratios(keys[key], open_[key]), 2)]
        for key, (name, digits) in _LINES.items()
    ]
    rows += [[name, f"{open_[key][0]:.4f}", "", ""] for key, name in _SYNCS.items() if key in open_]
    return table(["", *KINDS, "ratio"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="bulks handed over (default: 5)")
    parser.add_argument("--data", type=int, default=2000, help="data in a bulk (default: 2000)")
    parser.add_argument("--directory", type=Path, help="where the databases are made (default: temporary files)")
    parser.add_argument("--traced", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.traced:
        with opened(options.traced, "drone") as store:
            count = len(list(store.ids()))
        hand_over(options.traced)
        print(count)
        return
    result = measure(options.rounds, options.data, options.directory)
    print(json.dumps(result) if options.json else show(result))


if __name__ == "__main__":
    main()
