"""Readings of drones that fly over sources, as they arrive at a base."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from itertools import pairwise

from rass_mav.ground.entry import Place
from rass_mav.ground.field import DEGREE_M
from rass_mav.ground.sources.readings import Sample

#: Where the middle of the area is.
HERE: Place = (47.0, 8.0)
#: Height of the drones, metres; dose rate without sources, uSv/h; counts in a reading at 1 uSv/h.
HEIGHT_M, BACKGROUND, SENSITIVITY = 10.0, 0.1, 1.77

#: x, y (metres east and north of the middle), and the dose rate 1 m from it, uSv/h.
Source = tuple[float, float, float]


def earth(x: float, y: float, middle: Place = HERE) -> Place:
    """Degrees of a point in metres."""
    east = middle[1] + x / (DEGREE_M * math.cos(math.radians(middle[0])))
    return middle[0] + y / DEGREE_M, (east + 180.0) % 360.0 - 180.0


def metres(place: Place, middle: Place = HERE) -> tuple[float, float]:
    """The inverse."""
    east = (place[1] - middle[1] + 180.0) % 360.0 - 180.0
    return east * DEGREE_M * math.cos(math.radians(middle[0])), (place[0] - middle[0]) * DEGREE_M


def flown(
    sources: Sequence[Source],
    *,
    seed: int = 1,
    middle: Place = HERE,
    gps_m: float = 2.0,
    at: Callable[[float], Sequence[Source]] | None = None,
    turned: float = 0.0,
    moved: tuple[float, float] = (0.0, 0.0),
) -> list[Sample]:
    """Four drones, each over a quarter of 240 m x 200 m in strips 25 m apart, a reading each second, twice over it.

    `at`: the sources at a time, seconds; None: they stay. `turned` (radians) and then `moved` (metres): all of it, and
    nothing else is different.
    """
    rng = random.Random(seed)
    samples = []
    for drone in range(2, 6):
        left, low = (-120.0, 0.0)[drone % 2], (-100.0, 0.0)[drone // 4]
        off = rng.gauss(0.0, gps_m), rng.gauss(0.0, gps_m)
        way = [(left + 8.0 * k, low + 12.5 + 25.0 * row) for row in range(4) for k in range(15)[:: (1, -1)[row % 2]]]
        for second, (x, y) in enumerate(way + way[::-1]):
            there = sources if at is None else at(second)
            rate = BACKGROUND + sum(s / ((x - sx) ** 2 + (y - sy) ** 2 + HEIGHT_M**2) for sx, sy, s in there)
            value = poisson(rng, rate * SENSITIVITY) / SENSITIVITY
            x, y = x + off[0], y + off[1]
            x, y = x * math.cos(turned) - y * math.sin(turned), x * math.sin(turned) + y * math.cos(turned)
            place = earth(x + moved[0], y + moved[1], middle)
            samples.append(Sample(drone, float(second), *place, 500.0 + HEIGHT_M, value, gps_m))
    return samples


def poisson(rng: random.Random, mean: float) -> int:
    """A Poisson number."""
    if mean > 200:
        return max(0, round(rng.gauss(mean, math.sqrt(mean))))
    count, left = -1, mean
    while left >= 0:
        left -= rng.expovariate(1.0)
        count += 1
    return count


def inside(ring: Sequence[Place], place: Place) -> bool:
    """Whether a place is in a polygon of places."""
    y, x = place
    crossed = False
    for (y1, x1), (y2, x2) in pairwise(ring):
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            crossed = not crossed
    return crossed
