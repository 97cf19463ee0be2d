"""What survival routing, replicas, receipts and immediate forwarding cost in processor time, compared with RASS.

    python -m benchmarks.policies            a table
    python -m benchmarks.policies --json     one JSON object

Swarms of 100 nodes take turns (`benchmarks.swarm`): a ratio is the median over the rounds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.swarm import PLAIN, SMALL, take_turns

_MIRROR = {"custody.replicas": True, "without": ["receipts"]}
_SURVIVAL = {"policy.name": "survival"}
#: The variants, each compared with the first one: overrides of the scenario `demo`.
WAYS: dict[str, dict[str, Any]] = {
    "rass": PLAIN,
    "rass, receipts": {**PLAIN, "without": []},
    "rass, replica until passed on": {**PLAIN, **_MIRROR},
    "survival": {**PLAIN, **_SURVIVAL},
    "survival, replica until passed on": {**PLAIN, **_SURVIVAL, **_MIRROR},
    "the defaults": {
        "policy.name": "survival", "custody.replicas": True, "node.forward": "immediate",
    },
}  # fmt: skip


def measure(rounds: int, robot_steps: int, warm_up: int) -> dict[str, dict[str, float]]:
    """For each variant: robot-steps a second, frames heard in one, and the ratio of its cost to that of `rass`."""
    scenarios = {name: {"nodes": SMALL, **way} for name, way in WAYS.items()}
    costs, frames = take_turns(list(scenarios.values()), rounds, robot_steps, warm_up)
    first = costs[json.dumps(scenarios["rass"])]
    results = {}
    for name, options in scenarios.items():
        key = json.dumps(options)
        results[name] = {
            "per_s": round(1.0 / min(costs[key]), 3),
            "ratio": round(statistics.median(b / a for a, b in zip(first, costs[key], strict=True)), 3),
            "heard": round(frames[key], 3),
        }
    return results


def show(results: dict[str, dict[str, float]]) -> None:
    """Print the table."""
    print(f"{'policies, 100 nodes':<36} {'robot-steps/s':>13} {'cost, ratio':>12} {'frames heard':>13}")
    for name, one in results.items():
        print(f"  {name:<34} {one['per_s']:>13.0f} {one['ratio']:>12.2f} {one['heard']:>13.1f}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each swarm (default: 7)")
    parser.add_argument("--robot-steps", type=int, default=10_000, help="in each turn (default: 10000)")
    parser.add_argument("--warm-up", type=int, default=50, help="steps before the first turn (default: 50)")
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.robot_steps, options.warm_up)
    if options.json:
        print(json.dumps(results))
    else:
        show(results)


if __name__ == "__main__":
    main()
