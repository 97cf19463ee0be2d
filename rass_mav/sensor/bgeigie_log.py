"""Recorded bGeigie logs (.LOG): lines with comments and sentences, some of them damaged."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from rass_mav.errors import ConfigError, LogError, MalformedError, os_errors_as

from .bgeigie import Record, decode_record
from .protocol import MAX_LINE

#: A record without a fix is accepted if its time is at most this far from the records with a fix, microseconds. A
#: device without a fix may never have set its clock. A day is longer than its battery lasts.
UNSURE_US = 86_400_000_000


@dataclass
class BgeigieLog:
    """The contents of a log."""

    records: list[Record] = field(default_factory=list)
    """In order of time."""
    read: int = 0
    """How many measurements there are, plus lines or parts of lines that are neither measurement nor comment."""
    rejected: int = 0
    """How many of these are not in `records`."""
    trouble: str = ""
    """Why the first of these was rejected, with its line."""


def read_bgeigie(file: BinaryIO) -> BgeigieLog:
    """Read a log. Never raises because of its contents. The work is linear in its size.

    :param file: open for reading, in binary; the caller closes it.
    """
    log = BgeigieLog()
    number = 0
    inside = False
    while line := file.readline(MAX_LINE):
        ended = line.endswith(b"\n")
        if not inside:
            number += 1
            if ended or len(line) < MAX_LINE:
                _take_line(log, line.strip(), number)
            else:
                # Reject an overlong line once, however long it is.
                _reject(log, number, MalformedError(f"a line of {MAX_LINE} bytes or more"))
        inside = not ended
    _leave_out_unset_clocks(log)
    log.records.sort(key=lambda record: record.time_us)
    return log


def load_bgeigie(path: str) -> BgeigieLog:
    """Read a log file. Raises `ConfigError` if it cannot be opened, `LogError` if it has no valid record."""
    with os_errors_as(ConfigError, path), Path(path).open("rb") as file:
        log = read_bgeigie(file)
    if not log.records:
        why = f" ({log.rejected} rejected; {log.trouble})" if log.rejected else ""
        raise LogError(f"{path}: no valid bGeigie record{why}")
    return log


def _take_line(log: BgeigieLog, line: bytes, number: int) -> None:
    if line.startswith(b"#"):
        return
    # If power was lost within a line, the next sentence is on the same line.
    before, *sentences = line.split(b"$")
    if before:
        _reject(log, number, MalformedError("neither a sentence nor a comment"))
    for sentence in sentences:
        try:
            record = decode_record(b"$" + sentence)
        except MalformedError as error:
            _reject(log, number, error)
            continue
        if record is not None:
            log.read += 1
            log.records.append(record)


def _reject(log: BgeigieLog, number: int, error: MalformedError) -> None:
    log.read += 1
    log.rejected += 1
    log.trouble = log.trouble or f"line {number}: {error}"


def _leave_out_unset_clocks(log: BgeigieLog) -> None:
    sure = [record.time_us for record in log.records if record.place is not None]
    if not sure:
        return
    first, last = min(sure) - UNSURE_US, max(sure) + UNSURE_US
    kept = [record for record in log.records if first <= record.time_us <= last]
    if len(kept) < len(log.records):
        log.trouble = log.trouble or "a time from a clock that was not set"
        log.rejected += len(log.records) - len(kept)
        log.records = kept
