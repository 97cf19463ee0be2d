"""Robot-steps a second of the mock swarm, and how much more a robot-step costs among 1,000 nodes than among 100.

    python -m benchmarks.swarm            a table
    python -m benchmarks.swarm --json     one JSON object

A robot-step is one turn of one node: it hears what its neighbours sent, moves, senses, runs Alg. 1 and sends. The time
is processor time. Each swarm runs in its own process, with the product's settings of the garbage collector, and is
warmed up first. Then the swarms take turns, so that other load on the machine affects all alike. A ratio is the median
over the rounds. A rate is that of the fastest round, since other load can only slow it down.

Larger swarms do more in a robot-step, because their data travel farther. `variants` defines what each line keeps equal.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rass_mav.lab.swarm.world import World

SMALL, LARGE = 100, 1000
#: One copy, one hop a step, no receipts: the paper's node. `benchmarks.policies` compares the other variants with it.
PLAIN: dict[str, Any] = {
    "policy.name": "rass", "custody.replicas": False, "without": ["receipts"], "node.forward": "step",
}  # fmt: skip


class Variant(NamedTuple):
    """A swarm of 1,000 nodes, and the swarm of 100 with which it is compared."""

    meaning: str
    small: dict[str, Any]
    """Overrides of the scenario `demo`, for 100 nodes."""
    large: dict[str, Any]
    """The same for 1,000 nodes."""


def variants() -> dict[str, Variant]:
    """The lines of the table."""
    small, large = {"nodes": SMALL, **PLAIN}, {"nodes": LARGE, **PLAIN}
    # For the same number of hand-overs in a robot-step: data need this many times more hops, so fewer are created.
    farther = _mean_hops(large) / _mean_hops(small)
    bases = LARGE // SMALL
    return {
        "default": Variant("demo with the paper's node; one corner base, which saturates at 1,000 nodes", small, large),
        "same load": Variant(
            f"1,000 nodes create data {farther:.1f} times less often, because data need that many times more hops",
            small,
            {**large, "data.interval_steps": round(10 * farther)},
        ),
        "bases in proportion": Variant(f"{bases} bases at 1,000 nodes, far apart", small, {**large, "bases": bases}),
        "islands of 100": Variant(
            f"{bases} swarms of 100 nodes, out of each other's range: 1,000 nodes do what 100 do",
            {**small, **_islands(1)},
            {**large, **_islands(bases)},
        ),
        "no data": Variant("beacons only", {**small, "data.interval_steps": 0}, {**large, "data.interval_steps": 0}),
    }


def _islands(count: int) -> dict[str, Any]:
    """`count` grids of 100 nodes, each with a base in its corner; bases have the lowest ids."""
    from rass_mav.lab.swarm.topology import grid

    one = grid(SMALL, 20.0)
    spots = [[(x + 40.0 * i, y) for x, y in one] for i in range(count)]
    positions = [spot[0] for spot in spots] + [place for spot in spots for place in spot[1:]]
    return {
        "topology": "positions",
        "mobility.positions": positions,
        "bases": count,
        # Three sources for each, where the first grid has its own: here they are fixed.
        "radiation.sources": [(40.0 * i + x, y, 0.5) for i in range(count) for x, y in ((-2, -2), (0, 2), (3, -1))],
    }


def _mean_hops(options: dict[str, Any]) -> float:
    from rass_mav.lab.medium.neighbours import RangeGraph
    from rass_mav.lab.swarm.scenario import load_scenario
    from rass_mav.lab.swarm.topology import grid

    scenario = load_scenario("demo", options)
    graph = RangeGraph(grid(scenario.nodes, scenario.arena), scenario.radio.range_m)
    hops = graph.hops_from(range(scenario.bases))[scenario.bases :]
    return statistics.mean(hop for hop in hops if hop is not None)


def _swarm(pipe: Connection, options: dict[str, Any], warm_up: int) -> None:
    """A process with one swarm. It receives a number of steps, runs them, and returns processor seconds, and how many
    frames have reached nodes, collided ones too."""
    from rass_mav.commands.common import start_logging
    from rass_mav.lab.swarm.scenario import load_scenario
    from rass_mav.lab.swarm.virtual import at_rest
    from rass_mav.lab.swarm.world import World

    start_logging(0, "error")
    scenario = load_scenario("demo", options)
    world = World(scenario)
    # As `rass-mav swarm` does.
    with at_rest():
        for _ in range(warm_up):
            world.step()
        while True:
            heard = reached(world)
            begin = time.process_time()
            steps = pipe.recv()
            if not steps:
                return
            for _ in range(steps):
                world.step()
            spent = time.process_time() - begin
            pipe.send((spent, reached(world) - heard))


def reached(world: World) -> int:
    """How many frames have reached nodes, collided ones too."""
    from rass_mav.lab.medium.channel import Medium

    tally = world.air.tally
    collided = tally.collided if isinstance(tally, Medium) else 0
    return sum(agent.peers.received for agent in world.agents) + collided


def measure(rounds: int, robot_steps: int, warm_up: int, names: Sequence[str] = ()) -> dict[str, dict[str, float]]:
    """For each variant: robot-steps a second, frames heard in a robot-step, and the ratio of the cost of one.

    `robot_steps`: how many each swarm does in a round. `warm_up`: steps before the first round.
    """
    chosen = {name: variant for name, variant in variants().items() if not names or name in names}
    both = [options for variant in chosen.values() for options in (variant.small, variant.large)]
    costs, frames = take_turns(both, rounds, robot_steps, warm_up)
    results = {}
    for name, variant in chosen.items():
        small, large = json.dumps(variant.small), json.dumps(variant.large)
        results[name] = {
            "per_s_100": 1.0 / min(costs[small]),
            "per_s_1000": 1.0 / min(costs[large]),
            "ratio": statistics.median(b / a for a, b in zip(costs[small], costs[large], strict=True)),
            "heard_100": frames[small],
            "heard_1000": frames[large],
            "ratio_a_frame": statistics.median(b / a for a, b in zip(costs[small], costs[large], strict=True))
            * frames[small]
            / frames[large],
        }
    return {name: {key: round(value, 3) for key, value in result.items()} for name, result in results.items()}


def take_turns(
    scenarios: Sequence[dict[str, Any]], rounds: int, robot_steps: int, warm_up: int
) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Swarms that take turns, each in its own process. `scenarios`: overrides of `demo`, including `nodes`.

    Returns by `json.dumps` of the overrides: processor seconds of a robot-step in each round, and frames heard in one.
    """
    context = multiprocessing.get_context("spawn")
    swarms: dict[str, tuple[Connection, int]] = {}
    children = []
    for options in scenarios:
        key = json.dumps(options)
        if key not in swarms:
            here, there = context.Pipe()
            child = context.Process(target=_swarm, args=(there, options, warm_up), daemon=True)
            child.start()
            children.append(child)
            swarms[key] = here, options["nodes"]
            # One after the other: two that warm up at the same time would disturb each other's cache.
            here.send(1)
            here.recv()
    costs: dict[str, list[float]] = {key: [] for key in swarms}
    frames = dict.fromkeys(swarms, 0.0)
    for _ in range(rounds):
        for key, (pipe, nodes) in swarms.items():
            pipe.send(robot_steps // nodes)
            spent, heard = pipe.recv()
            done = robot_steps // nodes * nodes
            costs[key].append(spent / done)
            frames[key] += heard / done / rounds
    for pipe, _ in swarms.values():
        pipe.send(0)
    for child in children:
        child.join()
    return costs, frames


def show(results: dict[str, dict[str, float]]) -> None:
    """Print the table."""
    head = f"{'':<21} {'robot-steps/s':>17} {'cost':>6}   {'frames heard':>13} {'cost of':>8}"
    print("mock swarm".ljust(21) + head[21:])
    print(f"{'':<21} {'100':>8} {'1000':>8} {'ratio':>6}   {'100':>6} {'1000':>6} {'one':>8}")
    for name, one in results.items():
        print(
            f"  {name:<19} {one['per_s_100']:>8.0f} {one['per_s_1000']:>8.0f} {one['ratio']:>6.2f}   "
            f"{one['heard_100']:>6.1f} {one['heard_1000']:>6.1f} {one['ratio_a_frame']:>8.2f}"
        )
    for name, variant in variants().items():
        if name in results:
            print(f"  {name}: {variant.meaning}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each swarm (default: 5)")
    parser.add_argument("--robot-steps", type=int, default=10_000, help="in each turn (default: 10000)")
    parser.add_argument("--warm-up", type=int, default=50, help="steps before the first turn (default: 50)")
    parser.add_argument("--only", action="append", default=[], metavar="LINE", help="only this line of the table")
    options = parser.parse_args(arguments)
    results = measure(options.rounds, options.robot_steps, options.warm_up, options.only)
    if options.json:
        print(json.dumps(results))
    else:
        show(results)


if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    main()
