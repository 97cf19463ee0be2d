"""`report`: what has become of a mission's data."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rass_mav.commands.common import Subparsers, add_command, answer, start_logging
from rass_mav.errors import RassError, os_errors_as

from .data import add_store, read_archive
from .export import refuse_existing


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

    from .report_lines import report_lines

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
