"""Iso-dose contours: lines on the ground along which the readings have one value. Pure, and without numpy.

The method is marching squares on the middles of the squares that a `Field` paints. Between two middles the reading
rises or falls evenly on a logarithmic scale, as the colours do. Where nothing is painted there is no line either: it is
closed, or it ends at the edge of what is painted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from math import isfinite, log
from typing import Any, NamedTuple

from .entry import Place
from .field import Field, Grid, Square

#: The unit that has contours unless a setting gives others, and their readings.
DEFAULT_UNIT, DEFAULT_LEVELS = "usvh", (1.0, 25.0, 100.0)
#: Levels of a field, the lowest; and the range of a level.
MOST_LEVELS = 8
LEAST_LEVEL, MOST_LEVEL = 1e-6, 1e9
#: Points of all lines together. Where there would be more, the shortest are left out: forged readings may be noise.
MOST_POINTS = 20_000
# Readings that differ from a level by a larger factor count as if by this one, so that no logarithm overflows.
_FAR = 1e6

#: A side between the middles of two squares: row and column of the southern or western one, and whether it goes north.
_Side = tuple[int, int, bool]

_SOUTH, _EAST, _NORTH, _WEST = range(4)
# For each set of corners with a reading of at least the level (1: south-west, 2: south-east, 4: north-east, 8:
# north-west) the sides that a line enters and leaves by. The higher readings are to the left.
_WAYS: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((_SOUTH, _WEST),), 2: ((_EAST, _SOUTH),), 4: ((_NORTH, _EAST),), 8: ((_WEST, _NORTH),),
    3: ((_EAST, _WEST),), 6: ((_NORTH, _SOUTH),), 12: ((_WEST, _EAST),), 9: ((_SOUTH, _NORTH),),
    7: ((_NORTH, _WEST),), 11: ((_EAST, _NORTH),), 13: ((_SOUTH, _EAST),), 14: ((_WEST, _SOUTH),),
}  # fmt: skip
# Two corners that face each other are higher: with a high middle they are connected, otherwise not.
_CONNECTED = {5: ((_NORTH, _WEST), (_SOUTH, _EAST)), 10: ((_WEST, _SOUTH), (_EAST, _NORTH))}
_APART = {5: ((_SOUTH, _WEST), (_NORTH, _EAST)), 10: ((_EAST, _SOUTH), (_WEST, _NORTH))}


class Contour(NamedTuple):
    """A line. On the ground the higher readings are to its left, so a closed one around a hot spot is anticlockwise."""

    level: float
    """The reading along it, in the unit of its field."""
    line: list[Place]
    """At least two places: latitude and longitude, degrees. Across the 180th meridian, longitudes go on beyond 180."""

    @property
    def closed(self) -> bool:
        """Whether it ends where it begins. Otherwise both ends are at the edge of what is painted."""
        return len(self.line) > 2 and self.line[0] == self.line[-1]


def levels_of(unit: str, wanted: Iterable[float] | None = None, above: float | None = None) -> tuple[float, ...]:
    """The levels of a unit, ascending, at most `MOST_LEVELS`.

    :param unit: as in `Entry.painted`.
    :param wanted: those of a setting, in the unit of the readings; None: `DEFAULT_LEVELS` for uSv/h, none for others.
    :param above: the threshold of high readings (`attention.above`), which is a level too; None: there is none.
    """
    chosen = (DEFAULT_LEVELS if unit == DEFAULT_UNIT else ()) if wanted is None else tuple(wanted)
    levels = {level for level in (*chosen, *(() if above is None else (above,))) if LEAST_LEVEL <= level <= MOST_LEVEL}
    return tuple(sorted(levels)[:MOST_LEVELS])


def contours_of(field: Field, levels: Iterable[float]) -> list[Contour]:
    """The contours of all that a field paints, by level; of one, the longest first. `levels`: as of `levels_of`."""
    return trace(field.grid, {(row, column): reading for row, column, reading, _ in field.painted()}, levels)


def trace(grid: Grid, painted: Mapping[Square, float], levels: Iterable[float]) -> list[Contour]:
    """The same of painted squares and their readings. Takes time in proportion to the squares and to the points of the
    lines, whatever the readings are: those that are not finite count as not painted."""
    ways: dict[float, dict[_Side, _Side]] = {level: {} for level in levels}
    ordered = sorted(ways)
    if not ordered:
        return []
    sound = {square: reading for square, reading in painted.items() if isfinite(reading)}
    lowest, highest = ordered[0], ordered[-1]
    for (row, column), south_west in sound.items():
        south_east = sound.get((row, column + 1))
        north_west = sound.get((row + 1, column))
        north_east = sound.get((row + 1, column + 1))
        if south_east is None or north_west is None or north_east is None:
            continue
        corners = south_west, south_east, north_east, north_west
        low, high = min(corners), max(corners)
        if low >= highest or high < lowest:
            continue
        sides = (row, column, False), (row, column + 1, True), (row + 1, column, False), (row, column, True)
        for level in ordered:
            if low < level <= high:
                ways[level].update((sides[start], sides[end]) for start, end in _through(corners, level))
    return list(_bounded([one for level in ordered for one in _joined(grid, sound, ways[level], level)]))


def _through(corners: tuple[float, float, float, float], level: float) -> tuple[tuple[int, int], ...]:
    """How lines go through the square between four middles."""
    inside = sum(1 << place for place, reading in enumerate(corners) if reading >= level)
    if inside not in _APART:
        return _WAYS[inside]
    middle = sum(_height(reading, level) for reading in corners)
    return (_CONNECTED if middle >= 0 else _APART)[inside]


def _height(reading: float, level: float) -> float:
    """The logarithm of a reading as a multiple of the level: below 0 if it is lower."""
    return log(min(max(reading / level, 1 / _FAR), _FAR))


def _joined(grid: Grid, painted: Mapping[Square, float], ways: dict[_Side, _Side], level: float) -> Iterator[Contour]:
    """The lines of a level, the longest first."""
    lines = []
    # First those that end at an edge: nothing leads to their beginning.
    for first in sorted(ways.keys() - set(ways.values())):
        lines.append(_followed(ways, first))
    while ways:
        lines.append(_followed(ways, next(iter(ways))))
    for line in sorted(lines, key=len, reverse=True):
        places = [_crossing(grid, painted, side, level) for side in line]
        # Where a middle has just this reading, several sides are crossed there.
        places = [place for number, place in enumerate(places) if not number or place != places[number - 1]]
        if len(places) > 1:
            yield Contour(level, places)


def _followed(ways: dict[_Side, _Side], first: _Side) -> list[_Side]:
    """The sides of a line, which is taken out of `ways`."""
    line = [first]
    while (following := ways.pop(line[-1], None)) is not None:
        line.append(following)
    return line


def _crossing(grid: Grid, painted: Mapping[Square, float], side: _Side, level: float) -> Place:
    row, column, north = side
    there = (row + 1, column) if north else (row, column + 1)
    one, other = _height(painted[row, column], level), _height(painted[there], level)
    part = 0.5 if one == other else min(max(one / (one - other), 0.0), 1.0)
    height, width = grid.step
    latitude, longitude = grid.corner(row, column)
    return (
        latitude + (0.5 + (part if north else 0.0)) * height,
        longitude + (0.5 + (0.0 if north else part)) * width,
    )


def _bounded(found: list[Contour]) -> Iterator[Contour]:
    """Not more than `MOST_POINTS` of them, in the order of before."""
    left, kept = MOST_POINTS, set()
    for number in sorted(range(len(found)), key=lambda number: len(found[number].line), reverse=True):
        left -= len(found[number].line)
        if left < 0:
            break
        kept.add(number)
    return (one for number, one in enumerate(found) if number in kept)


def plain(contours: Iterable[Contour]) -> list[dict[str, Any]]:
    """As plain values for JSON: `level`, `closed`, and the `line` as latitudes and longitudes, to the centimetre."""
    return [
        {"level": one.level, "closed": one.closed, "line": [[round(lat, 7), round(lon, 7)] for lat, lon in one.line]}
        for one in contours
    ]


def features(contours: Iterable[Contour], unit: str) -> list[dict[str, Any]]:
    """As features of GeoJSON (RFC 7946): lines. `unit`: as in `Entry.painted`."""
    return [
        {
            "type": "Feature",
            "geometry": {
                "type": "LineString", "coordinates": [[round(lon, 7), round(lat, 7)] for lat, lon in one.line],
            },
            "properties": {"what": "contour", "level": one.level, "unit": unit or None, "closed": one.closed},
        }
        for one in contours
    ]  # fmt: skip
