"""`mock-vehicle`: a mock autopilot for a node's own configuration, to rehearse with it on a laptop."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rass_mav.commands.common import Subparsers, add_command, add_set, answer, clean, config_of, say, start_logging
from rass_mav.errors import ConfigError

if TYPE_CHECKING:
    from rass_mav.lab.fleet.rehearsal import Flight, Rehearsal

#: Where it flies if neither a place nor a source is given: latitude and longitude, degrees.
_PLACE = "45,-73"
_WHAT = """
It sends heartbeats, positions, the GPS date, a battery's state, and readings of
an SBM-20 counter 10 m above the sources, in the unit of `risk.unit`. It signs if
`autopilot.signing` is on. It obeys no commands and forwards no frames to other
nodes. If `autopilot.url` is a device or another computer's port, give
both commands `--set autopilot.url=udpin:127.0.0.1:14550`.
"""


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, "mock-vehicle", _mock_vehicle,
        help="fly a mock vehicle for `run` with the same configuration, until Ctrl-C",
        example="rass-mav mock-vehicle drone.yaml --source 45.0003,-73,5000 --path lawnmower",
    )  # fmt: skip
    parser.description = f"{parser.description}\n{_WHAT}".rstrip()
    parser.add_argument("config", metavar="CONFIG.yaml", help="the drone's configuration; it flies at autopilot.url")
    parser.add_argument(
        "--place",
        metavar="LAT,LON",
        help=f"centre of its path; --place=LAT,LON if it begins with a minus (default: the first source, otherwise "
        f"{_PLACE})",
    )
    parser.add_argument(
        "--source", metavar="LAT,LON,USVH", action="append", default=[], dest="sources",
        help="a radiation source: its position, and uSv/h at 1 m; repeatable (default: background only)",
    )  # fmt: skip
    parser.add_argument(
        "--path", choices=("circle", "lawnmower", "hover"), default="circle", help="shape of its path (default: circle)"
    )
    parser.add_argument(
        "--size",
        type=float,
        default=60.0,
        metavar="METRES",
        help="diameter of the circle, or side of the square (default: 60)",
    )
    parser.add_argument("--speed", type=float, default=5.0, metavar="M/S", help="metres per second (default: 5)")
    parser.add_argument(
        "--for",
        type=float,
        default=math.inf,
        dest="seconds",
        metavar="SECONDS",
        help="stop automatically after this time",
    )
    add_set(parser)


def _mock_vehicle(options: argparse.Namespace) -> int:
    start_logging(options.verbose, "error")
    flight = flight_of(options)
    config = config_of(options)
    import asyncio

    from rass_mav.lab.fleet.rehearsal import Rehearsal, not_rehearsed

    def show(line: str) -> None:
        """Print at once, in a pipe too."""
        if not options.json:
            say(clean(line))
            sys.stdout.flush()

    async def fly() -> Rehearsal:
        vehicle = Rehearsal(config, flight, show)
        try:
            for line in (*opening_lines(vehicle, flight), *not_rehearsed(config)):
                show(line)
            await vehicle.run(options.seconds)
        finally:
            vehicle.port.close()
        return vehicle

    summary = asyncio.run(fly()).summary()
    answer(options, summary, [f"{summary['sent']} frames sent, {summary['heartbeats']} heartbeats of the node heard"])
    return 0


def flight_of(options: argparse.Namespace) -> Flight:
    """What is flown. Raises `ConfigError` for numbers out of range."""
    from rass_mav.lab.fleet.rehearsal import MOST_SIZE_M, MOST_SPEED_M_S, Flight

    for option, value, most in (
        ("--size", options.size, MOST_SIZE_M), ("--speed", options.speed, MOST_SPEED_M_S),
        ("--for", options.seconds, math.inf),
    ):  # fmt: skip
        if not 0 < value <= most:
            raise ConfigError(f"{option}: expected a number above 0{_at_most(most)}, got {value:g}")
    sources = [_numbers("--source", text, 3, "latitude, longitude and uSv/h at 1 m") for text in options.sources]
    for (*_, strength), text in zip(sources, options.sources, strict=True):
        if strength < 0:
            raise ConfigError(f"--source: expected at least 0 uSv/h, got {text!r}")
    place = options.place or (options.sources[0].rpartition(",")[0] if sources else _PLACE)
    latitude, longitude = _numbers("--place", place, 2, "latitude and longitude")
    return Flight((latitude, longitude), options.path, options.size, options.speed, [(a, b, c) for a, b, c in sources])


def _numbers(option: str, text: str, count: int, what: str) -> list[float]:
    """Numbers with commas between them, the first two a place in degrees."""
    from rass_mav.lab.fleet.rehearsal import MOST_LATITUDE

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ConfigError(f"{option}: expected {what}, separated by commas, got {text!r}")
    if abs(numbers[0]) > MOST_LATITUDE or abs(numbers[1]) > 180.0:
        raise ConfigError(
            f"{option}: expected a latitude within {MOST_LATITUDE:g} degrees and a longitude within 180, got {text!r}"
        )
    return numbers


def _at_most(most: float) -> str:
    return "" if math.isinf(most) else f", at most {most:g}"


def opening_lines(vehicle: Rehearsal, flight: Flight) -> Iterator[str]:
    """What flies where, and how that ends."""
    what = (
        "hovers"
        if flight.path == "hover"
        else f"flies a {flight.path} of {flight.size_m:g} m at {flight.speed_m_s:g} m/s"
    )
    latitude, longitude = flight.place
    yield f"A mock vehicle, system {vehicle.system_id}, {what} at {latitude:g}, {longitude:g}"
    for latitude, longitude, strength in flight.sources:
        yield f"    source of {strength:g} uSv/h at 1 m: {latitude:g}, {longitude:g}"
    yield f"Port: {vehicle.port.name}"
    yield "Ctrl-C stops it. In another terminal, with the same configuration: rass-mav run"
