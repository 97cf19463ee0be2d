"""`sitl`: flies simulated vehicles with real or mock flight control firmware."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from itertools import chain
from pathlib import Path

from rass_mav.commands.common import Subparsers, add_command, add_set, answer, keeping, lists, start_logging
from rass_mav.errors import ConfigError

from .runs import flight_lines, kept_files, progress_of_steps, summary_lines


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "sitl", _sitl,
        help="fly simulated vehicles (ArduCopter, PX4 or mocks), each with a node",
        example="rass-mav sitl three-copters.yaml --binary ~/ardupilot/build/sitl/bin/arducopter",
    )  # fmt: skip
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="a YAML file of flying vehicles; or the name of one that comes with rass-mav: three-copters.yaml, "
        "six-copters.yaml",
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--binary", metavar="PATH", help="the firmware (default: arducopter or px4 on PATH, else mocks)")
    which.add_argument("--mock", action="store_true", help="fly mock flight controllers")
    parser.add_argument(
        "--firmware", choices=("arducopter", "px4"), help="the kind of --binary, or the firmware to look for"
    )
    parser.add_argument(
        "--through-autopilots", action="store_true", dest="through",
        help="send frames between nodes through the autopilots, over TELEM1",
    )  # fmt: skip
    parser.add_argument("--vehicles", type=int, metavar="N", help="only the first N of the scenario's drones")
    parser.add_argument("--steps", type=int, metavar="N", help="steps of Alg. 1, from take-off")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of all random choices")
    policy = parser.add_argument("--policy", metavar="NAME", help="the storage policy")
    lists(policy, lambda: import_module("rass_mav.policy.settings").kinds())
    parser.add_argument("--range", type=float, metavar="METRES", help="radio range")
    parser.add_argument("--loss", type=float, metavar="P", help="probability that a receiver loses a frame")
    parser.add_argument("--record", type=Path, metavar="FILE.tlog", help="record every frame put on the air")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep configurations, stores, logs and tracks in DIR")
    add_set(parser)


def _sitl(options: argparse.Namespace) -> int:
    start_logging(options.verbose, "error")
    from rass_mav.app.shipped import shipped_or
    from rass_mav.lab.sitl.firmware import HOW_TO_GET, find_firmware
    from rass_mav.lab.sitl.fleet import run
    from rass_mav.lab.sitl.pilot import need_mavsdk
    from rass_mav.lab.sitl.scenario import load_flight
    from rass_mav.lab.swarm.scenario import OPTION_KEYS

    given = {OPTION_KEYS[name]: getattr(options, name) for name in ("steps", "seed", "policy", "range", "loss")}
    keys = {key: value for key, value in given.items() if value is not None}
    scenario = load_flight(shipped_or(options.scenario), keys, options.assignments, options.vehicles)
    if options.mock and options.firmware:
        raise ConfigError("--firmware: cannot be combined with --mock")
    need_mavsdk()  # before it is announced what flies
    firmware = find_firmware(options.binary, options.firmware, mock=options.mock)
    if firmware is None:
        if options.firmware:
            raise ConfigError(f"--firmware {options.firmware}: {HOW_TO_GET}")
        sys.stderr.write(f"{HOW_TO_GET}. Flying with mock flight controllers instead.\n")
        firmware = find_firmware(mock=True)
        assert firmware is not None
    if firmware.name == "arducopter" and firmware.script is None:
        sys.stderr.write("rass_rad.lua is not among the installed files, so the readings are injected.\n")
    with (
        keeping(lambda: kept_files(options.record, options.keep)),
        progress_of_steps(scenario.steps, quiet=options.json) as show,
    ):
        summary = run(
            scenario, firmware, through=options.through, keep=options.keep, record=options.record, progress=show
        )
    answer(options, summary, chain(summary_lines(summary), flight_lines(summary["sitl"])))
    return 0
