"""What formats demand of a datum, and why one is left out.

A reason that can be mended says how after a colon. Such reasons come first where people are told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from .entry import Entry, Place

#: The most that a date may be wrong by where a format has no room to say so, seconds.
MOST_ERROR_S = 60.0
#: The dates that every calendar here has: 1970 to 9999, seconds since 1970.
LAST_S = 253_402_300_799.0


class LeftOutError(Exception):
    """A format cannot hold a datum, and why."""


def counted(why: Counter[str]) -> str:
    """Reasons with their counts: first those that can be mended, then the most frequent."""
    first = sorted(why.items(), key=lambda one: (": " not in one[0], -one[1], one[0]))
    return "; ".join(f"{count}: {reason}" for reason, count in first)


def reading_of(entry: Entry) -> tuple[float, str]:
    """A reading and its unit, a key of `UNITS`. Raises `LeftOutError`."""
    m = entry.measurement
    if m is None:
        raise LeftOutError("no measurement")
    if entry.reading is None:
        raise LeftOutError("no reading")
    if m.unit is None:
        raise LeftOutError("unit unknown: set risk.unit on the drone")
    return entry.reading, m.unit


def date_of(entry: Entry) -> float:
    """When a datum was created, seconds since 1970, right to `MOST_ERROR_S`. Raises `LeftOutError`."""
    if entry.at_least:
        raise LeftOutError("possibly older than its date")
    if entry.error_s is None:
        raise LeftOutError("time unknown: set node.clock")
    if not 0.0 <= entry.utc <= LAST_S:
        raise LeftOutError("impossible date")
    if entry.error_s > MOST_ERROR_S:
        raise LeftOutError(f"time not known to {MOST_ERROR_S:g} s")
    return entry.utc


def place_of(entry: Entry) -> Place:
    """Where it was measured. Raises `LeftOutError`."""
    if entry.place is None:
        raise LeftOutError("no position")
    return entry.place


class DoseRate(NamedTuple):
    """A measured dose rate that a format of radiation protection takes."""

    entry: Entry
    value: float
    """uSv/h, at least 0."""
    utc: float
    """As of `date_of`."""


def dose_rates(entries: Iterable[Entry], left_out: Counter[str], *, placed: bool) -> Iterator[DoseRate]:
    """The dose rates among data; the others are counted. `placed`: only those with a place on Earth."""
    for entry in entries:
        try:
            yield _dose_rate(entry, placed)
        except LeftOutError as reason:
            left_out[str(reason)] += 1


def _dose_rate(entry: Entry, placed: bool) -> DoseRate:
    value, unit = reading_of(entry)
    if unit != "usvh":
        raise LeftOutError(f"unit {unit}, no dose rate: set sensor.unit on the drone to usvh")
    if value < 0.0:
        raise LeftOutError("reading below 0")
    if placed:
        place_of(entry)
    return DoseRate(entry, value, date_of(entry))
