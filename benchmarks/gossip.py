"""What gossip costs among nodes that all hear each other, by how many they are.

    python -m benchmarks.gossip

A base and its neighbours in one clique. First nothing is to be said: all know the same. Then one datum arrives in each
turn, and the base reports. A table: frames of statements that a node sends in a turn, and those that all send for one
statement of the base; there also where all have their turns at the same moment, and nobody hears what others send in
the same turn. docs/evaluation/performance.md explains the figures.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Beacon, Receipt
from rass_mav.core.news.archive import Archive, Serials
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.store.memory import MemoryStore

#: Nodes that hear each other.
NEIGHBOURS = (8, 16, 32, 64)
#: `custody.receipt_steps`.
PERIOD = 3


class Cost(NamedTuple):
    """Of one clique."""

    quiet: float
    """Frames a node and turn while all know the same."""
    reporting: float
    """The same while the base reports."""
    for_one: float
    """Frames of all nodes for one statement of the base."""


def measure(nodes: int, turns: int, *, lockstep: bool = False, seed: int = 1) -> Cost:
    """So many nodes for so many turns of each kind. `lockstep`: all have their turns at the same moment."""
    rng = random.Random(seed)
    archive = Archive()
    serials = Serials(MemoryStore(1))
    clique = [Receipts(rng, (0, 1), archive=archive, serials=serials, period=PERIOD)]
    clique += [Receipts(rng, period=PERIOD, phase=rng.randrange(PERIOD)) for _ in range(nodes - 1)]
    frames = stated = turn = 0

    def pass_turn() -> None:
        nonlocal frames, stated, turn
        turn += 1
        beacons = [_neighbour(n, node.statements_hash) for n, node in enumerate(clique)]
        waiting: list[tuple[int, Receipt]] = []
        for n, node in enumerate(clique):
            messages = node.turn(turn, beacons[:n] + beacons[n + 1 :])
            waiting += [(n, message) for message in messages if isinstance(message, Receipt)]
            if not lockstep or n == len(clique) - 1:
                for sender, receipt in waiting:
                    frames += 1
                    stated += sender == 0
                    for other, hearer in enumerate(clique):
                        if other != sender:
                            hearer.learn(receipt)
                waiting.clear()

    for _ in range(turns):
        pass_turn()
    quiet, frames = frames, 0
    stated = 0
    for sequence in range(turns):
        id = DatumId(1 + sequence % 100, 7, sequence // 100)
        archive.add(id)
        clique[0].arrived(id)
        pass_turn()
    return Cost(quiet / turns / nodes, frames / turns / nodes, frames / max(1, stated))


def _neighbour(id: int, statements_hash: int) -> Neighbour:
    return Neighbour(
        Beacon(id, id, 0, 0, 0, 0, 0, NO_ROUTE, 0, 0, 0, 0, 0, 0, statements_hash), 0.0
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=600, help="of each kind (default: 600)")
    options = parser.parse_args(arguments)
    print("| nodes | a node and turn, all know the same | while a base reports | for one statement | in lockstep |")
    print("|---|---|---|---|---|")
    for nodes in NEIGHBOURS:
        cost, lockstep = (measure(nodes, options.turns, lockstep=lockstep) for lockstep in (False, True))
        print(f"| {nodes} | {cost.quiet:.4f} | {cost.reporting:.4f} | {cost.for_one:.1f} | {lockstep.for_one:.1f} |")


if __name__ == "__main__":
    main()
