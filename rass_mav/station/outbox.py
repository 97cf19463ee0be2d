"""One connection to the ground, with a queue of messages that leave one at a time.

An autopilot that forwards frames has buffers for two messages (PX4) or 1024 bytes (ArduPilot), so nothing leaves in a
burst. Answers, unsolicited messages and a listing of all parameters take turns, so none of them can block the others.
Every queue is bounded. If an answer is dropped because its queue is full, the ground station asks again, as it does
when a question is lost.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

from rass_mav.agent.outgoing import Outgoing, Way, aside
from rass_mav.mavlink.frames import FrameWriter

#: Seconds between two frames. A telemetry radio at 57,600 bit/s carries 25 a second beside the vehicle's telemetry.
GAP_S = 0.04
#: Answers that may wait.
MAX_ANSWERS = 32
#: Texts and values that may wait.
MAX_SAID = 32

# Message id, payload, and whether it depends on changes that are not on disk yet.
_Waiting: TypeAlias = tuple[int, bytes, bool]


class Outbox:
    """Frames for one connection. Time is an argument."""

    __slots__ = (
        "_answers",
        "_free_at",
        "_list",
        "_listed",
        "_size",
        "_to_list",
        "_turn",
        "_unasked",
        "dropped",
        "rate",
        "way",
    )

    def __init__(self, way: Way, listing: Callable[[int], tuple[int, bytes]], size: int) -> None:
        """:param listing: returns the message id and payload of an entry of the list, 0..size - 1."""
        self.way = way
        """Where the frames go, and where the questions come from."""
        self._answers: deque[_Waiting] = deque()
        self._unasked: deque[_Waiting] = deque()
        self._list = listing
        self._size = size
        self._listed = 0
        self._to_list = 0
        self._free_at = -math.inf
        self._turn = 0
        self.rate = math.inf
        """Limit in bytes/s, in addition to `GAP_S`."""
        self.dropped = 0
        """Messages dropped because their queue was full."""

    def answer(self, message_id: int, payload: bytes, *, promises: bool = False) -> None:
        """Answer a question. An answer that already waits is not queued again: a forwarded question may come twice.

        `promises`: the answer depends on changes that are not on disk yet.
        """
        self._put(self._answers, MAX_ANSWERS, (message_id, payload, promises))

    def say(self, message_id: int, payload: bytes) -> None:
        """Send an unsolicited message."""
        self._put(self._unasked, MAX_SAID, (message_id, payload, False))

    def _put(self, queue: deque[_Waiting], most: int, message: _Waiting) -> None:
        if message in queue:
            return
        if len(queue) >= most:
            self.dropped += 1
        else:
            queue.append(message)

    def list_all(self) -> None:
        """Send every entry of the list. A call during a listing extends it until each has been sent once more."""
        self._to_list = self._size

    def due(self) -> float:
        """When the next frame may leave; infinity: none waits."""
        return self._free_at if self._answers or self._unasked or self._to_list else math.inf

    def take(self, now: float, writer: FrameWriter) -> Outgoing | None:
        """The frame of `writer` that leaves now, if any: at most one in `GAP_S` seconds, and at most `rate` bytes/s."""
        if now < self._free_at:
            return None
        for _ in range(3):
            self._turn = (self._turn + 1) % 3
            message = self._next(self._turn)
            if message is not None:
                message_id, payload, promises = message
                frame = writer.frame(message_id, payload)
                self._free_at = now + max(GAP_S, len(frame) / self.rate)
                return aside(frame, self.way, promises=promises)
        return None

    def _next(self, source: int) -> _Waiting | None:
        if source < 2:
            queue = self._unasked if source else self._answers
            return queue.popleft() if queue else None
        if not self._to_list:
            return None
        message = self._list(self._listed)
        self._listed = (self._listed + 1) % self._size
        self._to_list -= 1
        return *message, False
