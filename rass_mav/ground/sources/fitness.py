"""Whether fixed point sources explain the counts at all: that the deviations are no larger than chance makes them, and
that no source seems to move or to be long."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .model import COMMON, OWN, Array, Counts, Fit, excess_of, predict, score_test

#: A drone's readings near a source tell of it: there it adds at least this part of the mean.
TELLS = 0.3


class Misfit(NamedTuple):
    """How far the counts are from what the model allows. All are 0 or less where it fits well."""

    near: float
    """Deviations of the readings that tell of sources, in standard deviations of their sum of squares."""
    all: float
    """The same of all readings."""
    moves: float
    """By how much a constant velocity and a change of strength would lower the deviance, at most of all sources."""
    long: float
    """The same of an extent."""

    @property
    def shape(self) -> float:
        """The greater one of the last two."""
        return max(self.moves, self.long)


def misfit(data: Counts, found: Fit) -> Misfit:
    """Of single counts, whose times are known."""
    mean, slopes, moved = predict(data, found.parameters)
    excess = excess_of(data, mean, moved)
    variance = mean + excess * mean * mean
    squares = (data.counts - mean) ** 2 / variance
    # Of a Poisson number, and of one that is normal where the excess rules.
    spread = 2.0 + 1.0 / np.maximum(mean, 0.05) + 6.0 * excess
    signal = mean - data.readings * np.exp(found.parameters[0])
    near = signal > TELLS * mean
    moves = long = 0.0
    for k in range(found.sources):
        first = COMMON + OWN * k
        # A source that moves may also look like one that fades here, and one that grows there.
        middle = float(np.average(data.time, weights=slopes[:, first + 2] ** 2 / variance + 1e-12))
        drift = (data.time - middle) / max(float(data.time.max()), 1.0)
        changing = slopes[:, first : first + OWN] * drift[:, None]
        moves = max(moves, score_test(data, found.parameters, excess, changing))
        long = max(long, score_test(data, found.parameters, excess, _bends(data, found, k)))
    return Misfit(
        _excess(squares[near], spread[near], len(found.parameters)), _excess(squares, spread, len(found.parameters)),
        moves, long,
    )  # fmt: skip


def _excess(squares: Array, spread: Array, parameters: int) -> float:
    if len(squares) <= parameters:
        return 0.0
    return float((squares.sum() - len(squares)) / np.sqrt(spread.sum()))


def _bends(data: Counts, found: Fit, k: int) -> Array:
    """Second derivatives by the source's place, of different size in different directions: what a long source adds."""
    east, north, strength = found.own(k)
    height = np.exp(found.parameters[1])
    dx, dy = data.x - east, data.y - north
    part = 1.0 / (dx * dx + dy * dy + np.maximum(height + data.up, 1.0) ** 2)
    counts = data.readings * np.exp(strength) * part * part * part
    return np.column_stack((counts * (dx * dx - dy * dy), counts * dx * dy))
