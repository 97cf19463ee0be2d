"""What the data that a drone holds cost it: memory for each 1,000, and processor time in each step.

    python -m benchmarks.held [--data N ...] [--json]

A drone with the product's own settings has a store on a disk, and N measurements of its own in custody. Each row is a
process of its own. Memory is resident memory (RSS), from what the drone has with 20,000 data on. Processor time
is what the drone spends in a step and on all messages that it hears in it:

- alone: nobody is heard.
- island: three drones are heard, and no base. They keep replicas.
- base: a base is heard. The drone hands its data over, and hears receipts and summaries.
"""

from __future__ import annotations

import argparse
import gc
import json
import random
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.tables import spread, table
from rass_mav.app.config import NodeSection, RunConfig, RunStoreSettings
from rass_mav.core.datum import DatumId, Kind, make_datum
from rass_mav.core.messages import BROADCAST, Data, Handover, Message
from rass_mav.core.node import Node
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore
from rass_mav.store.sqlite import SqliteStore
from rass_mav.wire.measurement import Measurement, encode_measurement

DATA = (1_000, 10_000, 50_000)
#: Of memory.
ROUNDS = 3
#: Data that memory is measured with: as many replicas as a drone keeps at most.
SPARES = 4_000
#: The memory of so many data is not counted: the first ones fill what the start has left free.
FEW = 20_000
#: More than are held here.
MOST = 1_000_000
SITUATIONS = ("alone", "island", "base")
WARM_UP, STEPS = 20, 60
#: Data that are written in one commit.
_COMMIT = 1_000
_PAYLOAD = encode_measurement(Measurement(47.0, 8.0, 400.0, 1.0, 0.5, unit="usvh", error_m=2.0))


def node_of(id: int, store: Any, *, base: bool = False) -> Node:
    """A node with the product's own settings, which has always existed."""
    config = RunConfig(
        node=NodeSection(id=id, role="base" if base else "drone"), store=RunStoreSettings(capacity_items=MOST)
    )
    settings = config.agent_settings()
    node = build_node(settings, store, random.Random(id), now=0.0, newborn=True).node
    assert isinstance(node, Node)
    node.risk.observe(0.01, 0.0)
    return node


def opened(path: Path) -> SqliteStore:
    """The drone's store."""
    return SqliteStore.open(path, node_id=1, draw_epoch=lambda: random.getrandbits(32))


def commit(store: SqliteStore) -> None:
    """Make durable what has changed."""
    if (batch := store.take(force=True)) is not None:
        store.write(batch)


def fill(node: Node, store: SqliteStore, data: int, *, replicas: bool = False) -> None:
    """So many measurements of the node's own, or replicas of a neighbour's."""
    for number in range(data):
        if replicas:
            datum = make_datum(DatumId(2, 2, number), Kind.MEASUREMENT, float(number), _PAYLOAD)
            node.receive(Data(2, node.id, (Handover(number + 1, datum),), True), 0.0)
        else:
            node.put(_PAYLOAD, float(number), Kind.MEASUREMENT)
        if number % _COMMIT == _COMMIT - 1:
            commit(store)
    commit(store)


def resident() -> int:
    """Bytes."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096


def memory(data: int, replicas: bool) -> float:
    """KiB that 1,000 of so many data take."""
    with tempfile.TemporaryDirectory(prefix="rass-mav-") as folder, opened(Path(folder) / "drone.db") as store:
        node = node_of(1, store)
        fill(node, store, FEW)
        before = resident()
        fill(node, store, data, replicas=replicas)
        assert len(node.holdings) == FEW + data, f"{len(node.holdings)} are held"
        return (resident() - before) / data * 1000 / 1024


class Surroundings:
    """A drone and its neighbours. Nothing that they send is lost."""

    def __init__(self, drone: Node, others: Sequence[Node], store: SqliteStore) -> None:
        self._drone = drone
        self._others = others
        self._store = store
        self.now = 1e6

    def step(self) -> float:
        """One turn of each node. Returns the seconds of processor time that the drone has spent."""
        self.now += 1.0
        begin = time.process_time()
        queue = [(self._drone.id, message) for message in self._drone.step(self.now)]
        spent = time.process_time() - begin
        commit(self._store)
        for node in self._others:
            queue += [(node.id, message) for message in node.step(self.now)]
        while queue:
            sender, message = queue.pop(0)
            for node in self._others:
                if node.id != sender and _concerns(message, node.id):
                    queue += [(node.id, answer) for answer in node.receive(message, self.now)]
            if sender != self._drone.id and _concerns(message, self._drone.id):
                begin = time.process_time()
                answers = self._drone.receive(message, self.now)
                answers += self._drone.forward(self.now)
                spent += time.process_time() - begin
                commit(self._store)
                queue += [(self._drone.id, answer) for answer in answers]
        return spent


def _concerns(message: Message, id: int) -> bool:
    return getattr(message, "target", BROADCAST) in (id, BROADCAST) or type(message) is Data


def steps(data: int, situation: str) -> list[float]:
    """Milliseconds of processor time that each step takes with so many data."""
    with tempfile.TemporaryDirectory(prefix="rass-mav-") as folder, opened(Path(folder) / "drone.db") as store:
        drone = node_of(1, store)
        fill(drone, store, data)
        others: list[Node] = []
        if situation == "island":
            others = [node_of(id, MemoryStore(id)) for id in (2, 3, 4)]
        elif situation == "base":
            others = [node_of(2, MemoryStore(2), base=True)]
        surroundings = Surroundings(drone, others, store)
        gc.collect()
        gc.freeze()
        spent = [surroundings.step() for _ in range(WARM_UP + STEPS)][WARM_UP:]
        assert len(drone.holdings.custody) >= data - RunStoreSettings().bandwidth_items * (WARM_UP + STEPS)
        return [round(1e3 * one, 3) for one in spent]


def measure(amounts: Sequence[int]) -> dict[str, Any]:
    """Memory and time for each of these amounts."""

    def alone(work: Any, *arguments: Any) -> Any:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            return process.submit(work, *arguments).result()

    return {
        "kib_per_1000": {
            "in custody": [round(alone(memory, SPARES, False), 1) for _ in range(ROUNDS)],
            "replicas": [round(alone(memory, SPARES, True), 1) for _ in range(ROUNDS)],
        },
        "step_ms": {
            situation: {f"{data:,}": alone(steps, data, situation) for data in amounts} for situation in SITUATIONS
        },
    }


def show(found: dict[str, Any]) -> str:
    """The tables."""
    kib = [[f"{SPARES:,} {what}", spread(values)] for what, values in found["kib_per_1000"].items()]
    rows = [
        [data, *(spread(found["step_ms"][situation][data], 2) for situation in SITUATIONS)]
        for data in found["step_ms"][SITUATIONS[0]]
    ]
    return (
        table(["held", "KiB for each 1,000"], kib)
        + "\n"
        + table(["data held", *(f"{situation}, ms a step" for situation in SITUATIONS)], rows)
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=int, nargs="+", default=DATA, metavar="N", help="how many data are held")
    parser.add_argument("--json", action="store_true", help="print a JSON object")
    options = parser.parse_args(arguments)
    found = measure(options.data)
    print(json.dumps(found) if options.json else show(found))


if __name__ == "__main__":
    main()
