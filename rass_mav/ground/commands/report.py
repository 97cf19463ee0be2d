"""`report`: what has become of a mission's data."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rass_mav.commands.common import Subparsers, add_command, answer, clean, start_logging
from rass_mav.errors import RassError, os_errors_as
from rass_mav.ground.report import FAULT_TEXTS, conflicts, range_text, silence, span

from .data import add_store, read_archive
from .export import refuse_existing

#: The first line of the table of drones.
HEADER = (
    f"{'DRONE':>5} {'CREATED':>8} {'ARRIVED':>8} {'MISSING':>8} {'LOST':>6} {'AT RISK':>8} {'AT MOST':>8} "
    f"{'HEARD':>7}  LAST PLACE, HIGHEST READING"
)


def report_lines(report: dict[str, Any]) -> Iterator[str]:
    """The report in lines. Created: at least so many. Missing: on their way, or lost without anybody knowing."""
    yield silence(report)
    delay = report["delay_s"]
    line = ", ".join(f"{report[name]} {name}" for name in ("created", "arrived", "missing", "lost"))
    if delay["p50"] is not None:
        line += f"; half arrived within {span(delay['p50'])}, 95 % within {span(delay['p95'])}"
    yield line
    if report["apart"]:
        yield f"WARNING: {conflicts(report['apart'])}"
    yield from report["off_map"]
    yield HEADER
    for drone in report["drones"]:
        yield clean(_drone_line(drone))
        yield from (f"      {clean(line)}" for line in _remarks(drone))


def _drone_line(drone: dict[str, Any]) -> str:
    heard = "never" if drone["heard"] is None else span(drone["heard"]["age_s"])
    risk = "unknown" if drone["at_risk"] is None else str(drone["at_risk"])
    most = "" if (bound := drone["at_most"]) is None else f"{bound['data']}{'+' if bound['drones_unknown'] else ''}"
    line = (
        f"{drone['drone']:>5} {drone['created']:>8} {drone['arrived']:>8} {drone['missing']:>8} "
        f"{sum(drone['lost'].values()):>6} {risk:>8} {most:>8} {heard:>7}  "
    )
    place = "nowhere yet" if drone["place"] is None else "{:.7f} {:.7f}".format(*drone["place"])
    if (highest := drone["highest"]) is None:
        return line + place
    where = "" if highest["place"] is None else " at {:.7f} {:.7f}".format(*highest["place"])
    return f"{line}{place}, {highest['reading']:g}{_unit(highest['unit'])}{where}"


def _remarks(drone: dict[str, Any]) -> Iterator[str]:
    if (named := drone["heard_by"]) is not None:
        base = "a base, " if named["base"] else ""
        yield f"{base}heard by drone {named['drone']} {span(named['age_s'])} ago; nothing has arrived"
    for fate, count in drone["lost"].items():
        yield f"lost: {count} {fate}"
    for store_fault in drone["wounds"]:
        yield f"it {FAULT_TEXTS[store_fault]}"
    if drone["missing_numbers"]:
        ranges = [range_text(row) for row in drone["missing_numbers"][-_MOST_SHOWN:]]
        more = len(drone["missing_numbers"]) - len(ranges)
        yield f"missing: {', '.join(ranges)}" + (f", and {more} ranges before" if more else "")
    if (status := drone["status"]) is not None:
        battery = "" if status["battery"] is None else f", battery {status['battery']} %"
        key = "" if status["link_key"] is None else f", link key {status['link_key']}"
        route = "no route" if status["hops"] is None else f"{status['hops']} hops"
        yield (
            f"{span(status['age_s'])} ago: {status['held']} in custody, {status['alone']} of them nowhere else, "
            f"{route}, risk {status['risk']:.2f}{battery}{key}; newer: unknown"
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
        help="report what has become of the data of each drone: arrived, missing, lost, at risk",
        example="rass-mav report base.yaml",
    )  # fmt: skip
    add_store(report)
    report.add_argument(
        "--html", type=Path, metavar="FILE", help="also write it with a map to one file, to mail or to print"
    )


def _report(options: argparse.Namespace) -> int:
    from rass_mav.ground.report import Report

    start_logging(options.verbose)
    with read_archive(options) as archive:
        if options.html is None:
            plain = Report.of(archive).plain(time.time())
        else:
            from rass_mav.ground import html

            refuse_existing(options.html)
            with os_errors_as(RassError, options.html):
                plain = html.write(archive, options.html, time.time())
    answer(options, plain, report_lines(plain))
    return 0
