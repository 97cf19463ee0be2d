"""Robot-steps a second of the mock swarm, on several airs, with and without keys, with 100 nodes and with 1,000.

    python -m benchmarks.swarm            a table
    python -m benchmarks.swarm --json     one JSON object

A robot-step is one turn of one node: it hears what its neighbours sent, moves, senses, runs Alg. 1 and sends. The time
is processor time. Each swarm runs in its own process, with the product's settings of the garbage collector, and is
warmed up first. Then the swarms take turns, so that other load on the machine affects all alike.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from statistics import median
from typing import TYPE_CHECKING, Any

from benchmarks.tables import ratios, spread, table

if TYPE_CHECKING:
    from rass_mav.lab.swarm.world import World

#: The swarms: a scenario, and what is changed in it. Slow radios have longer steps, so that they carry the load.
SWARMS: dict[str, tuple[str, dict[str, Any]]] = {
    "`demo`": ("demo", {}),
    "the same with keys": ("demo", {"keys": True}),
    "`demo`, `wifi-6m`": ("demo", {"radio.preset": "wifi-6m"}),
    "`demo`, `wifi-1m`": ("demo", {"radio.preset": "wifi-1m"}),
    "`demo`, `sik-64k`, steps of 10 s": ("demo", {"radio.preset": "sik-64k", "node.step_s": 10}),
    "`demo`, `lora`, steps of 60 s": ("demo", {"radio.preset": "lora", "node.step_s": 60}),
    "`paper-grid`, `rass`": ("paper-grid", {"policy.name": "rass"}),
    "`thousand`: 1,000 nodes, eight bases": ("thousand", {}),
}


def _swarm(pipe: Connection, name: str, options: dict[str, Any], warm_up: int) -> None:
    """A process with one swarm. It receives a number of robot-steps, and runs as many or a few more. It returns
    processor seconds, how many frames have reached nodes, collided ones too, and how many robot-steps there were."""
    from rass_mav.commands.common import start_logging
    from rass_mav.lab.swarm.scenario import load_scenario
    from rass_mav.lab.swarm.virtual import at_rest
    from rass_mav.lab.swarm.world import World

    start_logging(0, "error")
    world = World(load_scenario(name, options))
    # As `rass-mav swarm` does.
    with at_rest():
        for _ in range(warm_up):
            world.step()
        nodes = len(world.agents)
        while robot_steps := pipe.recv():
            steps = -(-robot_steps // nodes)
            heard, begin = reached(world), time.process_time()
            for _ in range(steps):
                world.step()
            spent = time.process_time() - begin
            pipe.send((spent, reached(world) - heard, steps * nodes))


def reached(world: World) -> int:
    """How many frames have reached nodes, collided ones too."""
    from rass_mav.lab.medium.channel import Medium

    tally = world.air.tally
    collided = tally.collided if isinstance(tally, Medium) else 0
    return sum(agent.peers.received for agent in world.agents) + collided


def measure(rounds: int, robot_steps: int, warm_up: int, names: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """For each swarm: robot-steps a second in each round, and frames heard in a robot-step.

    `robot_steps`: how many each swarm does in a round. `warm_up`: steps before the first round.
    """
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    children = []
    for name in names or SWARMS:
        pipes[name], there = context.Pipe()
        child = context.Process(target=_swarm, args=(there, *SWARMS[name], warm_up), daemon=True)
        child.start()
        children.append(child)
        # One after the other: two that warm up at the same time would disturb each other's cache.
        pipes[name].send(1)
        pipes[name].recv()
    results: dict[str, dict[str, Any]] = {name: {"per_s": [], "heard": []} for name in pipes}
    for _ in range(rounds):
        for name, pipe in pipes.items():
            pipe.send(robot_steps)
            spent, heard, done = pipe.recv()
            results[name]["per_s"].append(round(done / spent, 1))
            results[name]["heard"].append(round(heard / done, 2))
    for pipe in pipes.values():
        pipe.send(0)
    for child in children:
        child.join()
    return results


def show(results: dict[str, dict[str, Any]]) -> str:
    """The table. Ratios are to the first swarm."""
    first = next(iter(results.values()))["per_s"]
    rows = [
        [name, spread(one["per_s"]), spread(ratios(one["per_s"], first), 2), f"{median(one['heard']):.1f}"]
        for name, one in results.items()
    ]
    return table(["swarm", "robot-steps a second", "ratio to the first", "frames heard in one, median"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each swarm (default: 5)")
    parser.add_argument("--robot-steps", type=int, default=5000, help="in each turn (default: 5000)")
    parser.add_argument("--warm-up", type=int, default=50, help="steps before the first turn (default: 50)")
    parser.add_argument(
        "--only", action="append", default=[], choices=SWARMS, metavar="SWARM", help="only this row of the table"
    )
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.robot_steps, options.warm_up, options.only)
    print(json.dumps(results) if options.json else show(results))


if __name__ == "__main__":
    main()
