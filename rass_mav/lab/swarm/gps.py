"""The error with which GPS places the nodes of a mock swarm."""

from __future__ import annotations

import math
import random

from rass_mav.lab.medium.neighbours import Position

#: After so long little is left of an error, seconds: what disturbs GPS (the sky, reflections) changes slowly.
LASTS_S = 60.0


class GpsErrors:
    """Of each node an error to east and to north: normal, and exponentially correlated in time."""

    def __init__(self, rng: random.Random, nodes: int, error_m: float, step_s: float) -> None:
        """`error_m`: the standard deviation of each, metres; 0: there are no errors."""
        self._rng, self._error_m = rng, error_m
        self._stays = math.exp(-step_s / LASTS_S)
        self._errors = [(rng.gauss(0.0, error_m), rng.gauss(0.0, error_m)) for _ in range(nodes if error_m else 0)]

    def step(self) -> None:
        """Advance by a step."""
        stays, fresh = self._stays, self._error_m * math.sqrt(1.0 - self._stays**2)
        gauss = self._rng.gauss
        self._errors = [(x * stays + gauss(0.0, fresh), y * stays + gauss(0.0, fresh)) for x, y in self._errors]

    def place(self, node: int, true: Position) -> Position:
        """Where GPS places a node that is at `true`, metres east and north."""
        if not self._errors:
            return true
        x, y = self._errors[node]
        return true[0] + x, true[1] + y
