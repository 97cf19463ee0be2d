"""`doctor`: checks whether everything that a node needs is there."""

from __future__ import annotations

import argparse
import sys

from .common import Subparsers, add_command, answer, clean, painted, start_logging

_COLOURS = {"skip": "cyan", "pass": "green", "warn": "yellow", "fail": "red"}

#: A wheel has no pages: remedies name them as "documentation: how-to/keys".
DOCUMENTATION = "documentation: the pages in docs/ of the source of rass-mav"


def register(subparsers: Subparsers) -> None:
    """Add the command."""
    doctor = add_command(
        subparsers, "doctor", _doctor,
        help="check a node and its surroundings, running or not; exit code 1 if a check fails",
        example="rass-mav doctor drone.yaml",
    )  # fmt: skip
    doctor.add_argument("config", metavar="CONFIG.yaml", help="the node's configuration")


def _doctor(options: argparse.Namespace) -> int:
    from rass_mav.doctor.checkup import check_up

    # This command reports what is wrong. Logs would repeat it.
    start_logging(options.verbose, "critical")
    report = check_up(options.config)
    lines = [
        painted(finding.level, _COLOURS[finding.level], sys.stdout) + clean(finding.line()).removeprefix(finding.level)
        for finding in report.findings
    ]
    counts = f"{report.count('pass')} passed, {report.count('warn')} warned, {report.count('fail')} failed"
    lines.append(f"{counts}, {skipped} not checked" if (skipped := report.count("skip")) else counts)
    if any("documentation" in finding.remedy for finding in report.findings):
        lines.append(DOCUMENTATION)
    answer(options, report.plain(), lines)
    return 1 if report.count("fail") else 0
