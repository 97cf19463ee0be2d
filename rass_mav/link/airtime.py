"""Airtime: what a node may send on a link, when, and what goes first. Pure: time is an argument.

All nodes that hear each other share a slow radio. The swarm takes a configured share of it (`duty`), whatever the
number of nodes: each node counts its neighbours and takes its part. Beacons go first, then answers, then data, then
chunks of large data. Chunks may also take what the other nodes leave of their parts: a node counts what it sends and
what it hears. Through the autopilot, frames to the autopilot and to the ground station behind it count too. Frames
leave one by one, so that forwarders keep up (an autopilot with buffers for two messages, a radio's small buffer).
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Collection
from typing import NamedTuple

from rass_mav.core.messages import Urgency

from .budget import FRAME_BYTES, MAX_WAITING, Budget, Queued

#: Size of a beacon on the air with a signature, bytes.
BEACON_BYTES = 73
#: Shares of the swarm's airtime without beacons, for data and for frames to the vehicle. The rest is for answers: there
#: is one for each datum of every neighbour, but they are small.
DATA_PART = 0.7
VEHICLE_PART = 0.15
#: The longest time between two beacons, seconds. A slower neighbourhood would be useless.
MAX_TURN_S = 120.0
#: An answer or datum is dropped after waiting this many turns, because it is being sent again by then. A chunk is not:
#: its sender sends no more of them than are acknowledged, and so sends again what is late.
STALE_TURNS = 2.0
#: RADIO_STATUS.txbuf, percent of the radio's buffer that is free. Below the first value slow down a lot, below the
#: second a little, above the third speed up (as the firmware of SiK radios recommends).
TXBUF_LOW, TXBUF_MIDDLE, TXBUF_HIGH = 20, 50, 90
#: The smallest share of the rate that remains when the radio is full.
LEAST_THROTTLE = 0.05
#: A radio reports about once a second. After this many seconds of silence, each further second counts as a report of a
#: free buffer: the last report may be forged, or from before the air was free again.
RADIO_STATUS_S = 3.0
_UP, _DOWN_A_LITTLE, _DOWN_A_LOT = 1.25, 0.8, 0.5
_URGENCIES = tuple(Urgency)


class LinkPace(NamedTuple):
    """What a link can carry."""

    turn_s: float
    """Seconds between two beacons."""
    items: int
    """Data frames in that time, 1 or more."""


class _Bucket:
    """Tokens that arrive at a rate and are kept up to a limit."""

    __slots__ = ("_at", "_size", "level")

    def __init__(self, size: float, level: float, now: float) -> None:
        self._size = size
        self.level = level
        self._at = now

    def fill(self, rate: float, now: float) -> None:
        if now > self._at:
            self.level = min(self._size, self.level + (now - self._at) * rate)
            self._at = now

    def spend(self, amount: float) -> None:
        """Take away so many, though there may be fewer: then they are owed, up to the size."""
        self.level = max(-self._size, self.level - amount)

    def wait(self, amount: float, rate: float) -> float:
        """Seconds until there are `amount` tokens."""
        return max(0.0, min(amount, self._size) - self.level) / rate


class Pacer:
    """The queue of one link. Push frames when they are ready, and pop them at the time that `next_at` returns."""

    def __init__(
        self, budget: Budget, rng: random.Random, *, now: float, step_s: float, measures: bool = False
    ) -> None:
        """`step_s`: seconds between two beacons, if the link can carry them. `measures`: the radio is known to report
        how full it is, even if it has reported nothing but 0."""
        self.budget = budget
        self.neighbours = 0
        """How many nodes are heard on this link."""
        self.dropped = [0] * len(Urgency)
        """Frames dropped, by urgency: no space, too old, or (beacons) replaced by a newer one."""
        self.sent = [0] * len(Urgency)
        """Frames popped, by urgency."""
        self.throttle = 1.0
        """The share of the rate that the radio's buffer allows."""
        self._rng = rng
        self.step_s = step_s
        """Length of a step, in which a beacon may be created, seconds."""
        self._queues: tuple[deque[Queued], ...] = tuple(deque() for _ in Urgency)
        size = max(budget.burst_bytes, FRAME_BYTES)
        self._bytes = _Bucket(size, size, now)
        # The first two leave at once, the next ones at intervals: a bucket of n lets n + 1 through in a moment.
        self._frames = _Bucket(max(1, budget.burst_frames), max(1, budget.burst_frames), now)
        # Empty at first, so that a swarm that is switched on does not fill the air.
        self._data = _Bucket(2 * FRAME_BYTES, 0.0, now)
        # What the whole swarm may still send. Others fill the air too, so there may be less than nothing.
        self._left = _Bucket(size, 0.0, now)
        # All count the same, so they would all begin at the same moment: each replicas a random part of a frame.
        self._spared = 0.0
        self._beacon_at = now
        self._clear_at = now
        self._status_at = now
        self._measured = measures  # or the radio has reported anything but 0
        self._settled_at = -math.inf
        # The packet that the frames of this moment share.
        self._packet_at, self._packet_bytes = -math.inf, 0

    # -- what the link can carry ---------------------------------------------------------------------------------------

    @property
    def rate(self) -> float:
        """Bytes per second for the whole swarm."""
        return self.budget.bytes_s * self.budget.duty * self.throttle

    @property
    def data_rate(self) -> float:
        """This node's share for data, bytes/s."""
        return self.rate * (1.0 - self.budget.beacons) * DATA_PART / (self.neighbours + 1)

    @property
    def vehicle_rate(self) -> float:
        """This node's share for frames to the autopilot and the ground, bytes/s."""
        return self.rate * (1.0 - self.budget.beacons) * VEHICLE_PART / (self.neighbours + 1)

    def pace(self) -> LinkPace:
        """What the link can carry with the present neighbours."""
        wanted = (self.neighbours + 1) * BEACON_BYTES / (self.rate * self.budget.beacons)
        # Whole steps, because beacons are created in steps.
        turn_s = self.step_s * max(1, math.ceil(min(wanted, MAX_TURN_S) / self.step_s - 1e-9))
        return LinkPace(turn_s, max(1, int(self.data_rate * turn_s / FRAME_BYTES)))

    # -- the queue -----------------------------------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """Frames that wait."""
        return sum(map(len, self._queues))

    @property
    def pressing(self) -> int:
        """Frames that wait, without chunks: those give way."""
        return self.waiting - len(self._queues[Urgency.BULK])

    def push(self, frame: bytes, target: int, urgency: Urgency, now: float, *, first: bool = False) -> None:
        """Queue a frame. `target`: node id, or BROADCAST. `first`: before all others of the same urgency."""
        queue = self._queues[urgency]
        if len(queue) >= MAX_WAITING[urgency]:
            self.dropped[urgency] += 1
            if urgency == Urgency.BULK:
                # The receiver waits for the oldest. A gap at the end is a loss as on the air, which slows the
                # sender.
                return
            # The oldest is the least useful: a frame that is not answered in time is sent again.
            queue.popleft()
        (queue.appendleft if first else queue.append)(Queued(frame, target, now))

    def meet(self, neighbours: Collection[int]) -> None:
        """These nodes are heard on this link now. Chunks for others are dropped."""
        self.neighbours = len(neighbours)
        chunks = self._queues[Urgency.BULK]
        if any(queued.target not in neighbours for queued in chunks):
            remaining = [queued for queued in chunks if queued.target in neighbours]
            self.dropped[Urgency.BULK] += len(chunks) - len(remaining)
            chunks.clear()
            chunks.extend(remaining)

    def pop(self, now: float) -> Queued | None:
        """The frame that leaves now, or None. Ask again until None."""
        self._settle(now)
        urgency, wait = self._next(now)
        if wait > 1e-9:
            return None
        queued = self._queues[urgency].popleft()
        size = len(queued.frame)
        if self.budget.listen_s:
            self.heard(now + size / self.budget.bytes_s)
        # Chunks leave the node's part to its data, as long as there is something else to take.
        own_part = urgency == Urgency.DATA or (
            urgency == Urgency.BULK and self._left.wait(size + self._spared, self.rate) > 1e-9
        )
        if own_part and self._data.wait(size, self.data_rate) <= 1e-9:
            self._data.level -= size
        if now != self._packet_at or self._packet_bytes + size > self.budget.packet_bytes:
            self._packet_at, self._packet_bytes = now, 0
        self._packet_bytes += size
        self._bytes.level -= size
        self._frames.level -= 1
        self._left.spend(size)
        if urgency == Urgency.BEACON:
            # Slightly less than a turn: a node whose turn comes a moment early must not miss one.
            self._beacon_at = now + 0.9 * self.pace().turn_s
        self.sent[urgency] += 1
        return queued

    def next_at(self, now: float) -> float | None:
        """When to `pop` next; None: nothing waits."""
        self._settle(now)
        _, wait = self._next(now)
        return None if wait == math.inf else now + wait

    def _settle(self, now: float) -> None:
        if now == self._settled_at:
            return
        self._settled_at = now
        while self.throttle < 1.0 and now - self._status_at > RADIO_STATUS_S:
            self._status_at += 1.0
            self.throttle = min(1.0, self.throttle * _UP)
        self._bytes.fill(self.rate, now)
        self._frames.fill(self.budget.frames_s, now)
        self._data.fill(self.data_rate, now)
        self._left.fill(self.rate, now)
        for urgency in (Urgency.ANSWER, Urgency.DATA):
            queue = self._queues[urgency]
            # A turn has at least a step.
            if not queue or queue[0].since >= now - STALE_TURNS * self.step_s:
                continue
            oldest = now - STALE_TURNS * self.pace().turn_s
            while queue and queue[0].since < oldest:
                queue.popleft()
                self.dropped[urgency] += 1

    def _next(self, now: float) -> tuple[Urgency, float]:
        """The most urgent, unless a less urgent one may leave before it; and how long it has to wait, seconds. It is
        infinite if nothing waits."""
        best, least = Urgency.DATA, math.inf
        for urgency in _URGENCIES:
            if self._queues[urgency]:
                if urgency == Urgency.BULK and self._gives_way(now):
                    break
                wait = self._wait(urgency, now)
                if wait < least - 1e-9:
                    best, least = urgency, wait
        return best, least

    def _wait(self, urgency: Urgency, now: float) -> float:
        size = len(self._queues[urgency][0].frame)
        joins = now == self._packet_at and self._packet_bytes + size <= self.budget.packet_bytes
        wait = max(
            self._bytes.wait(size, self.rate),
            self._frames.wait(1.0, self.budget.frames_s),
            0.0 if joins else self._clear_at - now,
        )
        if urgency == Urgency.DATA:
            part = self._data.wait(size, self.data_rate)
            if self._queues[Urgency.BULK]:
                # In the place of the chunk that gives way to it.
                part = min(part, self._left.wait(size + self._spared, self.rate))
            wait = max(wait, part)
        elif urgency == Urgency.BULK:
            wait = max(
                wait, min(self._data.wait(size, self.data_rate), self._left.wait(size + self._spared, self.rate))
            )
        elif urgency == Urgency.BEACON:
            wait = max(wait, self._beacon_at - now)
        return wait

    def _gives_way(self, now: float) -> bool:
        """Whether chunks must not leave now. A chunk that is shorter than what waits would keep it waiting."""
        vehicle, beacons, answers, data, _ = self._queues
        return bool(vehicle or answers or data or (beacons and self._beacon_at <= now))

    # -- what the link reports -----------------------------------------------------------------------------------------

    def heard(self, now: float, size: int = 0) -> None:
        """A frame has ended, or will end at `now`. All waiting nodes heard it too, so each waits for a random time.

        `size`: its bytes, if another node of the swarm sent it. Chunks leave it that much of what the swarm may send.
        """
        if self.budget.listen_s:
            patience = self._rng.random()
            self._clear_at = now + patience * self.budget.listen_s
            self._left.spend(size)
            self._spared = patience * FRAME_BYTES

    def radio_status(self, txbuf: int, now: float) -> None:
        """The radio reports how much of its buffer is free, percent (RADIO_STATUS.txbuf).

        As long as it has reported nothing but 0, it is ignored: some radios do not measure, and always report 0.
        """
        self._measured = self._measured or txbuf > 0
        if not self._measured:
            return
        self._settle(now)
        self._status_at = now
        if txbuf < TXBUF_LOW:
            self.throttle *= _DOWN_A_LOT
        elif txbuf < TXBUF_MIDDLE:
            self.throttle *= _DOWN_A_LITTLE
        elif txbuf > TXBUF_HIGH:
            self.throttle *= _UP
        self.throttle = min(1.0, max(LEAST_THROTTLE, self.throttle))
