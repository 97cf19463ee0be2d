"""Where a source may be: the places at which it explains the counts almost as well as at the best one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .model import COMMON, OWN, Array, Counts, Fit, deviances, information
from .motion import Motion
from .search import Grid, profile

#: Of the chi-squared distribution with two degrees of freedom: 95 %.
CHI2 = 5.991
#: Squares on each side of a map of places.
SIDES = 25
_ITERATIONS = 2


class Region(NamedTuple):
    """Squares in which the source may be."""

    east: float
    north: float
    """The south-west corner of the map, metres."""
    side: tuple[float, float]
    """Of a square, to east and to north, metres."""
    inside: npt.NDArray[np.bool_]
    """By row (from the south) and column."""
    bounded: bool
    """False: it reaches to where nobody has measured."""

    @property
    def area(self) -> float:
        """Square metres."""
        return float(self.inside.sum()) * self.side[0] * self.side[1]


def widening(data: Counts, found: Fit, k: int, covariance: Array) -> float:
    """By how much the place of a source is less certain than its own likelihood says, as a factor of the variance: the
    height and the other sources are not known either."""
    matrix = information(data, found.parameters, found.excess)[0]
    first = COMMON + OWN * k
    own = [0, first, first + 1, first + 2]
    alone = np.linalg.pinv(matrix[np.ix_(own, own)], hermitian=True)[1:3, 1:3]
    whole = covariance[first : first + 2, first : first + 2]
    return max(1.0, float(np.linalg.eigvals(np.linalg.pinv(alone) @ whole).real.max()))


def covariance_of(data: Counts, found: Fit) -> Array:
    """Of the parameters. Whatever is wrong with a drone's GPS lasts: all places of a drone are wrong by the same."""
    matrix, mean, slopes, moved = information(data, found.parameters, found.excess)
    inverse = np.linalg.pinv(matrix, hermitian=True)
    weighted = slopes / (mean + found.excess * mean * mean)[:, None]
    shifted = np.zeros_like(matrix)
    for drone in np.unique(data.drone):
        its = data.drone == drone
        shift = (weighted[its].T @ moved[its]) * float(np.median(data.error[its]))
        shifted += shift @ shift.T
    return inverse + inverse @ shifted @ inverse


def region_of(
    data: Counts, found: Fit, k: int, covariance: Array, everywhere: Grid, limit: float, moving: Motion | None = None
) -> Region:
    """Where the deviance is higher than that of the fit by at most `limit`, and where the source may have moved.
    `everywhere`: where a source may be."""
    first = COMMON + OWN * k
    best = found.parameters[first : first + 2]
    reach = 3.5 * np.sqrt(np.maximum(np.diag(covariance)[first : first + 2], 0.01))
    worse = _worse(data, found, k, everywhere.east, everywhere.north)
    inside = worse <= limit
    edge = _edge(everywhere)
    bounded = not bool((inside & edge).any())
    low, high = best - reach, best + reach
    if moving is not None:
        reach = 3.5 * np.sqrt(np.diag(moving.covariance))
        low, high = np.minimum(low, moving.place - reach), np.maximum(high, moving.place + reach)
    if inside.any():
        for axis, values in enumerate((everywhere.east, everywhere.north)):
            low[axis] = min(low[axis], values[inside].min() - everywhere.side)
            high[axis] = max(high[axis], values[inside].max() + everywhere.side)
    for _ in range(5):
        region = _map(data, found, k, low, high, limit, bounded, moving)
        rows, columns = np.nonzero(region.inside)
        if not len(rows):
            low, high = (low + best) / 2, (high + best) / 2
            continue
        size = np.array([np.ptp(columns) + 1, np.ptp(rows) + 1])
        sides = np.array(region.side)
        least = np.array([region.east + columns.min() * sides[0], region.north + rows.min() * sides[1]])
        most = least + size * sides
        cut = (columns.min() == 0) | (rows.min() == 0) | (columns.max() == SIDES - 1) | (rows.max() == SIDES - 1)
        if cut:
            low, high = low - (high - low) / 2, high + (high - low) / 2
        elif (size < SIDES / 2).any():
            low, high = least - 1.5 * sides, most + 1.5 * sides
        else:
            break
    return region


def _edge(grid: Grid) -> npt.NDArray[np.bool_]:
    """Squares that have not all their neighbours."""
    cells = np.round(np.column_stack((grid.east, grid.north)) / grid.side - 0.5).astype(np.int64)
    known = set(map(tuple, cells.tolist()))
    around = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    return np.array([any((i + a, j + b) not in known for a, b in around) for i, j in cells.tolist()])


def _map(
    data: Counts, found: Fit, k: int, low: Array, high: Array, limit: float, bounded: bool, moving: Motion | None
) -> Region:
    side = (high - low) / SIDES
    columns, rows = np.meshgrid(np.arange(SIDES), np.arange(SIDES))
    east, north = low[0] + (columns.ravel() + 0.5) * side[0], low[1] + (rows.ravel() + 0.5) * side[1]
    inside = _worse(data, found, k, east, north) <= limit
    if moving is not None:
        inside |= moving.within(east, north, CHI2)
    square = float(side[0]), float(side[1])
    return Region(float(low[0]), float(low[1]), square, inside.reshape(SIDES, SIDES), bounded)


def _worse(data: Counts, found: Fit, k: int, east: Array, north: Array) -> Array:
    """By how much the deviance is higher with the source at these places, its strength and the background being as good
    as possible there."""
    base = data.readings * np.exp(found.parameters[0])
    above2 = np.maximum(np.exp(found.parameters[1]) + data.up, 1.0) ** 2
    own = found.own(k)
    fitted = data.readings * np.exp(own[2]) / ((data.x - own[0]) ** 2 + (data.y - own[1]) ** 2 + above2)
    rest = np.maximum(found.mean - base - fitted, 0.0)
    shape = data.readings * np.exp(own[2]) / ((east[:, None] - data.x) ** 2 + (north[:, None] - data.y) ** 2 + above2)
    here = deviances(data.counts, found.mean, found.excess).sum()
    lowest = profile(data.counts, base, rest, shape, found.excess, found.mean, _ITERATIONS)[0]
    worse: Array = lowest - here
    return worse
