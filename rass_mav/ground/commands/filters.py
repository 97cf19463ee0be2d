"""The options that choose data: which drones, kinds, times, places and readings."""

from __future__ import annotations

import argparse
import math
import re
import time
from typing import TYPE_CHECKING

from rass_mav.app.handed import date_of
from rass_mav.commands.common import duration
from rass_mav.config.sections import MAX_NODE
from rass_mav.errors import ConfigError, MalformedError

if TYPE_CHECKING:
    from rass_mav.ground.entry import Filter

_KINDS = ("measurement", "file", "part", "bytes", "status", "sealed")


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options. `wanted` reads them."""
    # argparse treats `-35.36,149.17,...` as an option, because it starts with a minus and is not a plain number.
    parser._negative_number_matcher = re.compile(r"^-(\d|\.\d)")
    group = parser.add_argument_group("which data (default: all)")
    group.add_argument("--drone", metavar="N", nargs="+", help="created by these nodes")
    group.add_argument("--kind", metavar="KIND", help="of this kind: measurement, file, part, bytes, status or sealed")
    group.add_argument(
        "--since",
        metavar="TIME",
        help="created since: ISO 8601, UTC unless it names a zone; or an age: 90s, 10m, 2h, 1d",
    )
    group.add_argument("--until", metavar="TIME", help="created before")
    group.add_argument(
        "--box", metavar="SOUTH,WEST,NORTH,EAST",
        help="with a position in this box, in degrees; west > east crosses the 180th meridian",
    )  # fmt: skip
    group.add_argument("--above", metavar="READING", help="with a reading above this, in its own unit")


def wanted(options: argparse.Namespace) -> Filter:
    """What the options choose. Raises `ConfigError`."""
    from rass_mav.ground.entry import Filter

    now = time.time()
    return Filter(
        drones=None if options.drone is None else {_node(text) for text in options.drone},
        kinds=None if options.kind is None else {_kind(options.kind)},
        since=None if options.since is None else _date("--since", options.since, now),
        until=None if options.until is None else _date("--until", options.until, now),
        box=None if options.box is None else _box(options.box),
        above=None if options.above is None else _reading(options.above),
    )


def _node(text: str) -> int:
    if not (re.fullmatch(r"\d{1,5}", text, re.ASCII) and int(text) <= MAX_NODE):
        raise ConfigError(f"--drone: expected the id of a node, 0 to {MAX_NODE}, got {text!r}")
    return int(text)


def _kind(text: str) -> str:
    if text not in _KINDS:
        raise ConfigError(f"--kind: expected one of {', '.join(_KINDS)}, got {text!r}")
    return text


def _date(option: str, text: str, now: float) -> float:
    """Seconds since 1970."""
    if (age_s := duration(text)) is not None:
        return now - age_s
    try:
        return date_of(text)
    except MalformedError:
        raise ConfigError(
            f"{option}: expected a date like 2026-11-22T10:30 (UTC) or an age like 90s, 10m, 2h, 1d, got {text!r}"
        ) from None


def _box(text: str) -> tuple[float, float, float, float]:
    try:
        south, west, north, east = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--box: expected SOUTH,WEST,NORTH,EAST in degrees, got {text!r}") from None
    if not (-90.0 <= south <= north <= 90.0 and abs(west) <= 180.0 and abs(east) <= 180.0):
        raise ConfigError(
            f"--box: expected south -90 to 90, north from there to 90, west and east -180 to 180, got {text!r}"
        )
    return south, west, north, east


def _reading(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"--above: expected a number, got {text!r}")
    return value
