"""The computer: Python, packages, the clock."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterable, Mapping
from importlib import metadata
from pathlib import Path

from rass_mav.app.clock import date, impossible
from rass_mav.app.config import RunConfig
from rass_mav.errors import installing
from rass_mav.mavlink.crc import HAVE_FASTCRC

from .finding import Finding, failed, passed, warned
from .ports import serial_ports

#: The oldest supported version (pyproject.toml, requires-python).
LEAST_PYTHON = (3, 10)
#: Always needed; pyserial comes with a serial port.
PACKAGES = ("pymavlink", "pyyaml")
#: A file may be this far in the future before the clock counts as doubtful, seconds.
_SLACK_S = 60.0


def python(version: tuple[int, ...], executable: str) -> Finding:
    """Is Python new enough? `version`: the interpreter's, at least two numbers."""
    text = f"{'.'.join(map(str, version))} on {platform.machine()} ({executable})"
    if version[:2] < LEAST_PYTHON:
        least = ".".join(map(str, LEAST_PYTHON))
        return failed("python", text, f"install Python {least} or newer, then reinstall rass-mav")
    return passed("python", text)


def needed_packages(config: RunConfig | None) -> list[str]:
    """The packages that this configuration needs; None: unknown."""
    names = list(PACKAGES)
    if config is not None and any(serial_ports(config)):
        names.append("pyserial")
    return names


def packages(
    names: Iterable[str], version: Callable[[str], str] = metadata.version, least: Mapping[str, str] | None = None
) -> Finding:
    """Are these packages installed, and new enough?

    :param version: returns the version of an installed package, or raises `PackageNotFoundError`.
    :param least: lowest version by name; None: those that the installed rass-mav requires.
    """
    least = demanded() if least is None else least
    found, wrong = [], []
    for name in names:
        try:
            installed = version(name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{name} is missing")
            continue
        if _numbers(installed) < _numbers(least.get(name, "0")):
            wrong.append(f"{name} is {installed}, expected {least[name]} or newer")
        found.append(f"{name} {installed}")
    if wrong:
        return failed("packages", ", ".join(wrong), f"{installing('drone')}, in the same environment")
    extra = "" if HAVE_FASTCRC else "; without fastcrc, decoding frames takes longer"
    return passed("packages", ", ".join(found) + extra)


def demanded() -> dict[str, str]:
    """The lowest versions that the installed rass-mav requires; empty if it runs from its source."""
    try:
        requirements = metadata.requires("rass-mav") or []
    except metadata.PackageNotFoundError:
        return {}
    matches = (re.match(r"([A-Za-z0-9_.-]+)\s*>=\s*([0-9.]+)", requirement) for requirement in requirements)
    return {match[1].lower(): match[2] for match in matches if match}


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)[:3]))


def clock(now: float, store: Path, root: Path = Path("/")) -> Finding:
    """Can the date be right? A Raspberry Pi has no clock that runs without power.

    :param now: seconds since 1970.
    :param store: the store's file, which was written before now.
    :param root: the folder with `run` and `sys`.
    """
    shown = date(now)
    remedy = "dates in the data would be wrong: connect to a time server or add a real-time clock (RTC)"
    if impossible(now) is not None:
        return warned("clock", f"shows {shown}, which is impossible", remedy)
    try:
        written = store.stat().st_mtime
    except OSError:
        written = 0.0
    if written > now + _SLACK_S:
        return warned("clock", f"shows {shown}, but the store was written at {date(written)}", remedy)
    if (root / "run/systemd/timesync/synchronized").exists():
        return passed("clock", f"{shown}, set by a time server")
    rtc = root / "sys/class/rtc"
    if rtc.is_dir() and any(rtc.iterdir()):
        return passed("clock", f"{shown}, from a real-time clock")
    return warned("clock", f"shows {shown}, and no real-time clock or time server was found", remedy)
