"""One way to the ground: what is to be said, paced.

An autopilot that passes frames on has room for two messages (PX4) or 1024 bytes (ArduPilot), so nothing leaves in a
burst. Answers, what is said unasked, and a listing of all parameters take turns: none of them can silence the others.
Everything is bounded; a question that finds no room is asked again, as questions are that get lost.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

from rass_mav.agent.outgoing import Outgoing, Way, aside
from rass_mav.mavlink.frames import FrameWriter

#: Seconds between two frames: 25 a second, which a telemetry radio at 57,600 bit/s takes beside the flight's telemetry.
GAP_S = 0.04
#: Answers that may wait.
MAX_ANSWERS = 32
#: Texts and values that may wait.
MAX_SAID = 32

# Message id, payload, and whether it rests on what is not on disk yet.
_Waiting: TypeAlias = tuple[int, bytes, bool]


class Outbox:
    """Frames for one way. Time comes in as an argument."""

    __slots__ = (
        "_answers",
        "_free_at",
        "_list",
        "_listed",
        "_said",
        "_size",
        "_to_list",
        "_turn",
        "dropped",
        "rate",
        "way",
        "writer",
    )

    def __init__(self, way: Way, writer: FrameWriter, listing: Callable[[int], tuple[int, bytes]], size: int) -> None:
        """:param listing: message id and payload of an entry of the list, 0..size - 1."""
        self.way = way
        """Where its frames go, and the questions come from."""
        self.writer = writer
        self._answers: deque[_Waiting] = deque()
        self._said: deque[_Waiting] = deque()
        self._list = listing
        self._size = size
        self._listed = 0
        self._to_list = 0
        self._free_at = -math.inf
        self._turn = 0
        self.rate = math.inf
        """What may leave, bytes/s, beside `GAP_S`."""
        self.dropped = 0
        """Messages for which there was no room."""

    def answer(self, message_id: int, payload: bytes, *, promises: bool = False) -> None:
        """Answer a question. What waits already is not said twice: a forwarded question may come more than once.

        `promises`: the answer rests on what is not on disk yet.
        """
        self._put(self._answers, MAX_ANSWERS, (message_id, payload, promises))

    def say(self, message_id: int, payload: bytes) -> None:
        """Say something unasked."""
        self._put(self._said, MAX_SAID, (message_id, payload, False))

    def _put(self, queue: deque[_Waiting], most: int, message: _Waiting) -> None:
        if message in queue:
            return
        if len(queue) >= most:
            self.dropped += 1
        else:
            queue.append(message)

    def list_all(self) -> None:
        """Say every entry of the list. While that goes on, it goes on until each has been said once more."""
        self._to_list = self._size

    def due(self) -> float:
        """When the next frame may leave; infinity: there is none."""
        return self._free_at if self._answers or self._said or self._to_list else math.inf

    def take(self, now: float) -> Outgoing | None:
        """The frame that leaves now, if any; at most one in `GAP_S` seconds, and no more than `rate`."""
        if now < self._free_at:
            return None
        for _ in range(3):
            self._turn = (self._turn + 1) % 3
            message = self._next(self._turn)
            if message is not None:
                message_id, payload, promises = message
                frame = self.writer.frame(message_id, payload)
                self._free_at = now + max(GAP_S, len(frame) / self.rate)
                return aside(frame, self.way, promises=promises)
        return None

    def _next(self, source: int) -> _Waiting | None:
        if source < 2:
            queue = self._said if source else self._answers
            return queue.popleft() if queue else None
        if not self._to_list:
            return None
        message = self._list(self._listed)
        self._listed = (self._listed + 1) % self._size
        self._to_list -= 1
        return *message, False
