"""Hot spots: where readings were high, the highest first. The one definition of the report, the page and the list of
what needs attention. Pure, and without numpy.

A **high** reading is one above `attention.above`; without that setting, one above 100 uSv/h, or at which its drone's
own risk is 1 (`is_high`). A **hot spot** is a place with a high reading such that no higher one is within `SPOT_M`. It
is **new** if there was no high reading near it before. A hot spot is what was measured; where the sources are that
caused it is an estimate (`ground.sources`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from heapq import heapify, heappop
from math import cos, floor, radians
from typing import Any, NamedTuple

from .attention.conditions import place_text, reading_text
from .contours import DEFAULT_LEVELS, DEFAULT_UNIT
from .entry import Entry, Place, iso, shown_reading
from .field import DEGREE_M

#: A hot spot is at least so far from all others, metres.
SPOT_M = 100.0
#: Places that a drone can report, `SPOT_M` wide; of more, only those where others have reported some count.
MOST_CELLS = 500
#: Hot spots that are listed, and those of them that one drone can fill.
MOST_SPOTS, MOST_OF_DRONE = 20, 10
#: Without a threshold: a reading at which its drone's own risk is this much is high.
HIGHEST_RISK = 0.999

#: A row and a column of cells, to the north of the equator and to the east of Greenwich.
_Cell = tuple[str, int, int]


class HotSpot(NamedTuple):
    """A place with a high reading."""

    reading: float
    """The highest within `SPOT_M`, in `unit`."""
    unit: str
    """As in `Entry.painted`; empty: unknown."""
    place: Place
    """Where: latitude and longitude, degrees."""
    utc: float
    """When, seconds since 1970."""
    drone: int
    """The node id of the drone that measured it."""
    id: str
    """The name of its datum."""

    def plain(self) -> dict[str, Any]:
        """As plain values for JSON."""
        about = {"reading": shown_reading(self.reading), "unit": self.unit or None, "utc": iso(self.utc)}
        return {**self._asdict(), **about, "place": list(self.place)}

    @property
    def text(self) -> str:
        """For people: the place, to be copied, and the reading."""
        return f"{place_text(self.place)}, {reading_text(self.reading, self.unit)}"


def is_high(entry: Entry, above: float | None) -> bool:
    """Whether the reading of a measurement is high. `above`: the threshold; None: the highest of the usual levels, in
    their unit, and its drone's own risk."""
    reading, measurement = entry.reading, entry.measurement
    if reading is None or measurement is None:
        return False
    if above is not None:
        return reading > above
    return measurement.risk >= HIGHEST_RISK or (measurement.unit == DEFAULT_UNIT and reading > DEFAULT_LEVELS[-1])


class HotSpots:
    """The hot spots of a mission, from its measurements in the order of arrival. What one drone sends can fill neither
    the memory nor the list."""

    def __init__(self) -> None:
        self.changes = 0
        """While it stays the same, so do the spots."""
        self._peaks: dict[_Cell, HotSpot] = {}
        """The highest of each cell."""
        self._reported: Counter[int] = Counter()
        """How many cells a drone was the first to report."""
        self._listed: tuple[int, list[HotSpot]] = 0, []

    def take(self, entry: Entry, above: float | None) -> HotSpot | None:
        """A datum that has arrived. `above`: as of `is_high`. Returns the new hot spot that it begins; None: it is no
        high reading with a place on Earth, or there was one near it before."""
        if entry.painted is None or not is_high(entry, above):
            return None
        place, reading, unit = entry.painted
        cell = _cell_of(place, unit)
        known = self._peaks.get(cell)
        if known is None:
            if self._reported[entry.id.origin] >= MOST_CELLS:
                return None
            self._reported[entry.id.origin] += 1
        elif reading <= known.reading:
            return None
        _, row, column = cell
        near = ((unit, row + y, column + x) for y in (-1, 0, 1) for x in (-1, 0, 1))
        new = not any(other in self._peaks for other in near)
        spot = self._peaks[cell] = HotSpot(reading, unit, place, entry.utc, entry.id.origin, entry.name)
        self.changes += 1
        return spot if new else None

    def highest(self) -> list[HotSpot]:
        """Those that are listed: of each unit the highest reading first; the unit of most places comes first. The
        caller does not change the list, which is another one when the spots have changed."""
        if self._listed[0] != self.changes:
            self._listed = self.changes, self._find()
        return self._listed[1]

    def _find(self) -> list[HotSpot]:
        units = Counter(unit for unit, _, _ in self._peaks)
        # A heap: it is seldom read to its end, however many places were forged.
        heap = [
            (-units[peak.unit], peak.unit, -peak.reading, peak.utc, peak.id, cell) for cell, peak in self._peaks.items()
        ]
        heapify(heap)
        found: list[HotSpot] = []
        by_drone: Counter[int] = Counter()
        while heap and len(found) < MOST_SPOTS:
            spot = self._peaks[heappop(heap)[-1]]
            if by_drone[spot.drone] < MOST_OF_DRONE and not any(_near(spot, other) for other in found):
                by_drone[spot.drone] += 1
                found.append(spot)
        return found


def _cell_of(place: Place, unit: str) -> _Cell:
    row = floor(place[0] * DEGREE_M / SPOT_M)
    return unit, row, floor(place[1] * DEGREE_M * max(cos(radians(row * SPOT_M / DEGREE_M)), 0.01) / SPOT_M)


def _near(one: HotSpot, other: HotSpot) -> bool:
    """Whether they are the same hot spot."""
    north = (one.place[0] - other.place[0]) * DEGREE_M
    # Across the 180th meridian too.
    east = ((one.place[1] - other.place[1] + 180.0) % 360.0 - 180.0) * DEGREE_M * cos(radians(one.place[0]))
    return one.unit == other.unit and north * north + east * east < SPOT_M * SPOT_M


# -- for people --------------------------------------------------------------------------------------------------------


def report_lines(spots: Iterable[dict[str, Any]]) -> list[str]:
    """Hot spots in lines of text, below a report. `spots`: as of `HotSpot.plain`. None: no line."""
    lines = [
        f"{number:>6}. {place_text(spot['place'])}, {reading_text(spot['reading'], spot['unit'])}, "
        f"drone {spot['drone']}, {spot['utc'][:19].replace('T', ' ')}"
        for number, spot in enumerate(spots, 1)
    ]
    return [f"hot spots: {len(lines)}, the highest first", *lines] if lines else []
