"""What an air that takes time costs: processor time of a frame heard, compared with the air that takes none.

    python -m benchmarks.air            a table
    python -m benchmarks.air --json     one JSON object

100 nodes of the scenario `demo`. The time is processor time, divided by the frames that nodes heard or lost: on a slow
air more are sent, because answers get lost. The swarms take turns, as in `benchmarks.swarm`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.swarm import take_turns

NODES = 100
#: Slow radios have longer steps, so that they carry the load.
AIRS: dict[str, dict[str, Any]] = {
    "none": {},
    "none, 4 strikes": {"radiation.strikes_per_step": 4},
    "wifi-6m": {"radio.preset": "wifi-6m"},
    "wifi-1m": {"radio.preset": "wifi-1m"},
    "sik-64k": {"radio.preset": "sik-64k", "node.step_s": 10},
    "sik-250k": {"radio.preset": "sik-250k", "node.step_s": 10},
    "lora": {"radio.preset": "lora", "node.step_s": 60},
}


def measure(rounds: int, robot_steps: int, warm_up: int) -> dict[str, dict[str, float]]:
    """For each air: the ratio of the cost of a robot-step and of a frame, and frames heard in a robot-step."""
    scenarios = {name: {"nodes": NODES, **keys} for name, keys in AIRS.items()}
    costs, frames = take_turns(list(scenarios.values()), rounds, robot_steps, warm_up)
    base = json.dumps(scenarios["none"])
    results = {}
    for name, keys in scenarios.items():
        own = json.dumps(keys)
        ratio = statistics.median(b / a for a, b in zip(costs[base], costs[own], strict=True))
        results[name] = {"ratio": ratio, "heard": frames[own], "ratio_a_frame": ratio * frames[base] / frames[own]}
    return {name: {key: round(value, 3) for key, value in result.items()} for name, result in results.items()}


def show(results: dict[str, dict[str, float]]) -> None:
    """Print the table."""
    print(f"{'air, 100 nodes':<16}{'robot-step':>12}{'frames heard':>14}{'frame':>8}")
    for name, result in results.items():
        print(f"{name:<16}{result['ratio']:>12.2f}{result['heard']:>14.1f}{result['ratio_a_frame']:>8.2f}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--robot-steps", type=int, default=5000, help="of each swarm in a round (default: %(default)s)")
    parser.add_argument("--warm-up", type=int, default=50, help="steps before the first round (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.robot_steps, options.warm_up)
    if options.json:
        print(json.dumps(results))
    else:
        show(results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
