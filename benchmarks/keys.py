"""What keys cost: hand-overs, robot-steps, start and memory of a node, with everything on, against nodes without keys.

    python -m benchmarks.keys            a table
    python -m benchmarks.keys --json     one JSON object

Hand-overs are those of `benchmarks.handover`: two nodes on SQLite. With keys their frames are signed, data are sealed,
answers tagged, and the base opens each datum. Receipts are off there. Robot-steps are those of a mock swarm of 49
nodes, receipts and chains of announcements included. The two kinds take turns, so that other load affects both alike.
Times are processor times, except the start.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import handover, node

if TYPE_CHECKING:
    from rass_mav.trust.trust import Trust

NODES = 49
WARM_STEPS = 60
#: How long a swarm runs in a round, steps.
STEPS = 100
KINDS = ("open", "keys")


def trusts(directory: Path) -> dict[str, Trust]:
    """What their keys do for the two nodes of `benchmarks.handover`; the drone's data are sealed."""
    from rass_mav.core.datum import make_datum
    from rass_mav.core.seals import SEALED
    from rass_mav.trust.keys.identity import Ground
    from rass_mav.trust.keys.keyring import Keyring
    from rass_mav.trust.keys.sealing import Sealer
    from rass_mav.trust.keys.secret import Secret
    from rass_mav.trust.trust import trust_of

    drone, base = handover.SIDES["drone"], handover.SIDES["base"]
    ground = Ground(Secret(bytes(range(32))), serials={drone: 1})
    keyrings = {"drone": Keyring(ground.node(drone, 1), None), "base": Keyring(ground.node(base), ground)}
    with handover.opened(directory, "drone") as store:
        sealer = Sealer(keyrings["drone"].own, store.epoch, 0)
        for id in sorted(store.ids()):
            datum = store.get(id)
            assert datum is not None
            sealed = sealer.seal(id.sequence, 0, datum.payload)
            store.put(make_datum(id, SEALED, datum.created, sealed))
    return {side: trust_of(keyring, random.Random(side)) for side, keyring in keyrings.items()}


def hand_overs(rounds: int, data: int) -> dict[str, dict[str, float]]:
    """Medians by kind: hand-overs a second of wall time, and processor time for each, microseconds."""
    found: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    for _ in range(rounds):
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as name:
                handover.fill(Path(name), data)
                keys = trusts(Path(name)) if kind == "keys" else None
                found[kind].append(handover.hand_over(Path(name), 50, keys))
    return {
        kind: {key: statistics.median(one[key] for one in runs) for key in ("per_s", "cpu_us")}
        for kind, runs in found.items()
    }


def robot_steps(rounds: int) -> dict[str, float]:
    """Robot-steps a second by kind, of the fastest round."""
    from rass_mav.lab.swarm.scenario import load_scenario
    from rass_mav.lab.swarm.world import World

    worlds = {kind: World(load_scenario("demo", {"nodes": NODES, "keys": kind == "keys"})) for kind in KINDS}
    for world in worlds.values():
        world.run(WARM_STEPS)
    best = dict.fromkeys(KINDS, 0.0)
    for _ in range(rounds):
        for kind, world in worlds.items():
            begin = time.process_time()
            world.run(STEPS)
            best[kind] = max(best[kind], NODES * STEPS / (time.process_time() - begin))
    return best


def starts(rounds: int, settle_s: float) -> dict[str, dict[str, float]]:
    """Medians by kind of a node's start, ms, and its memory, MiB, as in `benchmarks.node`."""
    from rass_mav.trust.keys import folder

    found: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    # The first round only compiles and fills the disk's cache.
    for turn in range(rounds + 1):
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as name:
                directory = Path(name)
                config = node.config()
                if kind == "keys":
                    folder.create(directory)
                    [issued] = folder.issue(directory, [1])
                    config["keys"] = {"file": str(issued.path)}
                (directory / "drone.yaml").write_text(json.dumps(config))
                command = [sys.executable, "-m", "rass_mav", "run", "--json", "drone.yaml"]
                one = node.start(command, directory, settle_s)
                if turn:
                    found[kind].append(one)
    return {kind: {key: statistics.median(one[key] for one in runs) for key in runs[0]} for kind, runs in found.items()}


def measure(rounds: int, data: int) -> dict[str, Any]:
    """All figures, and the ratios of those with keys to those without."""
    given, stepped, started = hand_overs(rounds, data), robot_steps(rounds), starts(rounds, 2.0)
    return {
        "hand_overs": {**given, "ratio": given["keys"]["per_s"] / given["open"]["per_s"]},
        "robot_steps": {**stepped, "ratio": stepped["keys"] / stepped["open"]},
        "node": {**started, "more_mib": started["keys"]["uss"] - started["open"]["uss"]},
    }


def show(results: dict[str, Any]) -> None:
    """Print the table."""
    given, stepped, started = results["hand_overs"], results["robot_steps"], results["node"]
    lines = [
        ("hand-overs a second", given["open"]["per_s"], given["keys"]["per_s"], given["ratio"]),
        (
            "processor time of one, both nodes, us", given["open"]["cpu_us"], given["keys"]["cpu_us"],
            given["keys"]["cpu_us"] / given["open"]["cpu_us"],
        ),
        ("robot-steps a second", stepped["open"], stepped["keys"], stepped["ratio"]),
        (
            "start of a node, ms", started["open"]["start_ms"], started["keys"]["start_ms"],
            started["keys"]["start_ms"] / started["open"]["start_ms"],
        ),
        ("memory of its own, MiB", started["open"]["uss"], started["keys"]["uss"], None),
    ]  # fmt: skip
    print(f"{'':<40}{'open':>10}{'keys':>10}{'ratio':>8}")
    for line, without, with_keys, ratio in lines:
        print(f"  {line:<38}{without:>10.4g}{with_keys:>10.4g}" + (f"{ratio:>8.2f}" if ratio is not None else ""))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each (default: 5)")
    parser.add_argument("--data", type=int, default=2000, help="data handed over in a round (default: 2000)")
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.data)
    if options.json:
        print(json.dumps(results))
    else:
        show(results)


if __name__ == "__main__":
    main()
