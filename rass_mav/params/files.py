"""Parameter files: `NAME VALUE` lines (ArduPilot) and QGroundControl's five columns (PX4, `.params`).

QGroundControl's format: vehicle id, component id, name, value and MAV_PARAM_TYPE, separated by tabs
(https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/parameters.html).
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal, NamedTuple

from rass_mav.errors import ConfigError, os_errors_as
from rass_mav.mavlink.component import single
from rass_mav.mavlink.vehicle_parameters import TYPES, fits

from .names import needs_reboot

#: Largest file that is read, bytes.
MAX_FILE_BYTES = 1 << 20
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,15}")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_REBOOT = re.compile(r"\breboot", re.IGNORECASE)

Format = Literal["ardupilot", "qgroundcontrol"]


class Entry(NamedTuple):
    """One parameter of a file."""

    name: str
    value: float
    line: int | None
    """Line number from 1; None: it is not from a file."""
    kind: int | None
    """MAV_PARAM_TYPE; None: the format does not contain it."""
    reboot: bool
    """Whether a new value takes effect only after a reboot, as is known or as the comment above it says."""


class ParameterFile(NamedTuple):
    """The contents of a parameter file."""

    format: Format
    entries: tuple[Entry, ...]
    """In the order of the file, each name once, at least one."""


def read_file(path: str | Path) -> ParameterFile:
    """Read and check a file. Raises `ConfigError`, which names the file, the line and what was expected there."""
    with os_errors_as(ConfigError, path), Path(path).open("rb") as file:
        data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_FILE_BYTES} bytes")
    try:
        return parse_text(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def parse_text(text: str) -> ParameterFile:
    """The parameters in the text of a file. Raises `ConfigError`: `line 7: expected ...`."""
    entries: dict[str, Entry] = {}
    format: Format | None = None
    comment = ""
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            comment = f"{comment} {line}" if line else ""
            continue
        if format is None:
            format = "qgroundcontrol" if len(line.split("\t")) >= 4 else "ardupilot"
        try:
            name, value, kind = _qgroundcontrol(line) if format == "qgroundcontrol" else _ardupilot(line)
            if name in entries:
                raise ConfigError(f"{name} appears twice, first in line {entries[name].line}")
        except ConfigError as error:
            raise ConfigError(f"line {number}: {error}") from None
        entries[name] = Entry(name, value, number, kind, needs_reboot(name) or bool(_REBOOT.search(comment)))
        comment = ""
    if format is None:
        raise ConfigError("contains no parameters")
    return ParameterFile(format, tuple(entries.values()))


def _ardupilot(line: str) -> tuple[str, float, None]:
    fields = line.replace(",", " ").split()
    if len(fields) != 2:
        # This includes a comment after the value: Mission Planner would skip the parameter.
        raise ConfigError(f"expected NAME VALUE, and comments on separate lines, got {_shown(line)}")
    return _checked_name(fields[0]), _number(fields[1]), None


def _qgroundcontrol(line: str) -> tuple[str, float, int]:
    fields = [field.strip() for field in line.split("\t")]
    if len(fields) != 5:
        raise ConfigError(
            f"expected vehicle id, component id, name, value and type separated by tabs, got {_shown(line)}"
        )
    for what, id in zip(("vehicle", "component"), fields, strict=False):
        if not re.fullmatch(r"\d{1,3}", id, re.ASCII) or not 0 <= int(id) <= 255:
            raise ConfigError(f"expected a {what} id 0..255, got {_shown(id)}")
    name, value = _checked_name(fields[2]), _number(fields[3])
    kind = int(fields[4]) if re.fullmatch(r"\d{1,2}", fields[4], re.ASCII) else -1
    if kind not in TYPES:
        raise ConfigError(f"expected a type, 6 for INT32 or 9 for REAL32, got {_shown(fields[4])}")
    if not fits(value, kind):
        raise ConfigError(f"{name}: {fields[3]} is not a value of type {kind}")
    return name, value, kind


def _checked_name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise ConfigError(f"expected a name of 1 to 16 letters, digits and _, got {_shown(text)}")
    return text


def _number(text: str) -> float:
    # Python's float would also accept "nan", "1_000" and digits of other scripts.
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(single(value)):
        raise ConfigError(f"expected a number that fits 32 bits, got {_shown(text)}")
    return value


def _shown(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:60] + "...")
