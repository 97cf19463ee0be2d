"""The places of nodes in metres, and which nodes are in range of each other."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rass_mav.lab.medium.neighbours import TOLERANCE_M
from rass_mav.lab.swarm.autopilot import METRES_PER_DEGREE

#: East, north and up, in metres.
Point = tuple[float, float, float]


class Projection:
    """An equirectangular projection around a place: metres east, north and up of it.

    Within 10 km of the place, and below 70 degrees of latitude, distances are accurate to 1 %.
    """

    def __init__(self, latitude: float, longitude: float, altitude: float) -> None:
        """The place: degrees, degrees, metres above mean sea level."""
        self._latitude = latitude
        self._longitude = longitude
        self._altitude = altitude
        self._east = METRES_PER_DEGREE * math.cos(math.radians(latitude))

    def point(self, latitude: float, longitude: float, altitude: float) -> Point:
        """A place in metres, by the shorter way round the Earth."""
        east = (longitude - self._longitude + 540.0) % 360.0 - 180.0
        north = latitude - self._latitude
        return east * self._east, north * METRES_PER_DEGREE, altitude - self._altitude


def links(points: Sequence[Point | None], range_m: float) -> list[list[int]]:
    """For each node the ids at most `range_m` metres away (in three dimensions), ascending.

    A node without a place (None) has no neighbours. The work is quadratic in the number of nodes.
    """
    neighbours: list[list[int]] = [[] for _ in points]
    limit = (range_m + TOLERANCE_M) ** 2
    for i, here in enumerate(points):
        if here is None:
            continue
        x, y, z = here
        for j in range(i):
            there = points[j]
            if there is None:
                continue
            dx, dy, dz = x - there[0], y - there[1], z - there[2]
            if dx * dx + dy * dy + dz * dz <= limit:
                neighbours[i].append(j)
                neighbours[j].append(i)
    return neighbours
