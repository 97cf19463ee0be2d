"""Whether point sources explain the counts at all: that the deviations are no larger than chance makes them, and that
no source seems to be long."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .model import Array, Counts, Fit, excess_of, predict, score_test

#: A drone's readings near a source tell of it: there it adds at least this part of the mean.
TELLS = 0.3


class Misfit(NamedTuple):
    """How far the counts are from what the model allows. All are 0 or less where it fits well."""

    near: float
    """Deviations of the readings that tell of sources, in standard deviations of their sum of squares."""
    all: float
    """The same of all readings."""
    long: float
    """By how much an extent would lower the deviance, at most of all sources."""


def misfit(data: Counts, found: Fit) -> Misfit:
    """Of single counts."""
    mean, _, moved = predict(data, found.parameters)
    excess = excess_of(data, mean, moved)
    variance = mean + excess * mean * mean
    squares = (data.counts - mean) ** 2 / variance
    # Of a Poisson number, and of one that is normal where the excess rules.
    spread = 2.0 + 1.0 / np.maximum(mean, 0.05) + 6.0 * excess
    signal = mean - data.readings * np.exp(found.parameters[0])
    near = signal > TELLS * mean
    tests = [score_test(data, found.parameters, excess, _bends(data, found, k)) for k in range(found.sources)]
    return Misfit(
        _excess(squares[near], spread[near], len(found.parameters)), _excess(squares, spread, len(found.parameters)),
        max(tests, default=0.0),
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
