"""Asks the autopilot which version of its firmware it runs.

What it passes on depends on that. It is asked at every start, and again when the autopilot has restarted, for it may
run another firmware then. It is also asked again when its frames begin or cease to be signed: an autopilot that wants
signatures answers nobody who has none, and that shows here.
"""

from __future__ import annotations

from rass_mav.agent.agent import Agent
from rass_mav.mavlink.component import AUTOPILOT_VERSION
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import COMMAND_LONG
from rass_mav.mavlink.vehicle_parameters import request_message

#: Without an answer it is asked again after so many seconds, then after twice as many, up to the second number.
FIRST_RETRY_S = 1.0
LONGEST_RETRY_S = 60.0


class VersionQuestion:
    """A service of the agent. The answer goes to its telemetry."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._about: tuple[int, int, bool] | None = None
        self._ask_at = 0.0
        self._retry_s = FIRST_RETRY_S

    def hear(self, frame: Frame, now: float) -> None:
        """Nothing: telemetry hears the answer."""

    def step(self, now: float) -> None:
        """Once a step: ask, unless it is known."""
        telemetry = self._agent.telemetry
        if telemetry.heartbeat_at is None:
            return
        about = (telemetry.system_id, telemetry.reboots, telemetry.signed)
        if about != self._about:
            self._about = about
            telemetry.version = None
            self._ask_at, self._retry_s = now, FIRST_RETRY_S
        if telemetry.version is not None or now < self._ask_at:
            return
        self._ask_at = now + self._retry_s
        self._retry_s = min(2 * self._retry_s, LONGEST_RETRY_S)
        target = {"target_system": telemetry.system_id, "target_component": telemetry.component_id}
        payload = request_message(AUTOPILOT_VERSION, **target)
        self._agent.tell_vehicle(self._agent.vehicle_writer.frame(COMMAND_LONG, payload))
