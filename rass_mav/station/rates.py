"""Asks the autopilot for the messages that the node needs, at the rates it needs.

It uses MAV_CMD_SET_MESSAGE_INTERVAL (https://mavlink.io/en/messages/common.html#MAV_CMD_SET_MESSAGE_INTERVAL) at every
start, and again after the autopilot restarts, because the autopilot does not store the rates. The signs of a restart
are a smaller time_boot_ms, heartbeats that stop and start again, or messages that no longer come.
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

#: Without an answer a request is repeated after the first time, then after twice as long, up to the second. Seconds.
FIRST_RETRY_S = 1.0
LONGEST_RETRY_S = 30.0
#: An autopilot without heartbeats for this long may have restarted, seconds.
SILENT_S = 5.0
#: A message is requested again when it has been missing for this many of its intervals, and at least `SILENT_S`.
MISSING_INTERVALS = 5
_COMMAND: int = common.MAV_CMD_SET_MESSAGE_INTERVAL
_ACCEPTED: int = common.MAV_RESULT_ACCEPTED
_BUSY = (common.MAV_RESULT_TEMPORARILY_REJECTED, common.MAV_RESULT_IN_PROGRESS)


def message_ids(messages: Mapping[str, float]) -> dict[int, float]:
    """Replace message names by ids; the values are intervals in seconds. Raises `ConfigError` for unknown names."""
    found = {}
    unknown = []
    for name, interval_s in messages.items():
        id = getattr(common, f"MAVLINK_MSG_ID_{name}", None)
        if isinstance(id, int):
            found[id] = interval_s
        else:
            unknown.append(f"{name}: not a message of the common dialect")
    if unknown:
        raise ConfigError(*unknown)
    return found


class MessageRates:
    """A service of the agent. It makes one request at a time, because an answer does not name the message."""

    def __init__(self, agent: Agent, intervals: Mapping[int, float]) -> None:
        """`intervals`: seconds between two messages, by message id."""
        self._agent = agent
        self._intervals = dict(intervals)
        self.refused: set[int] = set()
        """Messages that the autopilot refuses to send."""
        self._open: list[int] = []
        self._retry_s = FIRST_RETRY_S
        self._due: float | None = None
        self._asked: tuple[int, int] | None = None
        self._reboots = 0
        self._heartbeat_at: float | None = None
        self._heard_at: dict[int, float] = {}
        self._pause_s = dict.fromkeys(intervals, 0.0)

    def hear(self, frame: Frame, now: float) -> None:
        """Take the autopilot's answers, and note which requested messages come."""
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
        # From now on the message is expected.
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
        """Once a step: start requests, repeat them, and check which messages are missing."""
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
                # Ask less and less often: there may be nothing to send, such as a local position without an origin.
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
