"""Whether the readings exclude that a source has moved; if not, where it would be now."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .model import COMMON, OWN, Array, Counts, Fit, excess_of, information, predict, shared_errors

#: How far a source that moves comes on each axis: its standard deviation, metres for the square root of each second.
#: People carry things about; few of them walk straight on.
WANDERS_M = 2.5
#: How far it is from a straight course, as a part of that: a random walk, from the line that fits it best, at its end.
ASTRAY = 1 / 3
#: Motion is excluded if it makes the readings so much less likely than rest: then it has 5 %, if it had a third before.
LEAST_RATIO = 0.1
# exp of more than this is as good as certain.
_MOST = 50.0


class Motion(NamedTuple):
    """Where a source is at the time of the last reading, if it moves."""

    place: Array
    """The best place, metres east and north."""
    covariance: Array
    """Of the place, m^2."""

    def within(self, east: Array, north: Array, limit: float) -> npt.NDArray[np.bool_]:
        """Whether these places are so near to the best one; `limit`: of the chi-squared distribution."""
        off = np.column_stack((east, north)) - self.place
        found: npt.NDArray[np.bool_] = (off * np.linalg.solve(self.covariance, off.T).T).sum(axis=1) <= limit
        return found


def motion(data: Counts, found: Fit, k: int, covariance: Array) -> Motion | None:
    """What a constant velocity of source `k` would explain; None: it is excluded.

    :param data: single counts, whose times are known.
    :param covariance: of the parameters, without a velocity.

    The velocity is expected to be near 0 (`WANDERS_M`), so that few counts cannot ask for a high one. The ratio of the
    likelihoods, with and without it, is that of all velocities, and not only of the best one.
    """
    mean, _, moved = predict(data, found.parameters)
    excess = excess_of(data, mean, moved)
    matrix, mean, slopes, moved = information(data, found.parameters, excess)
    variance = mean + excess * mean * mean
    first = COMMON + OWN * k
    own = slice(first, first + 2)
    duration = max(float(data.time.max()), 1.0)
    speed = WANDERS_M / np.sqrt(duration)
    # Before the end it was elsewhere. So the place is that at the end, and the other parameters follow.
    before = slopes[:, own] * (data.time - duration)[:, None]
    weighted = slopes / variance[:, None]
    follow = np.linalg.solve(matrix + 1e-9 * np.diag(np.diag(matrix) + 1.0), weighted.T @ before)
    alone = before - slopes @ follow
    weighted = alone / variance[:, None]
    bare = weighted.T @ alone + 1e-9 * np.eye(2)
    # With errors of GPS that all places of a minute share, the score says less.
    says = bare @ np.linalg.inv(bare + shared_errors(data, moved, weighted))
    known = says @ bare
    spread = np.linalg.inv(known + np.eye(2) / speed**2)
    push = says @ (weighted.T @ (data.counts - mean))
    gain = float(push @ spread @ push) / 2
    ratio = np.exp(min(gain, _MOST)) / np.sqrt(np.linalg.det(np.eye(2) + speed**2 * known))
    if ratio < LEAST_RATIO:
        return None
    astray = (ASTRAY * speed * duration) ** 2 * np.eye(2)
    return Motion(
        found.parameters[own] - follow[own] @ (spread @ push),
        covariance[own, own] + follow[own] @ spread @ follow[own].T + astray,
    )
