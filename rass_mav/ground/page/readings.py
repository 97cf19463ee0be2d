"""The readings of a mission: all of them, or of every so many where there are many."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import NamedTuple

#: Readings that are kept. Of more, every second one is dropped, and from then on only every second one is taken.
MOST_READINGS = 100_000


class Reading(NamedTuple):
    """A reading with a place."""

    utc: float
    """Seconds since 1970."""
    drone: int
    latitude: float
    longitude: float
    """Degrees."""
    value: float
    unit: str
    """A key of `UNITS`; empty: unknown."""


class Readings:
    """They are kept as numbers side by side, 41 bytes each."""

    def __init__(self, most: int = MOST_READINGS) -> None:
        self.every = 1
        """Of so many readings one is kept."""
        self._most = most
        self._come = 0
        self._numbers = array("d")
        """Time, latitude, longitude and value of each."""
        self._drones = array("Q")
        self._units = array("B")
        self._names: list[str] = []

    def take(self, reading: Reading) -> None:
        """Add one."""
        self._come += 1
        if self._come % self.every:
            return
        if reading.unit not in self._names:
            self._names.append(reading.unit)
        self._numbers.extend((reading.utc, reading.latitude, reading.longitude, reading.value))
        self._drones.append(reading.drone)
        self._units.append(self._names.index(reading.unit))
        if len(self._drones) > self._most:
            self._thin()

    def _thin(self) -> None:
        numbers = self._numbers
        kept = array("d", bytes(8 * 4 * len(self._drones[::2])))
        for column in range(4):
            kept[column::4] = numbers[column::8]
        self._numbers, self._drones, self._units = kept, self._drones[::2], self._units[::2]
        self.every *= 2

    def __len__(self) -> int:
        return len(self._drones)

    def until(self, time: float) -> Iterator[Reading]:
        """Those that are not later than `time`, seconds since 1970, in the order in which they came."""
        numbers = iter(self._numbers)
        rows = zip(numbers, numbers, numbers, numbers, self._drones, self._units, strict=False)
        for utc, latitude, longitude, value, drone, unit in rows:
            if utc <= time:
                yield Reading(utc, drone, latitude, longitude, value, self._names[unit])

    def of(self, drone: int) -> Iterator[Reading]:
        """Those of a drone."""
        return (reading for reading in self.until(float("inf")) if reading.drone == drone)
