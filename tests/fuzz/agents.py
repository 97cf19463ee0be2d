"""An agent between an autopilot, a ground station and neighbours: each says whole frames, with anything in them."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from rass_mav.core.node import Node
from rass_mav.mavlink import component as mav
from rass_mav.mavlink.dialect import FORMATS, common
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.messages import (
    COMMAND_LONG,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    HOME_POSITION,
    LOCAL_POSITION_NED,
    NAMED_VALUE_FLOAT,
    TUNNEL,
)
from rass_mav.station.parameters import PARAMETERS
from tests.agent.conversation import Conversation
from tests.core.books import check_node

from .source import Source

#: Deeds in one conversation.
MOST_DEEDS = 60
#: What somebody here listens to.
HEARD = (
    HEARTBEAT, GLOBAL_POSITION_INT, LOCAL_POSITION_NED, HOME_POSITION, NAMED_VALUE_FLOAT, TUNNEL, COMMAND_LONG,
    mav.COMMAND_INT, mav.PARAM_REQUEST_LIST, mav.PARAM_REQUEST_READ, mav.PARAM_SET, mav.PING,
)  # fmt: skip
COMMANDS = (mav.CMD_REQUEST_MESSAGE, mav.CMD_GET_MESSAGE_INTERVAL, mav.CMD_SET_MESSAGE_INTERVAL, 0)
VALUES = (0.0, -1.0, 0.5, 1.0, 4.0, 1e6, 1e30, math.inf, math.nan)
#: Who speaks: the autopilot, a ground station, a neighbour.
SPEAKERS = ((7, 1), (255, 190), (3, 191))


class _Talk:
    def __init__(self, source: Source) -> None:
        self.source = source
        self.conversation = Conversation(ground={"values_s": 1.0, "computer_s": 1.0})
        self.writers = [FrameWriter(*who) for who in SPEAKERS]

    def hear(self, frame: bytes) -> None:
        """From any side."""
        talk, way = self.conversation, self.source.byte() % 3
        if way == 0:
            talk.agent.vehicle_bytes(frame, talk.now)
        elif way == 1:
            talk.ground.receive(frame, talk.now)
        else:
            talk.gate.say(talk.agent.peer_bytes(frame, talk.now))

    def value(self) -> float:
        """A number of a ground station: a likely one, or any."""
        if self.source.byte() % 2:
            return self.source.pick(VALUES)
        (any_value,) = struct.unpack("<f", self.source.some(4).ljust(4, b"\0"))
        return float(any_value)


def _bytes(talk: _Talk) -> None:
    talk.hear(talk.source.some(talk.source.byte()))


def _frame(talk: _Talk) -> None:
    """A message that somebody listens to, with any content."""
    writer, message_id = talk.source.pick(talk.writers), talk.source.pick(HEARD)
    payload = talk.source.some(talk.source.byte() % (FORMATS[message_id].size + 1))
    talk.hear(writer.frame(message_id, payload or b"\0"))


def _set(talk: _Talk) -> None:
    name, value = talk.source.pick(PARAMETERS).name.encode(), talk.value()
    talk.hear(talk.writers[1].message(common.MAVLink_param_set_message(7, 191, name, value, talk.source.pick((9, 2)))))


def _command(talk: _Talk) -> None:
    values = [float(talk.source.pick(HEARD)), talk.value(), *[0.0] * 5]
    message = common.MAVLink_command_long_message(7, 191, talk.source.pick(COMMANDS), 0, *values)
    talk.hear(talk.writers[1].message(message))


def _step(talk: _Talk) -> None:
    conversation = talk.conversation
    conversation.now += 1.0
    conversation.gate.say(conversation.agent.step(conversation.now))


def _measure(talk: _Talk) -> None:
    talk.conversation.agent.measure(talk.conversation.now)


def _leave(talk: _Talk) -> None:
    """All that waits is written, and what is due in the next half second leaves."""
    conversation = talk.conversation
    batch = conversation.gate.begin()
    if batch is not None:
        conversation.store.write(batch)
    conversation.gate.written()
    until = conversation.now + 0.5
    while conversation.now <= until:
        frames, due = conversation.agent.tend(conversation.now)
        conversation.gate.say(frames)
        assert due > conversation.now, "or it would be asked for ever"
        conversation.now = due
    conversation.now = until


_DEEDS: tuple[Callable[[_Talk], None], ...] = (_bytes, _frame, _set, _command, _step, _measure, _leave)


def play(data: bytes) -> None:
    """Each deed is a byte; most take more bytes."""
    source = Source(data)
    talk = _Talk(source)
    for _ in range(MOST_DEEDS):
        if not source:
            break
        source.pick(_DEEDS)(talk)
    _leave(talk)
    _step(talk)
    node = talk.conversation.agent.node
    if isinstance(node, Node):
        check_node(node)
