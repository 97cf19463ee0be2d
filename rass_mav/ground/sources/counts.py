"""Readings as counts at places in metres: how much of a reading one count is, and readings at one place as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rass_mav.ground.entry import Place
from rass_mav.ground.field import DEGREE_M

from .model import Array, Counts
from .readings import Sample

#: Standard deviation of a place of which nothing is known, metres: that of GPS without corrections.
ERROR_M = 3.0
#: No place is trusted to be more exact, metres.
LEAST_ERROR_M = 0.5
#: Readings farther from the others' middle are left out, metres: forged, or from another place.
FAR_M = 20_000.0
#: A reading counts as at most so many: more can only be forged.
MOST_COUNTS = 1e9
#: So many counts are fitted; of more readings, those of a drone that are near each other become one.
MOST_ROWS = 1200
#: Squares in which they are near each other: at first, and at most, metres.
NEAR_M, MOST_NEAR_M = 3.0, 30.0
# More squares than there are from the middle to `FAR_M`.
_HALF = 1 << 14


class Ground(NamedTuple):
    """How metres become degrees."""

    origin: Place
    metres: Place
    """In a degree, to north and to east."""

    def place(self, east: float, north: float) -> Place:
        """Latitude and longitude, degrees."""
        longitude = self.origin[1] + east / self.metres[1]
        return self.origin[0] + north / self.metres[0], (longitude + 180.0) % 360.0 - 180.0


def counts_of(samples: Sequence[Sample]) -> tuple[Counts, float, Ground]:
    """The counts, the reading that one count is, and where they are. `samples`: at least one."""
    columns = np.array([sample[:6] for sample in samples])
    latitude, longitude = columns[:, 2], columns[:, 3]
    middle = float(np.median(latitude)), float(np.median(longitude))
    ground = Ground(middle, (DEGREE_M, DEGREE_M * max(float(np.cos(np.radians(middle[0]))), 0.01)))
    east = ((longitude - middle[1] + 180.0) % 360.0 - 180.0) * ground.metres[1]
    north = (latitude - middle[0]) * ground.metres[0]
    error = np.array([ERROR_M if sample.error_m is None else sample.error_m for sample in samples])
    near = np.hypot(east, north) <= FAR_M
    drone, time, value = columns[near, 0].astype(np.int64), columns[near, 1], columns[near, 5]
    one = one_count(value, drone, time)
    up = columns[near, 4]
    data = Counts(
        east[near], north[near], up - np.median(up), time - time.min(), np.minimum(value / one, MOST_COUNTS),
        np.ones(len(value)), drone, np.maximum(error[near], LEAST_ERROR_M),
    )  # fmt: skip
    return data, one, ground


def one_count(value: Array, drone: Array, time: Array) -> float:
    """The reading that one count is, > 0.

    A counter's readings are multiples of it, so it is the smallest difference of a drone's readings; the one on which
    most drones agree. A counter that smooths its readings, or gives them without such steps, tells less or more than
    that: then it follows from how much three readings in a row differ.
    """
    steps = []
    ratios = []
    for id in np.unique(drone):
        its = value[drone == id]
        gaps = np.diff(np.unique(np.append(its, 0.0)))
        gaps = gaps[gaps > 1e-6 * max(float(its.max()), 1e-12)]
        if len(gaps) >= 3:
            steps.append(float(gaps.min()))
        rows = its[np.argsort(time[drone == id], kind="stable")]
        bend, level = rows[:-2] - 2 * rows[1:-1] + rows[2:], rows[:-2] + 4 * rows[1:-1] + rows[2:]
        if (level > 0).sum() >= 10:
            # Of independent counts the one is the variance of the other.
            ratios.append(float((bend[level > 0] ** 2).sum() / level[level > 0].sum()))
    scatter = float(np.median(ratios)) if ratios else 0.0
    # Strong sources make readings in a row differ too, but not those of the drone that is farthest from them.
    least = min(ratios, default=0.0)
    if steps:
        agree = [sum(abs(other / step - 1.0) < 0.15 for other in steps) for step in steps]
        step = steps[int(np.argmax(agree))]
        if least <= 3.0 * step:
            return step * step / scatter if 0.0 < scatter < step / 3.0 else step
    return least or max(float(value.max()), 1e-9)


def gathered(data: Counts) -> Counts:
    """At most about `MOST_ROWS`: counts of a drone in one square are one, with the readings that they are of."""
    side = NEAR_M
    while True:
        # One number a drone and square, so that sorting is quick.
        east, north = ((np.floor(axis / side) + _HALF).astype(np.int64) for axis in (data.x, data.y))
        keys = (data.drone * 2 * _HALF + east) * 2 * _HALF + north
        _, which, sizes = np.unique(keys, return_inverse=True, return_counts=True)
        if len(sizes) <= MOST_ROWS or side > MOST_NEAR_M:
            break
        side *= 1.25
    if len(sizes) == len(data.x):
        return data
    which = which.ravel()

    def mean(column: Array) -> Array:
        found: Array = np.bincount(which, column) / sizes
        return found

    drone = np.zeros(len(sizes), dtype=np.int64)
    drone[which] = data.drone
    # The places in a square are a little wrong too.
    error = np.sqrt(mean(data.error**2) + np.where(sizes > 1, side**2 / 12.0, 0.0))
    return Counts(
        mean(data.x), mean(data.y), mean(data.up), mean(data.time), np.bincount(which, data.counts).astype(np.float64),
        sizes.astype(np.float64), drone, error,
    )  # fmt: skip
