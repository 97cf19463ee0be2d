"""Readings as the estimate takes them, gathered from the data that have arrived. Bounded, and without numpy."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from rass_mav.ground.entry import Entry

#: Readings that are kept. Where there are more, one of two, of four and so on, evenly over the mission.
MOST_READINGS = 10_000


class Sample(NamedTuple):
    """A reading and where it was taken."""

    drone: int
    utc: float
    """When, seconds since 1970."""
    latitude: float
    longitude: float
    """Degrees."""
    altitude: float
    """Metres above mean sea level."""
    value: float
    """>= 0, in the unit of the set."""
    error_m: float | None
    """Standard deviation of the place on each axis, metres; None: unknown."""


class Samples:
    """The readings of each unit, as they arrive."""

    def __init__(self) -> None:
        self.by_unit: dict[str, list[Sample]] = {}
        """By unit; empty: unknown."""
        self.changes = 0
        """How many have come."""
        self._every: Counter[str] = Counter()
        self._seen: Counter[str] = Counter()

    def take(self, entry: Entry) -> None:
        """A datum that has arrived. What is no reading with a place on Earth, or a second content of an id, is left
        out."""
        if entry.apart or entry.painted is None or entry.measurement is None:
            return
        place, value, unit = entry.painted
        # Sensors that subtract their background may read a little less than nothing.
        if not (math.isfinite(value) and math.isfinite(entry.utc)):
            return
        self.changes += 1
        self._seen[unit] += 1
        if self._seen[unit] % max(self._every[unit], 1):
            return
        bound = entry.measurement.error_m
        kept = self.by_unit.setdefault(unit, [])
        # The bound is twice the standard deviation (docs/how-to/data.md).
        kept.append(
            Sample(
                entry.id.origin, entry.utc, *place, entry.altitude or 0.0, max(value, 0.0),
                None if bound is None else bound / 2,
            )
        )  # fmt: skip
        if len(kept) > MOST_READINGS:
            del kept[::2]
            self._every[unit] = 2 * max(self._every[unit], 1)

    def watch(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """Take the data on their way to another reader."""
        for entry in entries:
            self.take(entry)
            yield entry

    @property
    def main(self) -> tuple[str, list[Sample]]:
        """The unit of most readings, and these; none: an empty list."""
        return max(self.by_unit.items(), key=lambda one: len(one[1]), default=("", []))
