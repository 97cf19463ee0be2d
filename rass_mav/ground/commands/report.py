"""`report`: what has become of a mission's data."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rass_mav.commands.common import Subparsers, add_command, answer, clean, start_logging
from rass_mav.errors import ConfigError, RassError, os_errors_as
from rass_mav.ground.attention.conditions import Level
from rass_mav.ground.entry import iso
from rass_mav.ground.hotspots import report_lines as spots_lines
from rass_mav.ground.report import heard_text, lost_text, range_text, risk_text, span, sums_text

from .data import add_store, open_archive, read_archive, rules_of
from .export import refuse_existing

if TYPE_CHECKING:
    from rass_mav.ground.attention.conditions import Event, Row

#: The first line of the table of drones.
HEADER = (
    f"{'DRONE':>5} {'CREATED':>8} {'ARRIVED':>8} {'MISSING':>8} {'LOST':>6} {'HEARD':>7}"
    "  LAST POSITION, HIGHEST READING"
)
#: Seconds between two looks with --follow.
_LOOK_S = 0.5


def report_lines(report: dict[str, Any], shown: Sequence[Row]) -> Iterator[str]:
    """The report in lines, and first what needs attention. Created: at least so many. Missing: on their way, or lost
    without anybody knowing."""
    yield from attention_lines(report, shown)
    delay = report["delay_s"]
    line = sums_text(report)
    if delay["p50"] is not None:
        line += f"; half arrived within {span(delay['p50'])}, 95 % within {span(delay['p95'])}"
    yield line
    yield from report["off_map"]
    yield HEADER
    for drone in report["drones"]:
        yield clean(_drone_line(drone))
        yield from (f"      {clean(line)}" for line in _remarks(drone))


def attention_lines(report: dict[str, Any], shown: Sequence[Row]) -> Iterator[str]:
    """The list, or that there is nothing in it."""
    yield from (clean(row.line) for row in shown)
    if not any(row.level is not Level.NOTE for row in shown) and any(drone["heard"] for drone in report["drones"]):
        yield f"nothing needs attention: {heard_text(report)}"


def _drone_line(drone: dict[str, Any]) -> str:
    heard = "never" if drone["heard"] is None else span(drone["heard"]["age_s"])
    created = f"{drone['created']}{'+' if drone['silent'] else ''}"
    line = (
        f"{drone['drone']:>5} {created:>8} {drone['arrived']:>8} {drone['missing']:>8} "
        f"{sum(drone['lost'].values()):>6} {heard:>7}  "
    )
    place = "no position yet" if drone["place"] is None else "{:.7f} {:.7f}".format(*drone["place"])
    if (highest := drone["highest"]) is None:
        return line + place
    where = "" if highest["place"] is None else " at {:.7f} {:.7f}".format(*highest["place"])
    return f"{line}{place}, {highest['reading']:g}{_unit(highest['unit'])}{where}"


def _remarks(drone: dict[str, Any]) -> Iterator[str]:
    if (named := drone["heard_by"]) is not None:
        base = "a base, " if named["base"] else ""
        yield f"{base}heard by drone {named['drone']} {span(named['age_s'])} ago; nothing has arrived"
    if drone["lost"]:
        yield f"lost: {lost_text(drone['lost'])}"
    if drone["missing_numbers"]:
        ranges = [range_text(row) for row in drone["missing_numbers"][-_MOST_SHOWN:]]
        more = len(drone["missing_numbers"]) - len(ranges)
        yield f"missing: {', '.join(ranges)}" + (f", and {more} earlier ranges" if more else "")
    if (status := drone["status"]) is None or status["base"]:
        return
    yield risk_text(drone)
    battery = "" if status["battery"] is None else f", battery {status['battery']} %"
    key = "" if status["link_key"] is None else f", link key {status['link_key']}"
    route = "no route" if status["hops"] is None else f"{status['hops']} hops"
    yield (
        f"{span(status['age_s'])} ago: {status['held']} in custody, {status['alone']} of them with no other copy, "
        f"{route}, risk {status['risk']:.2f}{battery}{key}; newer data unknown"
    )


#: Ranges of missing numbers in one line.
_MOST_SHOWN = 5


def _unit(unit: str | None) -> str:
    from rass_mav.wire.measurement import UNIT_NAMES

    return "" if unit is None else f" {UNIT_NAMES[unit]}"


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    report = add_command(
        subparsers, "report", _report,
        help="report the fate of each drone's data: arrived, missing, lost, at risk",
        example="rass-mav report base.yaml",
    )  # fmt: skip
    add_store(report)
    report.add_argument("--events", action="store_true", help="show instead what needed attention, and when")
    report.add_argument(
        "--follow", action="store_true",
        help="with --events, keep showing what begins and ends; with --json one object per line",
    )  # fmt: skip
    report.add_argument(
        "--html", type=Path, metavar="FILE", help="also write it, with a map, to a single HTML file to mail or print"
    )


def _report(options: argparse.Namespace) -> int:
    from rass_mav.ground.attention.watch import Watch
    from rass_mav.ground.sources.locator import located
    from rass_mav.ground.sources.readings import Samples
    from rass_mav.ground.sources.texts import report_lines as sources_lines

    start_logging(options.verbose)
    if options.follow and not options.events:
        raise ConfigError("--follow: needs --events")
    if options.follow:
        return _follow(options)
    if options.html is not None:
        refuse_existing(options.html)
    rules = rules_of(options).renewed()
    with read_archive(options) as archive:
        now = time.time()
        if options.html is None:
            samples = Samples()
            watch = Watch.of(archive, rules, samples.watch(archive.entries()))
            sources = None if options.events else located(samples)
        else:
            from rass_mav.ground import html

            with os_errors_as(RassError, options.html):
                watch, sources = html.write(archive, options.html, now, rules)
        notes = archive.notes
        plain = {**watch.plain(now, archive.date), "sources": sources, "drone_store": bool(notes)}
        shown = watch.rows(now, archive.date)
    if options.events:
        answer(options, {"events": [event.plain() for event in watch.events()]}, map(_event_line, watch.events()))
    else:
        below = chain(spots_lines(plain["hot_spots"]), sources_lines(sources))
        answer(options, plain, chain(notes, report_lines(plain, shown), map(clean, below)))
    return 0


def _follow(options: argparse.Namespace) -> NoReturn:
    """Show what has begun and ended, and then what does."""
    from rass_mav.ground.attention.watch import Watch
    from rass_mav.ground.follow import Follower

    follower = Follower(lambda: open_archive(options), Watch, rules_of(options), keep=True)
    shown: Counter[Event] = Counter()
    while True:
        follower.look()
        if follower.begins:
            shown.clear()
        if not follower.behind:
            follower.mission.conditions(time.time(), follower.date)
            events = follower.mission.events()
            for event in (Counter(events) - shown).elements():
                answer(options, event.plain(), [_event_line(event)])
            # Those that are not kept any more do not come again.
            shown = Counter(events)
            sys.stdout.flush()
            time.sleep(_LOOK_S)


def _event_line(event: Event) -> str:
    when = "at an unknown time" if event.utc is None else iso(event.utc)[:19].replace("T", " ")
    return clean(f"{when}  {event.line}")
