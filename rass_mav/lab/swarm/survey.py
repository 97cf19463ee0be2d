"""Survey patterns: the ways that drones fly over a rectangular area, and the way of a base around it.

The area's centre is the origin. Each drone surveys a block of its own, in parallel strips there and back again.
"""

from __future__ import annotations

from typing import NamedTuple

from rass_mav.lab.medium.neighbours import Position


class Block(NamedTuple):
    """A rectangle, metres."""

    west: float
    south: float
    width: float
    height: float


def blocks(drones: int, width: float, height: float) -> list[Block]:
    """One block for each drone. Together they cover the area, all are equally large, and they are about square.

    They lie in rows, from the south, and each row from the west. Where the drones do not fill the rows evenly, some
    rows have one block more than others, and are higher.

    :param drones: at least 1.
    :param width: of the area from west to east, metres, > 0.
    :param height: from south to north, metres, > 0.
    """
    rows = min(max(round((drones * height / width) ** 0.5), 1), drones)
    found = []
    south = -height / 2
    for row in range(rows):
        # Those that are left over are spread over the rows.
        columns = (row + 1) * drones // rows - row * drones // rows
        high = height * columns / drones
        wide = width / columns
        found += [Block(-width / 2 + column * wide, south, wide, high) for column in range(columns)]
        south += high
    return found


class Lawnmower:
    """A way in parallel strips over a block: along the first to the east, along the next to the west, and so on."""

    def __init__(self, block: Block, strip_m: float) -> None:
        """`strip_m`: the most that two strips may be apart, metres, > 0."""
        strips = max(-int(-block.height // strip_m), 1)
        self._gap = block.height / strips
        # The ends of a strip are as far from the edge of the block as its sides.
        inset = min(self._gap, block.width) / 2
        self._long = block.width - 2 * inset
        self._west = block.west + inset
        self._south = block.south + self._gap / 2
        self.length_m = strips * self._long + (strips - 1) * self._gap
        """Of the way from one end to the other, metres; 0 in a block that one place covers."""

    def at(self, metres: float) -> Position:
        """The place after so many metres (any number) along the way, from its end back to its start, and so on."""
        if not self.length_m:
            return self._west, self._south
        along = metres % (2 * self.length_m)
        if along > self.length_m:
            along = 2 * self.length_m - along
        strip, rest = divmod(along, self._long + self._gap)
        east = min(rest, self._long)
        if strip % 2:
            east = self._long - east
        return self._west + east, self._south + strip * self._gap + max(rest - self._long, 0.0)


class Perimeter:
    """The way along the edge of the area, anticlockwise, from the middle of the south side."""

    def __init__(self, width: float, height: float) -> None:
        self._width = width
        self._height = height
        self.length_m = 2 * (width + height)

    def at(self, metres: float) -> Position:
        """The place after so many metres (any number)."""
        width, height = self._width, self._height
        along = (metres + width / 2) % self.length_m
        if along <= width:
            return along - width / 2, -height / 2
        along -= width
        if along <= height:
            return width / 2, along - height / 2
        along -= height
        if along <= width:
            return width / 2 - along, height / 2
        return -width / 2, height / 2 - (along - width)
