"""`replay`: plays recorded logs through the nodes."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.commands.common import Subparsers, add_command, add_set, answer, clean, keeping, progress, start_logging
from rass_mav.errors import ConfigError, RassError, os_errors_as

from .runs import kept_files, recorder, summary_lines

if TYPE_CHECKING:
    from rass_mav.lab.replay.arrivals import Arrival
    from rass_mav.lab.replay.world import ReplaySwarm


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "replay", _replay,
        help="play recorded logs (.tlog, bGeigie .LOG) through nodes in virtual time, one node per vehicle",
        example="rass-mav replay flight/*.tlog --range 33 -o arrived.csv",
    )  # fmt: skip
    # argparse treats `-35.36,149.17` as an option, because it starts with a minus and is not a plain number.
    parser._negative_number_matcher = re.compile(r"^-(\d|\.\d)")
    parser.add_argument(
        "logs", metavar="LOG", nargs="+", help="a telemetry log with one or several vehicles, or a bGeigie log"
    )
    parser.add_argument("--range", type=float, metavar="METRES", help="radio range (default: 100)")
    parser.add_argument(
        "--base", type=_place, metavar="LAT,LON",
        help="position of the base, degrees (default: the first HOME_POSITION, otherwise the first position)",
    )  # fmt: skip
    parser.add_argument(
        "--drain", type=_seconds, metavar="SECONDS", default=0.0,
        help="continue after the last record, without movement or new data, until all data have arrived or time is up",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv", help="write the data that arrived, one per line"
    )
    parser.add_argument("--record", type=Path, metavar="FILE.tlog", help="record every frame put on the air")
    parser.add_argument("--check", action="store_true", help="check all invariants in full after every step")
    add_set(parser)


def _place(text: str) -> tuple[float, float]:
    try:
        latitude, longitude = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected LAT,LON in degrees, got {text!r}") from None
    if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 180.0):
        raise argparse.ArgumentTypeError(f"expected -90..90,-180..180 degrees, got {text!r}")
    return latitude, longitude


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1e6:
        raise argparse.ArgumentTypeError(f"expected seconds, 0 to 1000000, got {text!r}")
    return value


def _replay(options: argparse.Namespace) -> int:
    start_logging(options.verbose, "error")
    from rass_mav.lab.replay.arrivals import arrivals, summary, write_csv
    from rass_mav.lab.replay.recording import read_logs
    from rass_mav.lab.replay.settings import load_settings
    from rass_mav.lab.replay.world import ReplaySwarm
    from rass_mav.lab.swarm.statistics import Stopwatch

    settings, scale = load_settings(options.range, options.assignments)
    for name in ("output", "record"):
        _replica(options.logs, getattr(options, name), f"--{name}")
    recording = read_logs(options.logs, reading_name=settings.mavlink.reading_name, meter=settings.sensor.meter())
    if scale:
        settings = settings.with_highest(recording.highest)
    with recorder(options.record, settings.node.step_s, recording.start_us / 1e6) as record:
        swarm = ReplaySwarm(recording, settings, base=options.base, record=record)
        watch = Stopwatch()
        reached = _run(swarm, options)
        took = watch.figures(len(swarm.agents) * swarm.t)
    rows = arrivals(swarm)
    if options.output is not None:
        with os_errors_as(RassError, options.output), options.output.open("w", newline="", encoding="utf-8") as file:
            write_csv(rows, file)
    result = {**summary(swarm, rows), "reachable": reached, **took}
    answer(options, result, map(clean, chain(summary_lines(result), [""], _lines(result, rows))))
    return 0


def _replica(logs: Sequence[str], path: Path | None, option: str) -> None:
    """Refuse to overwrite a log."""
    if path is not None and path.resolve() in [Path(log).resolve() for log in logs]:
        raise ConfigError(f"{option} {path}: is one of the logs to replay")


def _run(swarm: ReplaySwarm, options: argparse.Namespace) -> int:
    """Play it; returns how many vehicles could reach the base in the first step."""
    from rass_mav.lab.medium.neighbours import reachable
    from rass_mav.lab.swarm.invariants import check

    reached = 0
    with (
        keeping(lambda: kept_files(options.record)),
        progress(swarm.span_steps, "steps", quiet=options.json) as advance,
    ):

        def after(swarm: ReplaySwarm) -> None:
            nonlocal reached
            if swarm.t == 1:
                reached = reachable(swarm.neighbours, 1)
            if options.check:
                check(swarm)
            advance(1)

        swarm.run(swarm.span_steps, after=after)
        swarm.drain(int(options.drain / swarm.step_s), after=after)
    return reached


def _lines(result: dict[str, Any], rows: Sequence[Arrival]) -> Iterator[str]:
    """Lines about the logs, for people."""
    records = result["records"]
    yield (
        f"logs: {len(result['files'])} with {len(result['vehicles'])} vehicles, {result['start']} to {result['end']}; "
        f"{records['read']:,} records, {records['used']:,} used, {records['rejected']:,} rejected"
    )
    for file in result["files"]:
        if file["rejected"]:
            yield f"  {file['file']}: damaged, {file['rejected']:,} of {file['read']:,} records rejected"
    idle = {file["file"] for file in result["files"]} - {vehicle["file"] for vehicle in result["vehicles"]}
    for name in sorted(idle):
        yield f"  {name}: contains no vehicle"
    base = result["base"]
    if base is None:
        yield "base: no position in any log, so no node is in range of another"
    else:
        yield f"base at {base['lat']:.7f} {base['lon']:.7f}, {base['alt_m']:.1f} m"
    readings = result["readings"]
    between = f", from {readings['min']:g} to {readings['max']:g}" if readings else ""
    yield (
        f"arrived: {len(rows):,} data, {result['delivered_with_position']:,} with a position, "
        f"{result['delivered_with_reading']:,} with a reading{between}"
    )
    risk = result["risk"]
    yield f"risk 0 at a reading of {risk['low']:g}, risk 1 at {risk['high']:g} (--set risk.low=..., risk.high=...)"
