"""Whether a source has moved, as far as the readings tell, and where it would be now."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .model import COMMON, OWN, Array, Counts, Fit, excess_of, information, predict, shared_errors

#: How far a source that moves comes on each axis: its standard deviation, metres for the square root of each second.
#: People carry things about; few of them walk straight on.
WANDERS_M = 2.5
#: The legs of its way, straight and equally long in time.
LEGS = 8
# exp of more than this is as good as certain.
_MOST = 50.0


class Motion(NamedTuple):
    """Where a source is at the time of the last reading, if it moves."""

    share: float
    """How probable it is that it moves. Before its readings tell, that is one half."""
    place: Array
    """The best place, metres east and north."""
    covariance: Array
    """Of the place, m^2."""

    def within(self, east: Array, north: Array, limit: float) -> npt.NDArray[np.bool_]:
        """Whether these places are so near to the best one; `limit`: of the chi-squared distribution."""
        off = np.column_stack((east, north)) - self.place
        found: npt.NDArray[np.bool_] = (off * np.linalg.solve(self.covariance, off.T).T).sum(axis=1) <= limit
        return found


def motion(data: Counts, found: Fit, k: int, covariance: Array) -> Motion:
    """What a random walk of source `k` would explain.

    :param data: single counts, whose times are known.
    :param covariance: of the parameters, of a source that rests.

    The steps of its legs are expected to be near 0 (`WANDERS_M`), so that few counts cannot ask for large ones. How
    probable motion is follows from the likelihood of all ways, and not only of the best one.
    """
    mean, _, moved = predict(data, found.parameters)
    excess = excess_of(data, mean, moved)
    matrix, mean, slopes, moved = information(data, found.parameters, excess)
    variance = mean + excess * mean * mean
    first = COMMON + OWN * k
    own = slice(first, first + 2)
    leg = max(float(data.time.max()), 1.0) / LEGS
    # What is left of each leg, in standard deviations of a step. Before the end it was elsewhere by that, so the place
    # is that at the end, and the other parameters follow.
    left = np.clip(np.arange(1, LEGS + 1) - data.time[:, None] / leg, 0.0, 1.0) * WANDERS_M * np.sqrt(leg)
    before = (left[:, :, None] * slopes[:, None, own]).reshape(len(left), -1)
    weighted = slopes / variance[:, None]
    follow = np.linalg.solve(matrix + 1e-9 * np.diag(np.diag(matrix) + 1.0), weighted.T @ before)
    alone = before - slopes @ follow
    weighted = alone / variance[:, None]
    one = np.eye(2 * LEGS)
    bare = weighted.T @ alone + 1e-9 * one
    # With errors of GPS that all places of a minute share, the score says less.
    says = bare @ np.linalg.inv(bare + shared_errors(data, moved, weighted))
    known = says @ bare
    spread = np.linalg.inv(known + one)
    push = says @ (weighted.T @ (data.counts - mean))
    ratio = np.exp(min(float(push @ spread @ push) - np.linalg.slogdet(known + one)[1], _MOST) / 2)
    return Motion(
        float(ratio / (1.0 + ratio)),
        found.parameters[own] - follow[own] @ (spread @ push),
        covariance[own, own] + follow[own] @ spread @ follow[own].T,
    )
