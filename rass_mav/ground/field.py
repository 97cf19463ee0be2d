"""Readings on the ground, as squares of a grid. Nothing is painted where nothing was measured."""

from __future__ import annotations

from collections.abc import Iterable
from math import cos, radians
from typing import NamedTuple

#: The side of a square at first, metres, and the most squares with a reading. Where there are more, sides double.
SIDE_M = 10.0
MOST_SQUARES = 5000
#: A square without a reading is painted if the middle of one with a reading is at most so many sides away.
REACH = 2
#: Metres in a degree of latitude.
DEGREE_M = 111_320.0
# Nearer to a pole than 75 degrees the squares are not square: if the first place is forged, those of all others are at
# most four times as wide as high.
_LEAST_COSINE = 0.25

#: A row and a column of the grid, to the north and to the east of its origin.
Square = tuple[int, int]

# Squares within reach, each with the square of its distance in sides.
_DISC = [
    (row, column, row * row + column * column)
    for row in range(-REACH, REACH + 1)
    for column in range(-REACH, REACH + 1)
    if 0 < row * row + column * column <= REACH * REACH
]


class Painted(NamedTuple):
    """A square that is painted."""

    row: int
    column: int
    reading: float
    """The mean of the readings in it, or between those of the squares around it."""
    readings: int
    """How many are in it; 0: it is interpolated."""


class Grid(NamedTuple):
    """Where the squares are."""

    origin: tuple[float, float]
    """The south-west corner of square (0, 0): latitude and longitude, degrees."""
    side_m: float
    """The side of a square, metres."""

    @property
    def step(self) -> tuple[float, float]:
        """The height and width of a square, degrees."""
        cosine = max(cos(radians(self.origin[0])), _LEAST_COSINE)
        return self.side_m / DEGREE_M, self.side_m / DEGREE_M / cosine

    def square(self, place: tuple[float, float]) -> Square:
        """The square with a place: latitude and longitude, degrees. The grid crosses the 180th meridian."""
        height, width = self.step
        east = (place[1] - self.origin[1] + 180.0) % 360.0 - 180.0
        return int((place[0] - self.origin[0]) // height), int(east // width)

    def corner(self, row: int, column: int) -> tuple[float, float]:
        """The south-west corner of a square: latitude and longitude, degrees."""
        height, width = self.step
        return self.origin[0] + row * height, self.origin[1] + column * width


class Field:
    """Readings of one unit."""

    def __init__(self, origin: tuple[float, float], side_m: float = SIDE_M) -> None:
        """`origin`: latitude and longitude of some place near the readings, degrees."""
        self.grid = Grid(origin, side_m)
        self.sums: dict[Square, tuple[float, int]] = {}
        """For each square with readings their sum and how many there are."""
        self._changed: set[Square] = set()

    def add(self, place: tuple[float, float], reading: float) -> None:
        """Add a reading, as `Entry.painted` has it, at a latitude and longitude, degrees: no sum of them overflows."""
        square = self.grid.square(place)
        total, count = self.sums.get(square, (0.0, 0))
        self.sums[square] = total + reading, count + 1
        self._changed.add(square)
        while len(self.sums) > MOST_SQUARES:
            self._widen()

    def _widen(self) -> None:
        self.grid = Grid(self.grid.origin, self.grid.side_m * 2)
        old, self.sums = self.sums, {}
        for (row, column), (total, count) in old.items():
            square = row >> 1, column >> 1
            more, others = self.sums.get(square, (0.0, 0))
            self.sums[square] = total + more, count + others
        self._changed = set(self.sums)

    @property
    def reach_m(self) -> float:
        """How far from a reading something is painted, metres."""
        return REACH * self.grid.side_m

    def painted(self) -> list[Painted]:
        """All squares that are painted."""
        return self._paint(self.sums)

    def changes(self) -> list[Painted]:
        """Those that are painted differently since the last call."""
        changed, self._changed = self._changed, set()
        return self._paint(changed)

    def _paint(self, squares: Iterable[Square]) -> list[Painted]:
        """These squares with readings, and all around them."""
        wanted = set(squares)
        wanted.update([(row + north, column + east) for row, column in wanted for north, east, _ in _DISC])
        return [self._painted(*square) for square in sorted(wanted)]

    def _painted(self, row: int, column: int) -> Painted:
        if (found := self.sums.get((row, column))) is not None:
            return Painted(row, column, found[0] / found[1], found[1])
        weights = total = 0.0
        for north, east, distance in _DISC:
            if (near := self.sums.get((row + north, column + east))) is not None:
                weights += 1 / distance
                total += near[0] / near[1] / distance
        return Painted(row, column, total / weights, 0)
