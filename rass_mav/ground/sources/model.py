"""Point sources over a constant background: what counts they predict, and how well these fit those that were measured.

The law is that of docs/evaluation/simulation.md: at a horizontal distance d and a height h, a source of strength S adds
S / (d^2 + h^2). Counts are Poisson. That a place is not known exactly, and that no counter is perfect, makes them vary
more, in proportion to their square: they are negative binomial.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.floating[Any]]

#: Parameters before those of the sources: the logarithms of the background (counts a reading) and of the height (m).
COMMON = 2
#: Parameters of a source: x and y (m), the logarithm of its strength (counts a reading at 1 m).
OWN = 3
#: What readings differ by although nothing explains it, as a part of them: the counter's direction and calibration.
MODEL_ERROR = 0.03
#: Height above the ground before anything is known, metres, and the standard deviation of its logarithm.
HEIGHT_M, HEIGHT_SPREAD = 15.0, 0.8
#: Readings are taken between these heights above a source, metres.
_HEIGHTS = np.log(1.0), np.log(300.0)
_MOST_ITERATIONS = 40
#: A fit has converged if the deviance falls by less than this.
_ENOUGH = 0.01
#: Where a source may be is hardly known yet: counts near it are taken to differ so much, as a part of their square.
ROUGHLY = 0.1
# More than any mission has minutes.
_MANY = 1 << 24
# How often the variances are reckoned again.
_ROUNDS = 3


class Counts(NamedTuple):
    """Measured counts: arrays of one length."""

    x: Array
    """Metres east of the origin."""
    y: Array
    """Metres north of it."""
    up: Array
    """Metres above the mean height of the readings."""
    time: Array
    """Seconds since the first one."""
    counts: Array
    """>= 0, not whole where the reading was corrected."""
    readings: Array
    """Of so many readings they are."""
    drone: npt.NDArray[np.int64]
    """Its node id."""
    error: Array
    """Standard deviation of the place on each axis, metres."""

    def only(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Counts:
        """Some of them."""
        x, y, up, time, counts, readings, drone, error = self
        return Counts(
            x[which], y[which], up[which], time[which], counts[which], readings[which], drone[which], error[which]
        )


class Fit(NamedTuple):
    """A number of sources with the parameters that fit best."""

    parameters: Array
    """`COMMON`, and `OWN` for each source."""
    mean: Array
    """The counts that they predict."""
    excess: Array
    """The part of the variance that grows with the square of the mean: the variance is mean + excess * mean^2."""
    deviance: float
    """Twice the log-likelihood that is missing to a perfect fit, with the height's prior."""

    @property
    def sources(self) -> int:
        """How many."""
        return (len(self.parameters) - COMMON) // OWN

    def own(self, k: int) -> Array:
        """The parameters of a source."""
        return self.parameters[COMMON + OWN * k : COMMON + OWN * (k + 1)]


def predict(data: Counts, parameters: Array) -> tuple[Array, Array, Array]:
    """The mean counts, their derivatives by the parameters, and those by the place of the reading (east, north)."""
    n = len(data.x)
    slopes = np.zeros((n, len(parameters)))
    moved = np.zeros((n, 2))
    slopes[:, 0] = mean = data.readings * np.exp(parameters[0])
    height = np.exp(parameters[1])
    above = np.maximum(height + data.up, 1.0)
    for first in range(COMMON, len(parameters), OWN):
        east, north, strength = parameters[first : first + OWN]
        dx, dy = data.x - east, data.y - north
        part = 1.0 / (dx * dx + dy * dy + above * above)
        counts = data.readings * np.exp(strength) * part
        mean = mean + counts
        steep = 2.0 * counts * part
        slopes[:, first], slopes[:, first + 1], slopes[:, first + 2] = steep * dx, steep * dy, counts
        slopes[:, 1] -= steep * above * height
        moved[:, 0] -= steep * dx
        moved[:, 1] -= steep * dy
    return mean, slopes, moved


def mean_of(data: Counts, parameters: Array) -> Array:
    """The mean counts alone, as `predict` has them."""
    above2 = np.maximum(np.exp(parameters[1]) + data.up, 1.0) ** 2
    signal = np.zeros(len(data.x))
    for first in range(COMMON, len(parameters), OWN):
        east, north, strength = parameters[first : first + OWN]
        signal += np.exp(strength) / ((data.x - east) ** 2 + (data.y - north) ** 2 + above2)
    mean: Array = data.readings * (np.exp(parameters[0]) + signal)
    return mean


def deviances(counts: Array, mean: Array, excess: Array) -> Array:
    """Of each count, for a negative binomial distribution. `excess`: as in `Fit`, > 0."""
    size = 1.0 / excess
    logs = np.where(counts > 0, counts * np.log(np.where(counts > 0, counts, 1.0) / mean), 0.0)
    found: Array = 2.0 * (logs - (counts + size) * np.log((counts + size) / (mean + size)))
    return found


def excess_of(data: Counts, mean: Array, moved: Array) -> Array:
    """What errors of the places and of the counter add to the variance, as a part of the square of the mean."""
    steep = (moved * moved).sum(axis=1) / np.maximum(mean, 1e-12) ** 2
    found: Array = np.minimum(steep * data.error**2, 1.0) + MODEL_ERROR**2
    return found


def _penalty(parameters: Array) -> float:
    return float(((parameters[1] - np.log(HEIGHT_M)) / HEIGHT_SPREAD) ** 2)


def information(data: Counts, parameters: Array, excess: Array) -> tuple[Array, Array, Array, Array]:
    """The Fisher information, the mean counts, and the derivatives as `predict` has them."""
    mean, slopes, moved = predict(data, parameters)
    weights = 1.0 / (mean + excess * mean * mean)
    matrix = (slopes * weights[:, None]).T @ slopes
    matrix[1, 1] += 1.0 / HEIGHT_SPREAD**2
    return matrix, mean, slopes, moved


def deviance(data: Counts, parameters: Array, excess: Array) -> float:
    """Of all counts, with the prior."""
    return float(deviances(data.counts, mean_of(data, parameters), excess).sum()) + _penalty(parameters)


def fit(data: Counts, start: Array) -> Fit:
    """The parameters that fit best, near the given ones: Fisher's scoring, damped after Levenberg and Marquardt."""
    parameters = start.copy()
    excess = np.full(len(data.x), MODEL_ERROR**2)
    for turn in range(_ROUNDS):
        mean, _, moved = predict(data, parameters)
        # At first the place is far from the best one, and strong readings must not rule.
        excess = np.maximum(excess_of(data, mean, moved), 0.0 if turn else ROUGHLY)
        parameters = _scored(data, parameters, excess, _MOST_ITERATIONS if turn == _ROUNDS - 1 else 12)
    mean, _, moved = predict(data, parameters)
    excess = excess_of(data, mean, moved)
    total = float(deviances(data.counts, mean, excess).sum()) + _penalty(parameters)
    return Fit(parameters, mean, excess, total)


def _scored(data: Counts, parameters: Array, excess: Array, most: int) -> Array:
    damping = 1e-3
    now = deviance(data, parameters, excess)
    matrix, mean, slopes, _ = information(data, parameters, excess)
    for _ in range(most):
        weights = 1.0 / (mean + excess * mean * mean)
        push = slopes.T @ (weights * (data.counts - mean))
        push[1] -= (parameters[1] - np.log(HEIGHT_M)) / HEIGHT_SPREAD**2
        scale = np.diag(matrix) + 1e-9
        step = np.linalg.solve(matrix + np.diag(damping * scale + 1e-12), push)
        tried = parameters + _bounded(step)
        tried[1] = np.clip(tried[1], *_HEIGHTS)
        tried[0] = max(tried[0], -18.0)
        then = deviance(data, tried, excess)
        if then <= now:
            gained, parameters, now = now - then, tried, then
            matrix, mean, slopes, _ = information(data, parameters, excess)
            # A damped step may gain little far from the optimum.
            if gained < _ENOUGH and damping < 0.01:
                break
            damping = max(damping / 5.0, 1e-7)
        else:
            damping *= 6.0
            if damping > 1e7:
                break
    return parameters


def _bounded(step: Array) -> Array:
    """No step multiplies a strength by more than 5, or moves a source by more than 40 m."""
    limits = np.full(len(step), 40.0)
    limits[:COMMON] = 1.0
    limits[COMMON + 2 :: OWN] = 1.6
    # Strong sources hide the background: its step may be huge then, and the others' must not shrink with it.
    step = np.append(np.clip(step[0], -1.0, 1.0), step[1:])
    return step / max(1.0, float((np.abs(step) / limits).max()))


def score_test(data: Counts, parameters: Array, excess: Array, more: Array) -> float:
    """By how much further parameters would lower the deviance, whose derivatives these are, a column for each.

    Within a minute, all places of a drone may be wrong by the same: what that explains counts for nothing.
    """
    matrix, mean, slopes, moved = information(data, parameters, excess)
    variance = mean + excess * mean * mean
    more = more / (np.sqrt((more * more / variance[:, None]).sum(axis=0)) + 1e-12)
    weighted = slopes / variance[:, None]
    more = more - slopes @ np.linalg.solve(matrix + 1e-9 * np.diag(np.diag(matrix) + 1.0), weighted.T @ more)
    weighted = more / variance[:, None]
    score = weighted.T @ (data.counts - mean)
    spread = weighted.T @ more + 1e-6 * np.eye(more.shape[1])
    spread = spread + shared_errors(data, moved, weighted)
    return float(score @ np.linalg.solve(spread, score))


def shared_errors(data: Counts, moved: Array, weighted: Array) -> Array:
    """What errors that all places of a drone share for a minute add to the variance of scores.

    :param moved: derivatives of the mean counts by the place, as `predict` has them.
    :param weighted: derivatives by the parameters, a column for each, divided by the variance of the counts.
    """
    minutes = data.drone * _MANY + (data.time // 60.0).astype(np.int64)
    _, which = np.unique(minutes, return_inverse=True)
    found = np.zeros((weighted.shape[1], weighted.shape[1]))
    for axis in range(2):
        shift = np.zeros((int(which.max()) + 1, weighted.shape[1]))
        np.add.at(shift, which, weighted * (moved[:, axis] * data.error)[:, None])
        found += shift.T @ shift
    return found
