"""Reads and sets an autopilot's parameters: identification, questions, answers, retries. No input and output.

Each talk is driven from outside: `hear` takes the autopilot's frames, `say` returns the questions that are due. Both
take the time.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

from rass_mav.errors import MalformedError, RassError
from rass_mav.mavlink.component import AUTOPILOT_VERSION, PARAM_ERROR, PARAM_REQUEST_READ, PARAM_SET, PARAM_VALUE
from rass_mav.mavlink.dialect import common
from rass_mav.mavlink.firmware import AutopilotVersion, Firmware, read_version, request_message
from rass_mav.mavlink.frames import Frame
from rass_mav.mavlink.identity import AUTOPILOT_COMPONENT
from rass_mav.mavlink.messages import COMMAND_LONG, HEARTBEAT, parse
from rass_mav.mavlink.vehicle_parameters import (
    ParameterValue,
    is_bytewise,
    param_request_read,
    param_set,
    read_error,
    read_value,
)

_NO_AUTOPILOT: int = common.MAV_AUTOPILOT_INVALID
_ARMED: int = common.MAV_MODE_FLAG_SAFETY_ARMED
#: Of an autopilot that has not reported its version.
NO_VERSION = AutopilotVersion(0, (0, 0, 0))


class VehicleError(RassError):
    """An autopilot that is not heard, or does not answer."""


class Patience(NamedTuple):
    """How long to wait."""

    heartbeat_s: float = 6.0
    """How long to wait for the autopilot's first heartbeat, seconds."""
    answer_s: float = 1.0
    """How long to wait for an answer before asking again, seconds."""
    tries: int = 4
    """How often to ask in total."""
    window: int = 4
    """Questions open at a time. ArduPilot queues 20; a slow radio can carry few."""


class Question(NamedTuple):
    """A message to the autopilot."""

    message_id: int
    payload: bytes


class Autopilot:
    """The autopilot that is asked. Its system id changes when a new one is set."""

    def __init__(self, system_id: int, type: int, *, armed: bool) -> None:
        """`system_id`: 1..255. `type`: MAV_AUTOPILOT from its heartbeat."""
        self.system_id = system_id
        self.type = type
        self.armed = armed
        self.version = NO_VERSION

    @property
    def firmware(self) -> Firmware:
        """The firmware that it runs."""
        return Firmware(self.type, self.version.version)

    @property
    def bytewise(self) -> bool:
        """Whether whole numbers are sent as their bytes, not converted to floats."""
        return is_bytewise(self.version.capabilities, self.type)


class Talk(ABC):
    """One conversation with the autopilot."""

    next_at = -math.inf
    """When to call `say` again, seconds on the timeline of its `now`."""
    done = False

    @abstractmethod
    def hear(self, frame: Frame, now: float) -> None:
        """A frame from the autopilot's port, whoever sent it."""

    @abstractmethod
    def say(self, now: float) -> list[Question]:
        """The questions that are due."""


class Asking(Talk):
    """Asks one question until it is answered or patience ends."""

    def __init__(self, patience: Patience) -> None:
        """`patience`: how often to ask, and how long to wait each time."""
        self._patience = patience
        self._tries = 0

    def _again(self, question: Question, now: float) -> list[Question]:
        """The question if it is due. Without an answer to the last one the talk ends."""
        if now < self.next_at:
            return []
        if self._tries == self._patience.tries:
            self.done = True
            return []
        self._tries += 1
        self.next_at = now + self._patience.answer_s
        return [question]


class Introduction(Asking):
    """Waits for an autopilot's heartbeat, and asks for its version and capabilities."""

    def __init__(self, system_id: int, patience: Patience) -> None:
        """`system_id`: of the autopilot; 0: the first one heard."""
        super().__init__(patience)
        self.autopilot: Autopilot | None = None
        self.others: set[int] = set()
        """System ids of other autopilots that were heard."""
        self._wanted = system_id

    def hear(self, frame: Frame, now: float) -> None:
        """Take heartbeats and the version."""
        if frame.component_id != AUTOPILOT_COMPONENT or not frame.system_id:
            return
        known = self.autopilot
        if frame.message_id == HEARTBEAT:
            message = parse(frame)
            if message.autopilot == _NO_AUTOPILOT:
                return
            if frame.system_id != (known.system_id if known else self._wanted or frame.system_id):
                self.others.add(frame.system_id)
            elif known is None:
                armed = bool(message.base_mode & _ARMED)
                self.autopilot = Autopilot(frame.system_id, message.autopilot, armed=armed)
                self.next_at = now
            else:
                known.armed = bool(message.base_mode & _ARMED)
        elif known is not None and frame.message_id == AUTOPILOT_VERSION and frame.system_id == known.system_id:
            known.version = read_version(frame)
            self.done = True

    def say(self, now: float) -> list[Question]:
        """Ask for the version. Some firmware does not report it; the talk then ends without one."""
        if self.autopilot is None or self.done:
            self.next_at = math.inf
            return []
        question = Question(COMMAND_LONG, request_message(AUTOPILOT_VERSION, **_target(self.autopilot)))
        return self._again(question, now)


class Exchange(Talk):
    """Asks one question for each of several parameters. The answer is the parameter's value."""

    def __init__(
        self, autopilot: Autopilot, questions: Mapping[str, Question], patience: Patience, *, new_system_id: int = 0
    ) -> None:
        """`questions`: by parameter name. `new_system_id`: the answer may come from this system id, which the autopilot
        then uses; 0: the system id is not being changed."""
        self.values: dict[str, ParameterValue] = {}
        """The answers."""
        self.refused: dict[str, int] = {}
        """Parameters answered with PARAM_ERROR, with the MAV_PARAM_ERROR."""
        self.silent: list[str] = []
        """Parameters without an answer. ArduPilot before 4.7 and PX4 do not answer for parameters that they lack."""
        self._autopilot = autopilot
        self._ids = {autopilot.system_id, new_system_id or autopilot.system_id}
        self._patience = patience
        self._waiting = dict(questions)
        self._open: dict[str, tuple[Question, float, int]] = {}
        self.done = not questions

    def hear(self, frame: Frame, now: float) -> None:
        """Take values and errors. An answer that does not parse is ignored."""
        if frame.system_id not in self._ids or frame.component_id != AUTOPILOT_COMPONENT:
            return
        try:
            if frame.message_id == PARAM_VALUE:
                value = read_value(frame, bytewise=self._autopilot.bytewise)
                if self._open.pop(value.name, None) is not None:
                    self.values[value.name] = value
                    self._autopilot.system_id = frame.system_id
            elif frame.message_id == PARAM_ERROR:
                name, error = read_error(frame)
                if self._open.pop(name, None) is not None:
                    self.refused[name] = error
            else:
                return
        except MalformedError:
            return
        self._look(now)

    def say(self, now: float) -> list[Question]:
        """The questions that are due, for the first time or again."""
        out = []
        for name, (question, at, tries) in list(self._open.items()):
            if now < at:
                continue
            if tries == self._patience.tries:
                del self._open[name]
                self.silent.append(name)
            else:
                self._open[name] = (question, now + self._patience.answer_s, tries + 1)
                out.append(question)
        while self._waiting and len(self._open) < self._patience.window:
            name = next(iter(self._waiting))
            question = self._waiting.pop(name)
            self._open[name] = (question, now + self._patience.answer_s, 1)
            out.append(question)
        self._look(now)
        return out

    def _look(self, now: float) -> None:
        self.done = not self._open and not self._waiting
        room = self._waiting and len(self._open) < self._patience.window
        self.next_at = now if room else min((at for _, at, _ in self._open.values()), default=math.inf)


def reading(autopilot: Autopilot, name: str) -> Question:
    """The question for the value of a parameter."""
    return Question(PARAM_REQUEST_READ, param_request_read(name, **_target(autopilot)))


def setting(autopilot: Autopilot, value: ParameterValue) -> Question:
    """The request to set a parameter, with the type that the autopilot reported."""
    payload = param_set(value.name, value.value, value.kind, bytewise=autopilot.bytewise, **_target(autopilot))
    return Question(PARAM_SET, payload)


def _target(autopilot: Autopilot) -> dict[str, int]:
    return {"target_system": autopilot.system_id, "target_component": AUTOPILOT_COMPONENT}
