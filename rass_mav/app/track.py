"""Where a node was lately: files that are put without a place were made there."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from rass_mav.agent.agent import VehicleService
from rass_mav.mavlink.telemetry import Position

from .driver import Driver

#: Positions of the node that are remembered, how far apart they are at least, and how near in time one must be to that
#: of a file. Seconds.
MOST_TRACK, APART_S, NEAR_S = 300, 1.0, 2.0


class Track(VehicleService):
    """Where the node was lately. A service of its agent."""

    def __init__(self, driver: Driver, wall: Callable[[], float] = time.time) -> None:
        """`wall`: seconds since 1970."""
        self._driver = driver
        self._wall = wall
        self._positions: deque[Position] = deque(maxlen=MOST_TRACK)
        driver.agent.services.append(self)

    def step(self, now: float) -> None:
        """Remember where the node is."""
        position = self._driver.agent.telemetry.position
        if position is not None and (not self._positions or position.at >= self._positions[-1].at + APART_S):
            self._positions.append(position)

    def place_at(self, when: float) -> tuple[float, float, float] | None:
        """Where the node was at a date, seconds since 1970: degrees and metres above mean sea level; None: unknown."""
        nearest = self.near(self._driver.now() - (self._wall() - when))
        return None if nearest is None else (nearest.latitude, nearest.longitude, nearest.altitude)

    def near(self, moment: float) -> Position | None:
        """Where the node was at a moment on its timeline; None: unknown."""
        nearest = min(self._positions, key=lambda position: abs(position.at - moment), default=None)
        if nearest is None or abs(nearest.at - moment) > NEAR_S:
            return None
        return nearest
