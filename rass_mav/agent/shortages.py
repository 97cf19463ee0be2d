"""Tells the ground what the node has lacked for long, and when it is there again (docs/ground-station.md)."""

from __future__ import annotations

import math
from collections.abc import Callable

from rass_mav.agent.agent import POSITION_STALE_S, Agent
from rass_mav.mavlink.frames import Frame

#: What is missing is told after so many seconds without it.
NO_BASE_S = 120.0
NO_POSITION_S = 60.0
NO_READING_S = 30.0
#: That it is back is told when it has been there for so long, seconds: a loose contact comes and goes.
BACK_S = 10.0
#: Between two texts that the same thing is missing, seconds at least.
AGAIN_S = 300.0
_WARNING = 4
_INFO = 6


class Shortage:
    """One thing that should be there: whether people have to hear that it is not, or that it is again."""

    __slots__ = ("_after_s", "_again_at", "_since", "_there", "missed")

    def __init__(self, after_s: float, now: float) -> None:
        """`after_s`: how long it has to be missing before that is told, seconds."""
        self._after_s = after_s
        self._there = False
        self._since = now
        """Since when it has been there, or missing, without a break."""
        self._again_at = -math.inf
        self.missed = False
        """Whether the ground was told last that it is missing."""

    def look(self, there: bool, now: float) -> bool:
        """Whether to tell now that `missed` has changed."""
        if there != self._there:
            self._there, self._since = there, now
        lasts_s = now - self._since
        if there and self.missed and lasts_s >= BACK_S:
            self.missed = False
            return True
        if not there and not self.missed and lasts_s >= self._after_s and now >= self._again_at:
            self.missed = True
            self._again_at = now + AGAIN_S
            return True
        return False


class Shortages:
    """A service of the agent: a way to a base, a position, a reading."""

    def __init__(
        self,
        agent: Agent,
        now: float,
        *,
        position: bool,
        reading: bool,
        trouble: Callable[[], str] = lambda: "",
    ) -> None:
        """
        :param position: whether there should be one: a drone with an autopilot.
        :param reading: the same: a node with a sensor, or a drone whose autopilot may have one.
        :param trouble: why there is no reading, in words; empty: nobody knows.
        """
        self._agent = agent
        self._base = None if agent.node.base else Shortage(NO_BASE_S, now)
        self._position = Shortage(NO_POSITION_S, now) if position else None
        self._reading = Shortage(NO_READING_S, now) if reading else None
        self._trouble = trouble

    def hear(self, frame: Frame, now: float) -> None:
        """Telemetry has it already."""

    def step(self, now: float) -> None:
        """Once a step. Each text fits one STATUSTEXT, for airtime is dear."""
        agent = self._agent
        if (base := self._base) is not None:
            route = agent.node.routing.route
            if base.look(route is not None, now):
                if route is not None:
                    agent.tell_ground(_INFO, f"RASS: base {route.base} in reach again")
                else:
                    agent.tell_ground(_WARNING, f"RASS: no base in reach for {NO_BASE_S:g} s, data wait here")
        if (position := self._position) is not None and position.look(self._has_position(now), now):
            if position.missed:
                agent.tell_ground(_WARNING, f"RASS: no position for {NO_POSITION_S:g} s, data carry none")
            else:
                agent.tell_ground(_INFO, "RASS: the position is known again")
        if (reading := self._reading) is not None and reading.look(agent.node.risk.known(now), now):
            if reading.missed:
                why = self._trouble()
                agent.tell_ground(
                    _WARNING, f"RASS: no radiation reading, worst risk assumed{': ' + why if why else ''}"
                )
            else:
                agent.tell_ground(_INFO, "RASS: the radiation sensor reads again")

    def _has_position(self, now: float) -> bool:
        """One that a measurement would carry, be it relative to the autopilot's origin only."""
        telemetry = self._agent.telemetry
        known = (telemetry.position, telemetry.local)
        return any(position is not None and now - position.at <= POSITION_STALE_S for position in known)
