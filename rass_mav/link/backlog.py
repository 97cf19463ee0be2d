"""What leaves a link without a budget: everything at once, but chunks only while the interface has little to send, so
that all else overtakes them. Pure: time is an argument.

The interface is not told what is urgent, and a Wi-Fi radio may hold hundreds of frames. So few chunks are handed to it
that it does not run dry before the next look, as Linux bounds the queues of its drivers (Dynamic Queue Limits).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

from rass_mav.core.messages import Urgency
from rass_mav.link.budget import MAX_WAITING, Queued

#: What a system counts for a small frame that waits in it, bytes: Linux 768 to 1280, whatever the frame's length.
WAITING_FRAME_BYTES = 1024
#: The interface is looked at so often, seconds.
LOOK_S = 0.002
#: Chunks are handed over while less than this waits in the interface, bytes: at first, and at most.
LEAST_BYTES, MOST_BYTES = 2 * WAITING_FRAME_BYTES, 128 * WAITING_FRAME_BYTES
#: What has not changed for so long, seconds, does not wait for its turn: the system may be asking for the hardware
#: address of a neighbour that has gone.
STUCK_S = 0.25


class Backlog:
    """The queue of one link. Push frames when they are ready, and pop them at the time that `next_at` returns."""

    def __init__(self, interface: Callable[[], int], now: float) -> None:
        """`interface`: how much waits in it, bytes as the system counts them."""
        self.dropped = 0
        """Chunks dropped: no space, or for a node that is no longer heard."""
        self._interface = interface
        self._urgent: deque[Queued] = deque()
        self._chunks: deque[Queued] = deque()
        self._most = LEAST_BYTES
        self._look_at = now
        self._waiting, self._since = 0, now
        """What waited in the interface at the last look, and since when it has been as much."""
        self._stuck = 0
        """How much of it has not moved for long."""

    def push(self, frame: bytes, target: int, urgency: Urgency, now: float, *, first: bool = False) -> None:
        """Queue a frame. `target`: node id, or BROADCAST. `first`: before all others, if it is not a chunk."""
        queued = Queued(frame, target, now)
        if urgency != Urgency.BULK:
            (self._urgent.appendleft if first else self._urgent.append)(queued)
        elif len(self._chunks) >= MAX_WAITING[Urgency.BULK]:
            self.dropped += 1
        else:
            if not self._chunks:
                # That the interface is empty now says nothing of how fast it sends.
                self._look_at = max(self._look_at, now + LOOK_S)
            self._chunks.append(queued)

    def meet(self, neighbours: Collection[int]) -> None:
        """These nodes are heard on this link now. Chunks for others are dropped."""
        before = len(self._chunks)
        self._chunks = deque(queued for queued in self._chunks if queued.target in neighbours)
        self.dropped += before - len(self._chunks)

    def pop(self, now: float) -> Queued | None:
        """The frame that leaves now, or None. Ask again until None."""
        if self._urgent:
            return self._urgent.popleft()
        if not self._chunks:
            return None
        waiting = self._moving(now)
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            if not waiting:
                self._most = min(2 * self._most, MOST_BYTES)
            elif 2 * waiting > self._most:
                self._most = max(self._most - WAITING_FRAME_BYTES, LEAST_BYTES)
        return self._chunks.popleft() if waiting < self._most else None

    def _moving(self, now: float) -> int:
        """How much waits in the interface for its turn, bytes."""
        waiting = self._interface()
        if waiting != self._waiting:
            self._waiting, self._since = waiting, now
        elif now - self._since >= STUCK_S:
            self._stuck = waiting
        self._stuck = min(self._stuck, waiting)
        return waiting - self._stuck

    def next_at(self, now: float) -> float | None:
        """When to `pop` next; None: nothing waits."""
        if self._urgent:
            return now
        return max(now, self._look_at) if self._chunks else None
