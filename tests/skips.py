"""A test that is skipped shows nothing. With RASS_NO_SKIP=1, which .ci/run sets, it fails.

So what it lacks has to be installed: by tools/ci-packages if it is a program, by requirements*.lock if it is a Python
package. The reasons listed here stay reasons.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Generator

import pytest

#: How a reason begins that no package can remove.
ALLOWED: tuple[str, ...] = (
    # Recordings and figures of others.
    "needs ../shared/",
    # Firmware (docs/contribute/sitl-and-replay.md).
    "no arducopter on PATH",
    "no px4 on PATH",
    # Rights that a container may not have.
    "may not mount here",
    "no multicast here",
    "no network namespaces here",
    "no interfaces in a network namespace here",
    # What else may run here, and how Python was built.
    "PX4's ports are in use here",
    "SQLite is built into the interpreter",
)
_PROCESSOR = platform.machine()
if _PROCESSOR not in ("x86_64", "aarch64"):
    ALLOWED += ("MAVSDK 4 is not installed",)
if _PROCESSOR != "x86_64":
    ALLOWED += ("sandiaspecutils is not installed",)
if _PROCESSOR != "x86_64" or sys.version_info >= (3, 14):
    ALLOWED += ("atheris is not here",)


def _judge(report: pytest.TestReport | pytest.CollectReport) -> None:
    """A skipped report becomes a failed one, unless its reason is allowed."""
    if not (os.environ.get("RASS_NO_SKIP") and report.skipped and isinstance(report.longrepr, tuple)):
        return
    reason = report.longrepr[2].removeprefix("Skipped: ")
    if not reason.startswith(ALLOWED):
        report.outcome = "failed"
        report.longrepr = f"may not be skipped with RASS_NO_SKIP (tests/skips.py): {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Judges a test."""
    report = yield
    _judge(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Judges a file that skips itself as a whole."""
    report = yield
    _judge(report)
    return report
