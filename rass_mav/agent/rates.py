"""Asks the autopilot for the messages that the node needs, as often as it needs them.

With MAV_CMD_SET_MESSAGE_INTERVAL (https://mavlink.io/en/messages/common.html#MAV_CMD_SET_MESSAGE_INTERVAL) at every
start, and again when the autopilot has restarted: it does not keep what was asked for. A restart shows by time_boot_ms,
by heartbeats that stop and begin again, or only by messages that come no more; each of these is reason to ask.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from rass_mav.agent.agent import Agent
from rass_mav.errors import ConfigError
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.messages import COMMAND_ACK, parse, set_message_interval

log = logging.getLogger(__name__)

#: Without an answer a request is repeated after so many seconds, then after twice as many, up to the second number.
FIRST_RETRY_S = 1.0
LONGEST_RETRY_S = 30.0
#: An autopilot whose heartbeats were missing for so long may have restarted, seconds.
SILENT_S = 5.0
#: A message that is missing for so many of its intervals, and at least `SILENT_S`, is asked for again.
MISSING_INTERVALS = 5
_COMMAND: int = common.MAV_CMD_SET_MESSAGE_INTERVAL
_ACCEPTED: int = common.MAV_RESULT_ACCEPTED
_BUSY = (common.MAV_RESULT_TEMPORARILY_REJECTED, common.MAV_RESULT_IN_PROGRESS)


def message_ids(messages: Mapping[str, float]) -> dict[int, float]:
    """Seconds between two messages by message id, from such by name. Raises `ConfigError` for unknown names."""
    found = {}
    unknown = []
    for name, interval_s in messages.items():
        id = getattr(common, f"MAVLINK_MSG_ID_{name}", None)
        if isinstance(id, int):
            found[id] = interval_s
        else:
            unknown.append(f"{name}: no message of the common dialect")
    if unknown:
        raise ConfigError(*unknown)
    return found


class MessageRates:
    """A service of the agent. One request at a time, for an answer does not say which message it is about."""

    def __init__(self, agent: Agent, intervals: Mapping[int, float]) -> None:
        """`intervals`: seconds between two messages, by message id."""
        self._agent = agent
        self._intervals = dict(intervals)
        self.refused: set[int] = set()
        """Messages that the autopilot will not send."""
        self._open: list[int] = []
        self._retry_s = FIRST_RETRY_S
        self._due: float | None = None
        self._asked: tuple[int, int] | None = None
        self._reboots = 0
        self._heartbeat_at: float | None = None
        self._heard_at: dict[int, float] = {}
        self._pause_s = dict.fromkeys(intervals, 0.0)

    def hear(self, frame: Frame, now: float) -> None:
        """Answers of the autopilot, and the messages that were asked for."""
        telemetry = self._agent.telemetry
        if frame.system_id != telemetry.system_id or frame.component_id != telemetry.component_id:
            return
        if frame.message_id in self._intervals:
            self._heard_at[frame.message_id] = now
            self._pause_s[frame.message_id] = 0.0
        elif frame.message_id == COMMAND_ACK and self._due is not None and self._open:
            answer = parse(frame)
            ours = answer.target_system in (0, self._agent.vehicle_writer.system_id)
            if answer.command != _COMMAND or not ours or answer.result in _BUSY:
                return
            self._answered(self._open.pop(0), answer.result, now)

    def _answered(self, message_id: int, result: int, now: float) -> None:
        # From now on it has to come.
        self._heard_at[message_id] = now
        self._due = None
        self._retry_s = FIRST_RETRY_S
        if result == _ACCEPTED:
            self.refused.discard(message_id)
        elif message_id not in self.refused:
            self.refused.add(message_id)
            log.warning("the autopilot does not send message %d (result %d)", message_id, result)
        self._ask(now)

    def step(self, now: float) -> None:
        """Once a step: begin, repeat, and see what is missing."""
        telemetry = self._agent.telemetry
        heartbeat = telemetry.heartbeat_at
        if heartbeat is None or not telemetry.system_id:
            return
        silent = self._heartbeat_at is None or heartbeat - self._heartbeat_at > SILENT_S
        if silent or telemetry.reboots != self._reboots or self._asked != self._who():
            self._reboots = telemetry.reboots
            self._asked = self._who()
            self._begin(self._intervals, now)
        self._heartbeat_at = heartbeat
        if now - heartbeat > SILENT_S:
            return
        for message_id, interval_s in self._intervals.items():
            if message_id in self._open or message_id in self.refused:
                continue
            missing = now - self._heard_at.get(message_id, now)
            if missing > max(SILENT_S, MISSING_INTERVALS * interval_s) + self._pause_s[message_id]:
                # Perhaps it has nothing to say, as a local position before there is an origin: ask ever more seldom.
                self._pause_s[message_id] = min(2 * self._pause_s[message_id] + SILENT_S, LONGEST_RETRY_S)
                self._open.append(message_id)
        self._ask(now)

    def _who(self) -> tuple[int, int]:
        return self._agent.telemetry.system_id, self._agent.vehicle_writer.system_id

    def _begin(self, message_ids: Mapping[int, float], now: float) -> None:
        self._open = list(message_ids)
        self.refused.clear()
        self._retry_s = FIRST_RETRY_S
        self._due = None

    def _ask(self, now: float) -> None:
        if not self._open or (self._due is not None and now < self._due):
            return
        if self._due is not None:
            self._retry_s = min(2 * self._retry_s, LONGEST_RETRY_S)
        self._due = now + self._retry_s
        telemetry = self._agent.telemetry
        message_id = self._open[0]
        request = set_message_interval(
            message_id,
            self._intervals[message_id],
            target_system=telemetry.system_id,
            target_component=telemetry.component_id,
        )
        self._agent.tell_vehicle(self._agent.vehicle_writer.message(request))
