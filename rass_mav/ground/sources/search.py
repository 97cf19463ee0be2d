"""How many sources there are, and where: one after the other, as long as each explains much more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .model import (
    COMMON,
    HEIGHT_M,
    OWN,
    ROUGHLY,
    Array,
    Counts,
    Fit,
    deviance,
    excess_of,
    fit,
    predict,
    score_test,
)

#: At most so many sources are looked for.
MOST_SOURCES = 5
#: A source must lower the deviance by so much: by chance, one of a thousand places does so in hardly any mission.
WORTH = 25.0
#: Places that are tried for a new source, and those of them from which the fit begins.
MOST_PLACES, STARTS = 600, 3
#: Counts that the search for a place looks at.
MOST_LOOKED_AT = 1500
#: The least distance of two places, metres, and how far from a reading they are, in such distances.
PLACE_M, REACH = 10.0, 2
# Places times counts of which a likelihood is reckoned at once.
_AT_ONCE = 1 << 15
# Squares are numbered: so many in a row, more than a quarter of the Earth's circumference has.
_ROW = 1 << 22
# Of the map of strengths: how often it is improved, the width of a peak in squares, the least of one as a part of the
# highest.
_SPREAD_ITERATIONS, _PEAK, _LEAST_PEAK = 150, 2.5, 0.003


class Grid(NamedTuple):
    """Squares near readings."""

    east: Array
    north: Array
    """Of their middles, metres."""
    side: float


def places(data: Counts) -> Grid:
    """Where a source may be: squares that contain readings, and those around them."""
    side = PLACE_M
    around = np.array([i * _ROW + j for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1)])
    while True:
        # One number a square, so that sorting is quick.
        east, north = np.floor(data.x / side).astype(np.int64), np.floor(data.y / side).astype(np.int64)
        cells = np.unique(np.unique(east * _ROW + north)[:, None] + around)
        if len(cells) <= MOST_PLACES:
            rows = np.round(cells / _ROW).astype(np.int64)
            return Grid((rows + 0.5) * side, (cells - rows * _ROW + 0.5) * side, side)
        side *= 1.2


def search(data: Counts, most: int = MOST_SOURCES) -> tuple[Fit, bool]:
    """The fit with as many sources as are worth it, and whether one more would be."""
    mean = max(float(data.counts.sum() / data.readings.sum()), 1e-6)
    none = fit(data, np.array([np.log(mean), np.log(HEIGHT_M)]))
    grid, looked_at = places(data), _telling(data)
    tried = [_grown(data, none, grid, looked_at, most)]
    # Several strong sources look like one broad one at first: then all have to begin at once.
    spread = _spread(looked_at, grid, most)
    if len(spread) > 1:
        together = _pruned(data, fit(data, np.concatenate((none.parameters, *spread))))
        tried.append(_grown(data, together, grid, looked_at, most))
    return min(tried, key=lambda one: (one[1], one[0].deviance + WORTH * one[0].sources))


def _grown(data: Counts, best: Fit, grid: Grid, looked_at: Counts, most: int) -> tuple[Fit, bool]:
    """A fit with more sources, as long as they are worth it."""
    while True:
        more = _one_more(data, best, grid, looked_at)
        if more is None:
            return _pruned(data, best), False
        if best.sources == most:
            return best, True
        best = more


def _spread(data: Counts, grid: Grid, most: int) -> list[Array]:
    """Sources at the peaks of a map of strengths that explains the counts, by expectation maximisation."""
    shape = _shape(data, grid, HEIGHT_M)
    base = data.readings * max(float(np.quantile(data.counts / data.readings, 0.05)), 1e-3)
    weight = 1.0 / (1.0 + ROUGHLY * data.counts)
    strength = np.full(len(grid.east), data.counts.sum() / shape.sum())
    norm = shape @ weight
    for _ in range(_SPREAD_ITERATIONS):
        strength *= (shape @ (weight * data.counts / (strength @ shape + base))) / norm
    starts: list[Array] = []
    left = strength.copy()
    for _ in range(most):
        peak = int(np.argmax(left))
        near = np.hypot(grid.east - grid.east[peak], grid.north - grid.north[peak]) < _PEAK * grid.side
        total = float(left[near].sum())
        if total <= 0 or (starts and total < _LEAST_PEAK * np.exp(starts[0][2])):
            break
        middle = [float(left[near] @ axis[near]) / total for axis in (grid.east, grid.north)]
        starts.append(np.array([*middle, np.log(total)]))
        left[near] = 0.0
    return starts


def _shape(data: Counts, grid: Grid, height: float) -> Array:
    """The counts of a source of strength 1 at each place, a row for each."""
    above = np.maximum(height + data.up, 1.0)
    far2 = (grid.east[:, None] - data.x) ** 2 + (grid.north[:, None] - data.y) ** 2
    shape: Array = data.readings / (far2 + above**2)
    return shape


def _worth(data: Counts, fewer: Fit, more: Fit, k: int) -> float:
    """What source `k` of a fit is worth compared with one without it: by how much the deviance is lower, with the
    variances of the greater one, and what a test says that allows for wrong places."""
    gain = deviance(data, fewer.parameters, more.excess) - deviance(data, more.parameters, more.excess)
    if gain < WORTH:
        return gain
    own = more.own(k)
    above = np.maximum(np.exp(more.parameters[1]) + data.up, 1.0)
    shape = data.readings / ((data.x - own[0]) ** 2 + (data.y - own[1]) ** 2 + above**2)
    others = _others(more, k)
    mean, _, moved = predict(data, others)
    return min(gain, score_test(data, others, excess_of(data, mean, moved), shape[:, None]))


def without(data: Counts, found: Fit, k: int) -> Fit:
    """The best fit without one of the sources."""
    return fit(data, _others(found, k))


def _others(found: Fit, k: int) -> Array:
    """The parameters without those of a source."""
    first = COMMON + OWN * k
    return np.delete(found.parameters, slice(first, first + OWN))


def _one_more(data: Counts, now: Fit, grid: Grid, looked_at: Counts) -> Fit | None:
    """The best fit with one more source; None: none is worth it."""
    found: Fit | None = None
    for start in _starts(looked_at, now, grid):
        tried = fit(data, np.concatenate((now.parameters, start)))
        if (found is None or tried.deviance < found.deviance) and _worth(data, now, tried, now.sources) > WORTH:
            found = tried
    return found


def _pruned(data: Counts, found: Fit) -> Fit:
    """Without sources that others have come to explain."""
    for k in reversed(range(found.sources)):
        fewer = without(data, found, k)
        if _worth(data, fewer, found, k) < WORTH:
            return _pruned(data, fewer)
    return found


def _telling(data: Counts) -> Counts:
    """Some of many counts: the highest, and of the others some."""
    if len(data.x) <= MOST_LOOKED_AT:
        return data
    order = np.argsort(-data.counts / data.readings, kind="stable")
    highest, others = order[: MOST_LOOKED_AT // 3], order[MOST_LOOKED_AT // 3 :]
    rest = others[np.linspace(0, len(others) - 1, MOST_LOOKED_AT - len(highest)).astype(np.int64)]
    return data.only(np.concatenate((highest, rest)))


def _starts(data: Counts, now: Fit, grid: Grid) -> list[Array]:
    """Parameters of a new source where it explains most: some, not beside each other."""
    height2 = (np.exp(now.parameters[1]) + data.up) ** 2
    shape = _shape(data, grid, float(np.exp(now.parameters[1])))
    base = data.readings * np.exp(now.parameters[0])
    rest = np.zeros(len(data.x))
    for k in range(now.sources):
        east, north, strength = now.own(k)
        rest += data.readings * np.exp(strength) / ((data.x - east) ** 2 + (data.y - north) ** 2 + height2)
    lower, strength = profile(data.counts, base, rest, shape, np.full(len(data.x), ROUGHLY), base + rest)
    starts: list[Array] = []
    order = np.argsort(lower)
    for place in order:
        near = any(
            np.hypot(grid.east[place] - east, grid.north[place] - north) < 3 * grid.side for east, north, _ in starts
        )
        if not near and strength[place] > 0:
            starts.append(np.array([grid.east[place], grid.north[place], np.log(strength[place])]))
        if len(starts) == STARTS:
            break
    return starts


def profile(
    counts: Array, base: Array, rest: Array, shape: Array, excess: Array, mean: Array, iterations: int = 3
) -> tuple[Array, Array]:
    """For each place the lowest deviance with a source there, and its strength.

    `base`: counts of the background, which is scaled; `rest`: those of the other sources; `shape`: those of a source of
    strength 1, a row for each place; `excess`: as in `Fit`; `mean`: what is expected now, for the first guess.
    """
    # Some places at a time: what all of them need is too much for the processor's cache, and then takes twice as long.
    some = max(1, _AT_ONCE // len(counts))
    found = [
        _profile(counts, base, rest, shape[n : n + some], excess, mean, iterations) for n in range(0, len(shape), some)
    ]
    return np.concatenate([lowest for lowest, _ in found]), np.concatenate([best for _, best in found])


def _profile(
    counts: Array, base: Array, rest: Array, shape: Array, excess: Array, mean: Array, iterations: int
) -> tuple[Array, Array]:
    factor, strength = _guess(counts, base, rest, shape, 1.0 / (mean + excess * mean * mean))
    # The two factors need few digits, and half as many bytes take half as long. The deviance needs them all.
    numbers, ground, others, unit, more = (column.astype(np.float32) for column in (counts, base, rest, shape, excess))
    for _ in range(iterations):
        signal = strength.astype(np.float32)[:, None] * unit
        means = factor.astype(np.float32)[:, None] * ground
        means += signal
        means += others
        weight = means * more
        weight += 1.0
        weight *= means
        np.reciprocal(weight, out=weight)
        np.subtract(numbers, means, out=means)
        means *= weight
        # Newton's step in the logarithms of the two factors.
        a = factor**2 * (weight @ ground**2) + 1e-9
        u, v = factor * (means @ ground), np.einsum("ij,ij->i", means, signal).astype(np.float64)
        weight *= signal
        b, c = factor * (weight @ ground), np.einsum("ij,ij->i", weight, signal) + 1e-9
        det = a * c - b * b + 1e-12
        factor = factor * np.exp(np.clip((c * u - b * v) / det, -1.5, 1.5))
        strength = strength * np.exp(np.clip((a * v - b * u) / det, -1.5, 1.5))
    return _deviance(counts, factor[:, None] * base + strength[:, None] * shape + rest, excess), strength


def _guess(counts: Array, base: Array, rest: Array, shape: Array, weight: Array) -> tuple[Array, Array]:
    """The factor of the background and the strength, by least squares: `weight` is 1 over what the variances are now,
    so this is nearly right."""
    differs = weight * (counts - rest)
    a, u = float(weight @ base**2), float(base @ differs)
    b, c, v = shape @ (weight * base), (shape * shape) @ weight + 1e-30, shape @ differs
    det = np.maximum(a * c - b * b, 1e-9 * a * c)
    # A strength of at least a tenth of its standard deviation: a logarithm of nothing leads nowhere.
    return np.clip((c * u - b * v) / det, 0.3, 3.0), np.maximum((a * v - b * u) / det, 0.1 / np.sqrt(c))


def _deviance(counts: Array, means: Array, excess: Array) -> Array:
    """Of the counts, for each row of means: the sum of what `deviances` gives, in fewer logarithms."""
    size = 1.0 / excess
    perfect = float(
        (counts * np.log(np.where(counts > 0, counts, 1.0)) - (counts + size) * np.log(counts + size)).sum()
    )
    found: Array = 2.0 * (perfect - np.log(means) @ counts + np.log(means + size) @ (counts + size))
    return found
