"""How much may be on its way to one neighbour in chunks: an estimate of the link's rate and of its round-trip time.

As in BBR the window follows what the link delivers: a multiple of rate times round-trip time. A loss by itself shrinks
nothing, because radios lose frames without being full. As in RACK (RFC 8985) a chunk is missing when something that was
sent later has arrived; how much later it has to be is learned from chunks that counted as missing and came after all.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from rass_mav.core.exchange import SPREAD_S, RoundTrip
from rass_mav.core.messages import REPORT_BITS
from rass_mav.core.pace import LOSSY, Pace

#: The most chunks on their way to one neighbour.
MAX_WINDOW = 128
# Tuned: python -m tools.sensitivity custody.flow
#: The window of a neighbour of which nothing is known yet.
FIRST_WINDOW = MAX_WINDOW // 4
#: The window is this many times what fits on the link. It doubles with each round trip until the rate stops to grow.
GAIN = 1.5
#: The receiver reports after so many chunks, twice as many while none is missing. It also does so on request.
SACK_EVERY = 8
#: Bound: What gets lost may be sent so often that no more than `LOSSY` should get lost each time, and at most so often.
MOST_TIMES = 3
#: Bound: No more than what the link carries in this time is on its way, however long the round trip, seconds: what
#: small data may have to wait for where a radio does not send them first.
MOST_QUEUE_S = 2.0
#: The highest rate counts for this many round trips at least, and at most twice as many.
RATE_KEPT_TRIPS, RATE_KEPT_S = 10.0, 0.5
#: What the share of losses is taken for while nothing has been answered.
UNKNOWN_LOSS = 0.2
#: How fast the share of losses follows.
LOSS_GAIN = 1 / 64
#: The most that chunks are allowed to overtake each other. After as many reported chunks as a report is about the
#: margin is halved.
MAX_MARGIN, MARGIN_KEPT = 64, REPORT_BITS
#: A transmission younger than this part of the mean round trip cannot have been reported yet.
SOONEST = 0.5


def round_s(pace: Pace) -> float:
    """In what time a transfer should make progress, seconds: a turn, or as long as the chunks between two reports take
    where fewer fit into a turn."""
    return pace.turn_s * max(1.0, SACK_EVERY / pace.items)


def times(loss: float) -> int:
    """How often to send what gets lost with this chance, so that it arrives once."""
    times, left = 1, loss
    while left > LOSSY and times < MOST_TIMES:
        times += 1
        left *= loss
    return times


class Flight(NamedTuple):
    """One transmission of a chunk."""

    serial: int
    """Number among all transmissions to this neighbour."""
    at: float
    """When it was sent, seconds."""
    delivered: int
    """How many chunks the neighbour had reported by then."""
    before: int
    """The transmission of the same chunk that was declared lost; 0: this one is the first."""


class Flow:
    """The chunks to one neighbour, over all transfers to it. Time is an argument."""

    __slots__ = (
        "_before", "_best", "_margin", "_rotate_at", "_trip", "active", "copies", "delivered",
        "least_s", "loss", "newest", "quiet", "serial", "tries", "unpolled",
    )  # fmt: skip

    def __init__(self, now: float) -> None:
        self.serial = 0
        """Transmissions so far."""
        self.newest = 0
        """Serial of the newest transmission that is known to have arrived."""
        self.delivered = 0
        """Chunks that the neighbour has reported."""
        self.loss = 0.0
        """Share of the transmissions that get lost, 0..1."""
        self._margin = 1
        self.active = now
        """When something was sent or reported last, seconds."""
        self.quiet = now
        """Since when a report is waited for, seconds."""
        self.tries = 0
        """Questions and offers since the last report."""
        self.copies = 0.0
        """How many copies may be sent of chunks that are not known to be lost."""
        self.unpolled = 0
        """Chunks sent since a report was asked for."""
        self._trip = RoundTrip()
        self.least_s = inf
        """The shortest round trip, seconds; infinity: none was measured."""
        self._best = self._before = 0.0
        self._rotate_at = now

    # -- the window ----------------------------------------------------------------------------------------------------

    @property
    def rate(self) -> float:
        """Chunks that the link delivers in a second; 0: not known."""
        return max(self._best, self._before)

    @property
    def fits(self) -> float:
        """How many chunks are on the link while no queue has built, as it delivers them."""
        return self.rate * self.least_s if self.rate else 0.0

    def window(self) -> int:
        """How many chunks may be on their way."""
        if not self.rate:
            return FIRST_WINDOW
        # Reports come in groups, and get lost as chunks do.
        unreported = SACK_EVERY * (1 + times(self.loss)) / (1.0 - min(self.loss, 0.5))
        return min(MAX_WINDOW, int(self.rate * min(GAIN * self.least_s, MOST_QUEUE_S) + unreported))

    # -- what is sent, and what is reported ----------------------------------------------------------------------------

    def send(self, now: float, before: int = 0) -> Flight:
        """A chunk is sent now. `before`: see `Flight`."""
        self.serial += 1
        self.active = self.quiet = now
        return Flight(self.serial, now, self.delivered, before)

    def arrived(self) -> None:
        """A chunk is reported that was on its way."""
        self.delivered += 1
        if not self.delivered % MARGIN_KEPT:
            self._margin = max(1, self._margin // 2)
        self.loss -= LOSS_GAIN * self.loss

    def lost(self) -> None:
        """A transmission is missing."""
        self.loss += LOSS_GAIN * (1.0 - self.loss)

    def overtaken(self) -> None:
        """A transmission that counted as lost has arrived after all."""
        self._margin = min(MAX_MARGIN, 2 * self._margin)

    def lost_before(self) -> int:
        """Transmissions before this serial have arrived or are lost."""
        return self.newest + 1 - min(self._margin, self.window() // 2)

    def is_new(self, flight: Flight, now: float) -> bool:
        """Whether a report of a chunk can be about this transmission, and not only about one before it."""
        return not flight.before or now - flight.at >= SOONEST * self._trip.mean_s

    def measure(self, flight: Flight, now: float, *, asked: bool) -> None:
        """A report came; this is the newest transmission in it. `asked`: the report answers something else, so earlier
        ones may have been lost."""
        trip_s = now - flight.at
        if not (flight.before or asked):
            self.measure_answer(trip_s)
        if trip_s <= 0.0 or self.least_s == inf:
            return
        if now >= self._rotate_at:
            self._before, self._best = self._best, 0.0
            self._rotate_at = now + max(RATE_KEPT_S, RATE_KEPT_TRIPS * self._trip.mean_s)
        self._best = max(self._best, (self.delivered - flight.delivered) / trip_s)

    def measure_answer(self, trip_s: float) -> None:
        """Something was answered after this time, seconds."""
        if self.least_s == inf:
            self._trip = RoundTrip()
        self._trip.measure(trip_s)
        self.least_s = min(self.least_s, trip_s)

    # -- waiting -------------------------------------------------------------------------------------------------------

    def report(self, now: float) -> None:
        """Something new was heard of what is on its way."""
        self.active = self.quiet = now
        if self.tries >= 2:
            # After a break the link may be another.
            self.least_s = inf
            self._best = self._before = 0.0
        self.tries = 0

    def wait_s(self, round_s: float, tries: int, *, idle: bool = False) -> float:
        """How long to wait for an answer after so many that did not come, seconds; at most a round. `idle`: no chunks
        of this node are on the link, for which the answer would have to wait."""
        if self.least_s == inf:
            first_s = round_s / 16.0
        else:
            mean_s = self._trip.mean_s
            first_s = mean_s + max(SPREAD_S, min(self._trip.usual_s - mean_s, mean_s))
            if idle:
                first_s = min(first_s, 2.0 * self.least_s + SPREAD_S)
        doublings = max(0, min(tries + 1 - self.asks, 10))
        return min(max(round_s, first_s), first_s * (1 << doublings))

    @property
    def asks(self) -> int:
        """How often to ask, so that some answer comes."""
        loss = UNKNOWN_LOSS if self.least_s == inf else self.loss
        return times(1.0 - (1.0 - loss) ** 2)
