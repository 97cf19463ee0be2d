"""`swarm`: the mock swarm."""

from __future__ import annotations

import argparse
import gc
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.errors import ConfigError

from .common import Subparsers, add_command, add_set, answer, progress, progress_of_steps, recorder, say, start_logging
from .summary import summary_lines

if TYPE_CHECKING:
    from rass_mav.swarm.scenario import Scenario


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "swarm", _swarm,
        help="run a mock swarm: real nodes and real MAVLink bytes, over a simulated radio",
        example="rass-mav swarm --nodes 100 --steps 500 --topology grid --seed 1",
    )  # fmt: skip
    parser.add_argument("scenario", metavar="SCENARIO", nargs="?", help="a YAML file, or a name (--list shows them)")
    parser.add_argument("--list", action="store_true", help="list the scenarios that ship with the package")
    parser.add_argument("--nodes", type=int, metavar="N", help="nodes, the base included")
    parser.add_argument("--steps", type=int, metavar="N", help="steps of Alg. 1")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of everything that is left to chance")
    parser.add_argument("--policy", metavar="NAME", help="who is fit, and what goes to whom (docs/policies.md)")
    parser.add_argument(
        "--topology", metavar="NAME", help="grid, scale-free, lennard-jones, random-walk, line or islands"
    )
    parser.add_argument("--range", type=float, metavar="METRES", help="radio range")
    parser.add_argument("--arena", type=float, metavar="METRES", help="side of the arena")
    parser.add_argument("--loss", type=float, metavar="P", help="a hearer loses a frame with this probability")
    parser.add_argument("--duplicate", type=float, metavar="P", help="a hearer gets a frame twice")
    parser.add_argument("--reorder", type=float, metavar="P", help="a frame is overtaken by others")
    parser.add_argument("--capacity", type=int, metavar="ITEMS", help="data that a drone can hold")
    parser.add_argument("--transport", metavar="NAME", help="loopback (virtual time) or udp (processes, real time)")
    parser.add_argument("--record", type=Path, metavar="FILE.tlog", help="write every frame put on the air")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="udp: keep configurations, stores and logs here")
    parser.add_argument("--check", action="store_true", help="check all invariants in full after every step")
    add_set(parser)


def _scenario(options: argparse.Namespace) -> Scenario:
    from rass_mav.swarm.catalogue import DEFAULT, DEFAULT_UDP, load_scenario
    from rass_mav.swarm.scenario import OPTION_KEYS

    keys = {key: getattr(options, name) for name, key in OPTION_KEYS.items() if getattr(options, name) is not None}
    name = options.scenario or (DEFAULT_UDP if options.transport == "udp" else DEFAULT)
    return load_scenario(name, keys, options.assignments)


def _swarm(options: argparse.Namespace) -> int:
    start_logging(options.verbose, "critical")
    if options.list:
        from rass_mav.swarm.catalogue import load_scenario, shipped

        for name in shipped():
            say(f"{name:22} {load_scenario(name).title}")
        return 0
    scenario = _scenario(options)
    summary = (_in_real_time if scenario.transport == "udp" else _in_virtual_time)(scenario, options)
    answer(options, summary, summary_lines(summary))
    return 0


def _in_real_time(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    from rass_mav.swarm.processes import run

    if options.check:
        raise ConfigError("--check needs --transport loopback: nobody can look into all processes at one moment")
    with progress_of_steps(scenario.steps, quiet=options.json) as show:
        return run(scenario, keep=options.keep, record=options.record, progress=show)


def _in_virtual_time(scenario: Scenario, options: argparse.Namespace) -> dict[str, Any]:
    from rass_mav.swarm.invariants import check
    from rass_mav.swarm.stopwatch import Stopwatch
    from rass_mav.swarm.world import World

    with recorder(options.record, scenario.node.step_s) as record:
        world = World(scenario, record=record)
        # The swarm lives to the end: the garbage collector need not look through it again and again.
        gc.collect()
        gc.freeze()
        watch = Stopwatch()
        with progress(scenario.steps, "steps", quiet=options.json) as advance:
            for _ in range(scenario.steps):
                world.step()
                if options.check:
                    check(world)
                advance(1)
        took = watch.figures(scenario.nodes * scenario.steps)
    return {**world.statistics.summary(), **took}
