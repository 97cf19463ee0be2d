"""Squares of a map as polygons."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

#: A corner of a square: its column and row.
Corner = tuple[int, int]


def outlines(inside: npt.NDArray[np.bool_]) -> list[list[Corner]]:
    """The outlines of the squares that are inside, each closed and anticlockwise. Holes are filled."""
    full = _filled(np.pad(inside, 1))
    # Each side between inside and outside, with the inside to its left.
    ways: dict[Corner, list[Corner]] = {}
    for row, column in np.argwhere(full).tolist():
        for (dy, dx), start, end in (
            ((-1, 0), (0, 0), (1, 0)), ((0, 1), (1, 0), (1, 1)), ((1, 0), (1, 1), (0, 1)), ((0, -1), (0, 1), (0, 0)),
        ):  # fmt: skip
            if not full[row + dy, column + dx]:
                # Without the border that was added.
                here, there = (column + start[0] - 1, row + start[1] - 1), (column + end[0] - 1, row + end[1] - 1)
                ways.setdefault(here, []).append(there)
    rings = []
    while ways:
        at = first = next(iter(ways))
        ring = [at]
        while True:
            following = ways[at].pop()
            if not ways[at]:
                del ways[at]
            if len(ring) > 1 and _straight(ring[-2], ring[-1], following):
                ring.pop()
            ring.append(following)
            at = following
            if at == first:
                break
        rings.append(ring)
    return rings


def _straight(a: Corner, b: Corner, c: Corner) -> bool:
    return (b[0] - a[0]) * (c[1] - b[1]) == (b[1] - a[1]) * (c[0] - b[0])


def _filled(inside: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """With all that the outside does not reach. `inside`: with a free border."""
    outside = np.zeros_like(inside)
    outside[0, 0] = True
    while True:
        more = outside.copy()
        more[1:] |= outside[:-1]
        more[:-1] |= outside[1:]
        more[:, 1:] |= outside[:, :-1]
        more[:, :-1] |= outside[:, 1:]
        more &= ~inside
        if (more == outside).all():
            return ~outside
        outside = more
