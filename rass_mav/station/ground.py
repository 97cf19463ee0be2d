"""The conversation with ground stations: parameters, commands, texts, values (docs/how-to/ground-station.md).

Sources: https://mavlink.io/en/services/parameter.html, command.html, ping.html, ftp.html, and messages/common.html.
Requests to other components of the vehicle are ignored. A command to all components is answered only if it is known
here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

from rass_mav import __version__
from rass_mav.agent.agent import Agent
from rass_mav.agent.floods import Allowance
from rass_mav.agent.outgoing import Outgoing, Way, aside
from rass_mav.agent.settings import AgentSettings, GroundSettings
from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.policy import POTENTIAL_ONE
from rass_mav.core.routes.costs import COST_ONE, NO_COST
from rass_mav.errors import ConfigError, MalformedError
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import payload_of
from rass_mav.mavlink.frames import Frame, FrameReader, FrameWriter
from rass_mav.mavlink.identity import BROADCAST, addressed_to
from rass_mav.mavlink.messages import (
    COMMAND_ACK,
    COMMAND_LONG,
    HEARTBEAT,
    NAMED_VALUE_FLOAT,
    STATUSTEXT,
    WARNING,
    companion_heartbeat,
    named_value_float_payload,
    parse,
    statustext,
)
from rass_mav.station.outbox import Outbox
from rass_mav.station.parameters import INDEX, PARAMETERS
from rass_mav.station.texts import Texts

from . import parameters

log = logging.getLogger(__name__)

#: Names of the NAMED_VALUE_FLOATs that a node sends. PX4 repeats them as its own, so a reading must not use them.
VALUE_NAMES = ("RASS_PHI", "RASS_COST", "RASS_HOPS", "RASS_RISK", "RASS_FILL")
#: Bounds of an interval that a ground station may request, seconds. The wire format allows up to 2147.
LEAST_INTERVAL_S, MOST_INTERVAL_S = 0.5, 2000.0
#: For each connection: PARAM_SETs handled in a second, and listings of all parameters in ten seconds.
MOST_SETS_S, MOST_LISTS_10S = 10, 4
#: A change that restarts the node costs it its routes: at most one in this many seconds.
REBIRTH_S = 5.0


class _DeniedError(ConfigError):
    """The value may be valid, but not from this sender, or not now."""


class Ground:
    """A service of the agent: what it sends to the ground, and how it answers. `tend` returns the frames."""

    def __init__(
        self,
        agent: Agent,
        about: GroundSettings,
        configured: AgentSettings,
        now: float,
        computer: Callable[[], mav.ComputerStatus] | None = None,
    ) -> None:
        """
        :param configured: the settings from the file, without the changes made from the ground.
        :param computer: returns the state of the computer; None: unknown.
        """
        self._agent = agent
        self._about = about
        self._configured = configured
        self._started = now
        self._text_id = 0
        self.texts = Texts()
        self._direct = FrameWriter(agent.vehicle_writer.system_id, agent.vehicle_writer.component_id)
        """Writes the frames that go directly to the ground. Each connection has its own sequence."""
        self._reader = FrameReader()
        self._heard: set[Way] = set()
        self._outboxes = {way: Outbox(way, self._listed, len(PARAMETERS)) for way in (Way.VEHICLE, Way.GROUND)}
        self._set_here: dict[str, float] = {}
        """The values set in this life, by parameter name."""
        self.refused = 0
        """PARAM_SETs refused."""
        self.dropped = 0
        """PARAM_SETs and PARAM_REQUEST_LISTs dropped because too many came at once."""
        self._sets = {way: Allowance(MOST_SETS_S, 1.0) for way in self._outboxes}
        self._lists = {way: Allowance(MOST_LISTS_10S, 10.0) for way in self._outboxes}
        self._rebirths = Allowance(1, REBIRTH_S)
        self.computer = computer
        self._intervals = {NAMED_VALUE_FLOAT: about.values_s, mav.ONBOARD_COMPUTER_STATUS: about.computer_s}
        self._next = dict.fromkeys(self._intervals, now)

    # -- what comes in -------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now: float, *, stream: bool = False) -> None:
        """Bytes directly from a ground station: a datagram, or a piece of a stream, which may end in the middle of a
        frame. Vehicle telemetry in them is ignored."""
        for frame in self._reader.feed(data) if stream else self._reader.datagram(data):
            self._agent.guard.take(
                frame, now, self._hear_directly, lambda frame: f"message {frame.message_id} from the ground station"
            )

    def _hear_directly(self, frame: Frame, now: float) -> None:
        self._handle(frame, Way.GROUND, now)

    def hear(self, frame: Frame, now: float) -> None:
        """A frame from the autopilot's port: a ground station may have sent it."""
        self._handle(frame, Way.VEHICLE, now)

    def _handle(self, frame: Frame, way: Way, now: float) -> None:
        """Answer a frame, if it is for this component and asks for something."""
        if way not in self._heard:
            # A new listener must not wait a whole second: an autopilot forwards nothing before a heartbeat.
            self._heard.add(way)
            self._agent.beat_next(now)
        handler = _HANDLERS.get(frame.message_id)
        own = self._agent.vehicle_writer
        if handler is None or (frame.system_id, frame.component_id) == (own.system_id, own.component_id):
            return
        try:
            message = parse(frame)
        except MalformedError as error:
            log.debug("malformed frame: %s", error)
            return
        if addressed_to(message.target_system, message.target_component, own.system_id, own.component_id):
            handler(self, message, frame, self._outboxes[way], now)

    def _on_param_list(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        if self._lists[outbox.way].take(now):
            outbox.list_all()
        else:
            self.dropped += 1

    def _on_param_read(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        index = message.param_index if message.param_index >= 0 else INDEX.get(message.param_id, -1)
        if 0 <= index < len(PARAMETERS):
            outbox.answer(*self._listed(index))
        else:
            self._param_error(message.param_id, message.param_index, mav.DOES_NOT_EXIST, frame, outbox)

    def _on_param_set(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        if not self._sets[outbox.way].take(now):
            self.dropped += 1
            return
        index = INDEX.get(message.param_id)
        if index is None:
            self._param_error(message.param_id, -1, mav.DOES_NOT_EXIST, frame, outbox)
            return
        before = self._values()
        try:
            self._set(index, message.param_type, message.param_value, outbox.way, now)
        except ConfigError as error:
            self.refused += 1
            log.warning("parameter from the ground refused: %s", error)
            for mistake in error.mistakes:
                self.texts.add(WARNING, mistake)
            self._param_error(message.param_id, -1, _reason(index, error), frame, outbox)
            outbox.answer(*self._listed(index))
            return
        # Other parameters may have changed too: a policy has its own weights.
        others = [i for i, value in enumerate(self._values()) if value != before[i] and i != index]
        for i in (index, *others):
            outbox.answer(*self._listed(i), promises=True)

    def _param_error(self, name: str, index: int, error: int, frame: Frame, outbox: Outbox) -> None:
        if mav.PARAM_ERROR is not None and self._arrives(mav.PARAM_ERROR, outbox.way):
            target = {"target_system": frame.system_id, "target_component": frame.component_id}
            outbox.answer(mav.PARAM_ERROR, mav.param_error(name, index, error, **target))

    def _set(self, index: int, kind: int, value: float, way: Way, now: float) -> None:
        parameter = PARAMETERS[index]
        key = "may_set" if way is Way.GROUND else "may_set_by_radio"
        if not getattr(self._about, key):
            raise _DeniedError(f"{parameter.name}: ground.{key} is false")
        if kind != mav.REAL32:
            raise ConfigError(f"{parameter.name}: expected type REAL32 ({mav.REAL32}), got {kind}")
        agent = self._agent
        old = agent.settings
        new = parameters.changed(old, parameter, value)
        if new is not old:
            if parameter.rebirth and not self._rebirths.take(now):
                raise _DeniedError(f"{parameter.name}: too soon, try again in {REBIRTH_S:g} s")
            agent.take_over(new, now, rebirth=parameter.rebirth)
            parameters.remember(agent.store, self._configured, parameter, value)
            self._set_here[parameter.name] = value
            log.warning("%s set from the ground: %g, was %g", parameter.name, value, parameter.read(old))

    def keep_again(self) -> None:
        """Store the parameters in use again, after the store rolled back its uncommitted changes."""
        for name, value in self._set_here.items():
            parameter = PARAMETERS[INDEX[name]]
            if mav.single(parameter.read(self._agent.settings)) == value:
                parameters.remember(self._agent.store, self._configured, parameter, value)

    def _values(self) -> list[float]:
        settings = self._agent.settings
        return [parameter.read(settings) for parameter in PARAMETERS]

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "parameters": self.in_force(),
            "parameters_refused": self.refused,
            "requests_dropped": self.dropped,
            "texts_dropped": self.texts.dropped,
        }

    def in_force(self) -> dict[str, float]:
        """All parameters and their values."""
        return {p.name: value for p, value in zip(PARAMETERS, self._values(), strict=True)}

    def _listed(self, index: int) -> tuple[int, bytes]:
        parameter = PARAMETERS[index]
        value = mav.single(parameter.read(self._agent.settings))
        return mav.PARAM_VALUE, mav.param_value(parameter.name, value, len(PARAMETERS), index)

    def _on_ping(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        # A PING with a target is an answer.
        if message.target_system == BROADCAST and message.target_component == BROADCAST:
            target = {"target_system": frame.system_id, "target_component": frame.component_id}
            outbox.answer(mav.PING, mav.ping(message.time_usec, message.seq, **target))

    def _on_file_transfer(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        # Without an answer a ground station asks again for seconds before it tries something else. A request to all
        # components is for the autopilot, which has files.
        own = self._agent.vehicle_writer
        if (message.target_system, message.target_component) != (own.system_id, own.component_id):
            return
        target = {"target_system": frame.system_id, "target_component": frame.component_id}
        refusal = mav.file_transfer_refusal(bytes(message.payload), **target)
        if refusal is not None:
            outbox.answer(mav.FILE_TRANSFER_PROTOCOL, refusal)

    def _on_command(self, message: Any, frame: Frame, outbox: Outbox, now: float) -> None:
        answers: list[tuple[int, bytes]] = []
        result = mav.UNSUPPORTED
        about = _whole(message.param1)
        if not self._arrives(about, outbox.way):
            about = -1
        if message.command == mav.CMD_REQUEST_MESSAGE:
            answers = self._requested(about, _whole(message.param2), now)
        elif message.command == mav.CMD_GET_MESSAGE_INTERVAL and 0 <= about <= 0xFFFF:
            answers = [(mav.MESSAGE_INTERVAL, mav.message_interval(about, self._interval(about)))]
        elif message.command == mav.CMD_SET_MESSAGE_INTERVAL and self._interval(about) is not None:
            result = self._set_interval(about, message.param2, now)
        if answers:
            result = mav.ACCEPTED
        if result == mav.UNSUPPORTED and message.target_component == BROADCAST:
            return
        target = {"target_system": frame.system_id, "target_component": frame.component_id}
        outbox.answer(COMMAND_ACK, mav.command_ack(message.command, result, **target))
        for answer in answers:
            outbox.answer(*answer)

    def _requested(self, message_id: int, about: int, now: float) -> list[tuple[int, bytes]]:
        if message_id == HEARTBEAT:
            return [(HEARTBEAT, payload_of(companion_heartbeat()))]
        if message_id == mav.AUTOPILOT_VERSION:
            return [(mav.AUTOPILOT_VERSION, mav.autopilot_version(__version__))]
        if message_id == mav.MESSAGE_INTERVAL and 0 <= about <= 0xFFFF:
            return [(mav.MESSAGE_INTERVAL, mav.message_interval(about, self._interval(about)))]
        return self._periodic(message_id, now)

    def _interval(self, message_id: int) -> float | None:
        """Seconds between two of these messages; 0: never; None: not one of ours."""
        return 1.0 if message_id == HEARTBEAT else self._intervals.get(message_id)

    def _set_interval(self, message_id: int, micros: float, now: float) -> int:
        if message_id not in self._intervals:
            return mav.DENIED  # receivers rely on one heartbeat a second
        if micros == 0:
            about = self._about
            interval = about.values_s if message_id == NAMED_VALUE_FLOAT else about.computer_s
        elif micros == -1:
            interval = 0.0
        elif LEAST_INTERVAL_S <= micros / 1e6 <= MOST_INTERVAL_S:
            interval = micros / 1e6
        else:
            return mav.DENIED
        self._intervals[message_id] = interval
        self._next[message_id] = now
        return mav.ACCEPTED

    # -- what goes out -------------------------------------------------------------------------------------------------

    def tell(self, severity: int, text: str) -> None:
        """Send a text for people; `severity` as MAV_SEVERITY."""
        self.texts.add(severity, text)

    def heartbeat(self) -> Outgoing:
        """One for the stations that are connected directly."""
        return aside(self._writer(Way.GROUND).frame(HEARTBEAT, payload_of(companion_heartbeat())), Way.GROUND)

    def pace(self, rate: float) -> None:
        """Limit what goes to the ground through the autopilot to `rate` bytes/s."""
        self._outboxes[Way.VEHICLE].rate = rate

    def _writer(self, way: Way) -> FrameWriter:
        vehicle = self._agent.vehicle_writer
        if way is Way.VEHICLE:
            return vehicle
        self._direct.system_id = vehicle.system_id
        return self._direct

    def tend(self, now: float, out: list[Outgoing]) -> float:
        """Add the frames that are due to `out`. Returns when to call again."""
        due = math.inf
        for message_id, interval in self._intervals.items():
            if interval:
                if now >= self._next[message_id]:
                    self._next[message_id] = now + interval
                    for message in self._periodic(message_id, now):
                        self._say(*message)
                due = min(due, self._next[message_id])
        while (text := self.texts.take(now)) is not None:
            self._text_id = self._text_id % 0xFFFF + 1
            for piece in statustext(text.severity, text.text, text_id=self._text_id):
                self._say(STATUSTEXT, payload_of(piece))
        for way, outbox in self._outboxes.items():
            outgoing = outbox.take(now, self._writer(way))
            if outgoing is not None:
                out.append(outgoing)
            due = min(due, outbox.due())
        return min(due, self.texts.due())

    def _say(self, message_id: int, payload: bytes) -> None:
        for way, outbox in self._outboxes.items():
            if self._arrives(message_id, way):
                outbox.say(message_id, payload)

    def _arrives(self, message_id: int, way: Way) -> bool:
        """Whether a message sent on this connection arrives at the ground: the autopilot does not drop it."""
        firmware = self._agent.telemetry.firmware if way is Way.VEHICLE else None
        return firmware is None or firmware.passes_on(message_id)

    def _periodic(self, message_id: int, now: float) -> list[tuple[int, bytes]]:
        if message_id == NAMED_VALUE_FLOAT:
            boot_ms = int((now - self._started) * 1000.0)
            return [
                (message_id, named_value_float_payload(name, value, boot_ms))
                for name, value in zip(VALUE_NAMES, self._own_values(now), strict=True)
                if value is not None
            ]
        if message_id == mav.ONBOARD_COMPUTER_STATUS and self.computer is not None:
            return [(message_id, mav.onboard_computer_status(self.computer()))]
        return []

    def _own_values(self, now: float) -> tuple[float | None, ...]:
        node = self._agent.node
        hops = node.routing.hops
        costs = node.policy.costs is not None
        capacity = node.holdings.capacity_items
        return (
            None if node.base or costs else node.potential / POTENTIAL_ONE,
            None if node.base or not costs else -1.0 if node.potential >= NO_COST else node.potential / COST_ONE,
            -1.0 if hops == NO_ROUTE else float(hops),
            node.risk.risk(now),
            None if capacity is None else len(node.holdings.custody) / capacity,
        )


def _reason(index: int, error: ConfigError) -> int:
    """Why a PARAM_SET was refused, as MAV_PARAM_ERROR."""
    if not PARAMETERS[index].key:
        return mav.READ_ONLY
    return mav.PERMISSION_DENIED if isinstance(error, _DeniedError) else mav.VALUE_OUT_OF_RANGE


def _whole(value: float) -> int:
    """The message id in a command's parameter; -1 if it is not one."""
    return int(value) if math.isfinite(value) and 0 <= value < 1 << 24 else -1


_Handler = Callable[[Ground, Any, Frame, Outbox, float], None]
_HANDLERS: dict[int, _Handler] = {
    mav.PARAM_REQUEST_LIST: Ground._on_param_list,
    mav.PARAM_REQUEST_READ: Ground._on_param_read,
    mav.PARAM_SET: Ground._on_param_set,
    mav.PING: Ground._on_ping,
    mav.FILE_TRANSFER_PROTOCOL: Ground._on_file_transfer,
    COMMAND_LONG: Ground._on_command,
    mav.COMMAND_INT: Ground._on_command,
}
