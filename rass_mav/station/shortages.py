"""Reports to the ground what a node has lacked for long, and when it is available again
(docs/how-to/ground-station.md)."""

from __future__ import annotations

import math
from collections.abc import Callable

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.mavlink.messages import INFO, WARNING

#: Seconds without a base, a position or a reading before that is reported.
NO_BASE_S = 120.0
NO_POSITION_S = 60.0
NO_READING_S = 30.0
#: Seconds that it must be available again before that is reported: a loose contact comes and goes.
BACK_S = 10.0
#: Seconds between two reports that the same thing is missing, at least.
AGAIN_S = 300.0
_NOTHING = "RASS: no measurements: no position, no reading"


class Shortage:
    """One thing that should be available. It determines when to report that it is missing, or available again."""

    __slots__ = ("_after_s", "_again_at", "_since", "_there", "missed")

    def __init__(self, after_s: float, now: float) -> None:
        """`after_s`: how long it must be missing before that is reported, seconds."""
        self._after_s = after_s
        self._there = False
        self._since = now
        """Since when it has been available, or missing, without a break."""
        self._again_at = -math.inf
        self.missed = False
        """Whether the last report was that it is missing."""

    def look(self, there: bool, now: float) -> bool:
        """Update the state. Returns whether to report now that `missed` has changed."""
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


class Shortages(VehicleService):
    """A service of the agent. It watches for a route to a base, a position and a reading."""

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
        :param position: whether a position is expected: on a drone with an autopilot.
        :param reading: whether a reading is expected: on a node with a sensor, or a drone whose autopilot may have one.
        :param trouble: returns why there is no reading, in words; empty: unknown.
        """
        self._agent = agent
        self._base = None if agent.node.base else Shortage(NO_BASE_S, now)
        self._position = Shortage(NO_POSITION_S, now) if position else None
        self._reading = Shortage(NO_READING_S, now) if reading else None
        self._trouble = trouble

    def step(self, now: float) -> None:
        """Once a step: send the reports that are due. Each text fits one STATUSTEXT, to save airtime."""
        agent = self._agent
        if (base := self._base) is not None:
            route = agent.node.routing.route
            if base.look(route is not None, now):
                if route is not None:
                    agent.tell_ground(INFO, f"RASS: base {route.base} in reach again")
                else:
                    agent.tell_ground(WARNING, f"RASS: no base in reach for {NO_BASE_S:g} s, data wait here")
        if (position := self._position) is not None and position.look(self._has_position(now), now):
            if position.missed:
                some = f"RASS: no position for {NO_POSITION_S:g} s, none in new data"
                agent.tell_ground(WARNING, some if any(agent.circumstances(now)) else _NOTHING)
            else:
                agent.tell_ground(INFO, "RASS: position available again")
        if (reading := self._reading) is not None and reading.look(agent.node.risk.known(now), now):
            if reading.missed:
                # Of an autopilot that has died, the position is reported later.
                last = (
                    not agent.node.base and (position is None or position.missed) and not any(agent.circumstances(now))
                )
                why = self._trouble()
                if last:
                    text = f"RASS: no measurements: no position, and {why}" if why else _NOTHING
                else:
                    text = "RASS: no radiation reading, worst risk assumed" + (f": {why}" if why else "")
                agent.tell_ground(WARNING, text)
            else:
                agent.tell_ground(INFO, "RASS: radiation readings available again")

    def _has_position(self, now: float) -> bool:
        """Whether there is a position for a measurement, on Earth or only relative to the autopilot's origin."""
        position, local, _ = self._agent.circumstances(now)
        return position is not None or local is not None
