"""The frames that leave a node: where each goes, how urgent it is, whether it must wait for the disk, and when answers
leave.

Where frames contend for the air, a node that has heard a frame does not answer it at once: its neighbours would do the
same, and so would the sender with its next datum. Answers, and the data that move on, wait for a random time first
(RFC 5148 recommends that for forwarded messages). What comes together in that time shares frames.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from rass_mav.agent.seam import KEYLESS, Keyless
from rass_mav.core.messages import BROADCAST, KINDS, Message, Urgency, destination, is_of_transfer, joined
from rass_mav.core.participant import Participant
from rass_mav.core.store import Store
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.wire import encode


class Way(IntEnum):
    """Where a frame goes, or came from."""

    VEHICLE = 0
    """The autopilot, and through it the ground."""
    GROUND = 1
    """A ground station, directly (`ground.url`)."""
    NEIGHBOURS = 2


class Outgoing(NamedTuple):
    """A frame that leaves."""

    frame: bytes
    target: int
    """Node id of the neighbour it is for, or BROADCAST. Every node in range may hear it in either case."""
    promises: bool
    """True: it depends on changes that are not on disk yet, and must not leave before the store has committed."""
    urgency: Urgency = Urgency.DATA
    """Which frames leave first where airtime is short."""
    way: Way = Way.NEIGHBOURS


def aside(frame: bytes, way: Way, *, promises: bool = False) -> Outgoing:
    """A frame for the autopilot or the ground."""
    return Outgoing(frame, BROADCAST, promises, Urgency.VEHICLE, way)


def frames_of(
    messages: Sequence[Message],
    writer: FrameWriter,
    payload_type: int,
    store: Store,
    now: float,
    trust: Keyless = KEYLESS,
) -> list[Outgoing]:
    """The messages as frames of `writer`, in the same order. `now`: seconds on the node's timeline, for ages."""
    tunnel, unwritten = writer.tunnel, store.unwritten
    out = []
    for message in messages:
        target, urgency = destination(message)
        promises = False
        if unwritten:
            data = KINDS[type(message)].rests(message)
            # Data that are on disk leave at once, so a node whose disk is full can still hand over its data.
            promises = data is None or not all(map(store.durable, data))
        for payload in encode(message, now) if trust is KEYLESS else trust.encoded(message, store, now):
            out.append(Outgoing(tunnel(payload, payload_type=payload_type), target, promises, urgency))
    return out


def frames_about_links(
    payloads: Sequence[bytes], writer: FrameWriter, payload_type: int, urgency: Urgency = Urgency.ANSWER
) -> list[Outgoing]:
    """TUNNEL payloads that are no messages of core, as frames of `writer` to everybody in range."""
    frames = (writer.tunnel(payload, payload_type=payload_type) for payload in payloads)
    return [Outgoing(frame, BROADCAST, False, urgency) for frame in frames]


def held_back(frames: Sequence[Outgoing]) -> list[Outgoing]:
    """The same frames, which must not leave before the store has committed."""
    return [outgoing._replace(promises=True) for outgoing in frames]


#: Messages that may wait. When there are more, they leave at once.
MAX_WAITING = 64


class Answers:
    """What one node has to say about the messages that it has heard. Time is an argument."""

    __slots__ = ("_answers", "_moves", "_rng", "broadcast", "due", "spread_s")

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._answers: list[Message] = []
        self._moves: list[Message] = []
        self.due = math.inf
        """When what waits leaves, seconds; infinity: nothing waits."""
        self.broadcast = True
        """Whether all neighbours hear every frame."""
        self.spread_s = 0.0
        """The longest wait, seconds. 0: where frames do not contend for the air."""

    def wait(self, to: Message, answers: Sequence[Message], moves: Sequence[Message], now: float) -> bool:
        """Take the answers to a message, and the data that move on because of it. Returns whether they wait; if not,
        everything leaves now."""
        self._answers += answers
        self._moves += moves
        waiting = len(self._answers) + len(self._moves)
        if not self.spread_s or is_of_transfer(to) or waiting > MAX_WAITING:
            return False
        if self.due == math.inf:
            self.due = now + self.spread_s * self._rng.random()
        return True

    def take(self, node: Participant) -> list[Message]:
        """What leaves: of what `node` has said."""
        answers, moves = self._answers, self._moves
        if self.due < math.inf:
            answers, moves = joined(answers), joined(moves)
        self.forget()
        if moves and self.broadcast:
            answers = node.needed(answers, moves)
        return answers + moves

    def forget(self) -> None:
        """Drop what waits."""
        self._answers = []
        self._moves = []
        self.due = math.inf
