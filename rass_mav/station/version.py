"""Asks the autopilot for the version of its firmware, which determines what the autopilot forwards.

It asks at every start, and again when the autopilot has restarted, perhaps with other firmware. It also asks again when
the autopilot starts or stops signing its frames: an autopilot that requires signatures does not answer an unsigned
question, and a missing answer shows that.
"""

from __future__ import annotations

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.mavlink.component import AUTOPILOT_VERSION
from rass_mav.mavlink.firmware import request_message
from rass_mav.mavlink.messages import COMMAND_LONG

#: Without an answer the question is repeated after the first time, then after twice as long, up to the second. Seconds.
FIRST_RETRY_S = 1.0
LONGEST_RETRY_S = 60.0


class VersionQuestion(VehicleService):
    """A service of the agent. The agent's telemetry takes the answer."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._about: tuple[int, int, bool | None] | None = None
        self._ask_at = 0.0
        self._retry_s = FIRST_RETRY_S

    def step(self, now: float) -> None:
        """Once a step: ask, unless the version is known."""
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
