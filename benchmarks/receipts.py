"""How soon the nodes that hold a copy of a datum know of its arrival, and what they send for that.

    python -m benchmarks.receipts                         the scenario `thousand`, seed 1
    python -m benchmarks.receipts demo --seeds 1 2 3
    python -m benchmarks.receipts --set without=[overhearing] --json

A copy counts if its node has it when the datum arrives, or gets it within `WITHIN` steps after. The node knows of the
arrival when it drops the copy because of it. A copy that made way for other data before that is not held any more; such
copies are listed beside the others. docs/evaluation/performance.md explains the figures.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.lab.medium.air import open_datagram
from rass_mav.lab.swarm.scenario import Scenario, load_scenario
from rass_mav.lab.swarm.statistics import percentile
from rass_mav.lab.swarm.world import World
from rass_mav.wire.attestation import ASK, STATEMENT_SIGNATURE
from rass_mav.wire.codec import MAX_TUNNEL, MORE

#: Steps within which a node should know.
WITHIN = 60
#: Types of the messages that tell what has arrived: Receipt, SequenceMark, and with keys statement signatures and asks
#: for them.
_TYPES = (8, 14, STATEMENT_SIGNATURE, ASK)


class Watch(Observer):
    """Follows the copies of one drone, and passes everything on to the ledger."""

    def __init__(self, inner: Observer, node: int, copies: Copies) -> None:
        self._inner = inner
        self._node = node
        self._copies = copies

    def created(self, datum: Datum) -> None:
        self._inner.created(datum)

    def overflow(self) -> None:
        self._inner.overflow()

    def declined(self, id: DatumId) -> None:
        self._inner.declined(id)

    def gained(self, datum: Datum) -> None:
        self._inner.gained(datum)
        self._copies.holders.setdefault(datum.id, set()).add(self._node)

    def dropped(self, id: DatumId, fate: Fate) -> None:
        self._inner.dropped(id, fate)
        self._copies.ended(self._node, id, fate)


class Copies:
    """The copies of all data, and what their nodes know of arrivals."""

    def __init__(self, scenario: Scenario) -> None:
        self.holders: dict[DatumId, set[int]] = {}
        self.ends: Counter[str] = Counter()
        """Copies of data that had arrived, by what became of them within `WITHIN` steps."""
        self.delays: list[int] = []
        """Steps from the arrival of a datum until a node dropped its copy because of it."""
        self.bytes = 0
        """Payload of receipts sent."""
        self._due: dict[int, list[DatumId]] = {}
        self._seen = 0
        self.world = World(scenario, record=self._record)
        for agent in self.world.agents:
            node = agent.node
            if isinstance(node, Node) and not node.base:
                node.custody_store.observer = Watch(node.custody_store.observer, node.id, self)

    def _record(self, frame: bytes, step: int) -> None:
        opened = open_datagram(frame, 0.0)
        assert opened is not None
        payload = opened[3]
        type_ = payload[0] & 15
        if (payload[1] if type_ == MORE else type_) in _TYPES:
            self.bytes += len(payload)

    def ended(self, node: int, id: DatumId, fate: Fate) -> None:
        """A drone has dropped a copy."""
        self.holders.get(id, set()).discard(node)
        ledger = self.world.ledger
        arrived = ledger.arrived.get(id)
        if arrived is not None and ledger.step - arrived <= WITHIN:
            self.ends["known" if fate is Fate.DELIVERED else fate.value] += 1
            if fate is Fate.DELIVERED:
                self.delays.append(ledger.step - arrived)

    def look(self, world: World) -> None:
        """After each step."""
        arrived = list(world.ledger.arrived)
        for id in arrived[self._seen :]:
            self._due.setdefault(world.t + WITHIN, []).append(id)
        self._seen = len(arrived)
        for id in self._due.pop(world.t, ()):
            for holder in self.holders.pop(id, ()):
                self.ends["known" if id in world.agents[holder].node.receipts else "unknown"] += 1


def measure(scenario: Scenario) -> dict[str, Any]:
    """One run."""
    copies = Copies(scenario)
    begun = time.process_time()
    copies.world.run(scenario.steps, after=copies.look)
    cpu_s = time.process_time() - begun
    summary = copies.world.statistics.summary()
    agents, ends, delays = copies.world.agents, copies.ends, sorted(copies.delays)
    held = ends["known"] + ends["unknown"]
    robot_steps = scenario.nodes * max(1, scenario.steps)
    created = max(1, summary["created"])
    lost = sum(summary["lost"].values())
    return {
        "nodes": scenario.nodes,
        "bases": scenario.bases,
        "seed": scenario.seed,
        "steps": scenario.steps,
        "known_within": round(ends["known"] / held, 4) if held else 1.0,
        "known_after_steps": {"p50": percentile(delays, 0.5), "p95": percentile(delays, 0.95)},
        "copies": dict(sorted(ends.items())),
        "receipt_bytes": round(copies.bytes / robot_steps, 2),
        "receipt_bytes_bound": round(bound(scenario), 2),
        "statements": max(
            (len(r.statements.of) for agent in agents if isinstance(r := agent.node.receipts, Receipts)), default=0
        ),
        "created": summary["created"],
        "delivered": round(summary["delivered"] / created, 6),
        "reliability": summary["reliability"],
        "lost_per_million": round(1e6 * lost / created, 1),
        "lost_per_million_bound": round(1e6 * most_expected(lost) / created, 1),
        "delay_steps": summary["delay_steps"],
        "transmissions_per_datum": summary["transmissions_per_datum"],
        "bytes_per_node_and_s": round(summary["bytes_sent"] / robot_steps / scenario.node.step_s, 1),
        "memory_used_percent": summary["memory_used_percent"],
        "loops": summary["routing"]["loops"],
        "alarms": dict(Counter(alarm.name.lower() for agent in agents for alarm in agent.node.alarms.counts)),
        "cpu_s": round(cpu_s, 1),
    }


def bound(scenario: Scenario) -> float:
    """The most payload of receipts that a node sends in a step, bytes."""
    node = scenario.agent_settings(scenario.bases)
    if not node.receipts:
        return 0.0
    period = node.custody.receipt_steps
    receipts = (MAX_TUNNEL + 15) / period
    if scenario.keys:
        # As many statement signatures as statements, and what the node asks itself.
        receipts += MAX_TUNNEL * (1 / period + 1)
    return receipts


def most_expected(events: int) -> float:
    """The expected number below which so many events, or fewer, would be a chance of 0.05 or less (Poisson)."""
    low, high = float(events), 2.0 * events + 10.0
    for _ in range(60):
        middle = (low + high) / 2
        chance = math.fsum(math.exp(n * math.log(middle) - middle - math.lgamma(n + 1)) for n in range(events + 1))
        low, high = (middle, high) if chance > 0.05 else (low, middle)
    return high


def show(one: dict[str, Any]) -> None:
    """Print one run."""
    copies, after, most, delay = (
        one[key] for key in ("copies", "known_after_steps", "receipt_bytes_bound", "delay_steps")
    )
    nodes, bases, mean = one["nodes"], one["bases"], one["receipt_bytes"]
    counted = copies.get("known", 0) + copies.get("unknown", 0)
    others = ", ".join(f"{count:,} {name}" for name, count in copies.items() if name not in ("known", "unknown"))
    lines = (
        f"{nodes:,} nodes, {bases} bases, seed {one['seed']}, {one['steps']} steps, {one['cpu_s']} s of processor time",
        f"known within {WITHIN} steps: {one['known_within']:.4f} of {counted:,} copies"
        f" (half after {after['p50']} steps, 95 % after {after['p95']})",
        f"copies that ended otherwise before: {others or 'none'}",
        f"receipts: {mean} bytes of payload a node and step (at most {most})",
        f"receipts of all nodes: {mean * nodes / 1000:.1f} KB a step (at most {most * nodes / 1000:.1f})",
        f"delivered {one['delivered']:.4f} of {one['created']:,}, reliability {one['reliability']:.6f},"
        f" lost per million {one['lost_per_million']} (below {one['lost_per_million_bound']}), loops {one['loops']}",
        f"delay {delay['p50']} steps (95 %: {delay['p95']}), sent per datum {one['transmissions_per_datum']},"
        f" {one['bytes_per_node_and_s']} bytes per node and second, memory used {one['memory_used_percent']} %",
    )
    print("\n  ".join(lines), flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="thousand", help="a scenario's name or file (default: thousand)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], metavar="SEED", help="default: 1")
    parser.add_argument("--set", dest="keys", action="append", default=[], metavar="KEY=VALUE", help="a scenario key")
    parser.add_argument("--json", action="store_true", help="print one JSON object per seed")
    options = parser.parse_args(arguments)
    for seed in options.seeds:
        one = measure(load_scenario(options.scenario, {"seed": seed}, options.keys))
        if options.json:
            print(json.dumps(one), flush=True)
        else:
            show(one)


if __name__ == "__main__":
    main()
