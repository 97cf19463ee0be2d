"""Tells the ground when the node's sensor falls silent, and when it reads again."""

from __future__ import annotations

from rass_mav.agent.agent import Agent
from rass_mav.sensor.base import Sensor

#: At most this often, seconds.
REPORT_S = 30.0
_WARNING = 4
_INFO = 6


class SensorWatch:
    """Watches one sensor."""

    def __init__(self, sensor: Sensor, agent: Agent, now: float) -> None:
        self._sensor = sensor
        self._agent = agent
        self._reads = True
        self._next_report = now + REPORT_S

    def look(self, now: float) -> None:
        """Tell what has changed."""
        reads = self._agent.node.risk.known(now)
        if reads == self._reads or now < self._next_report:
            return
        self._reads = reads
        # A cable with a loose contact must not fill the ground station's screen. At the start a sensor gets this time.
        self._next_report = now + REPORT_S
        if reads:
            self._agent.tell_ground(_INFO, "RASS: the radiation sensor reads again")
        else:
            trouble = self._sensor.state().trouble
            self._agent.tell_ground(
                _WARNING, f"RASS: no radiation reading, risk counts as the worst{': ' + trouble if trouble else ''}"
            )
