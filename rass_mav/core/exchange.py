"""Exchange: the open questions of one node, in one table.

A question is what a neighbour is to answer: whether it takes custody of a datum, whether it keeps a replica, whether it
has taken a deletion report, whether it has a good copy of a datum that was lost here. The answer names the question's
key: the number that it was sent under, or the id of the datum that is searched for. The rules:

1. A number is drawn for one question, and not again while that one can still be answered. The first is random, so an
   answer to a question of an earlier life means nothing in this one. The low half of the number of a hand-over marks
   the number under which this node took the datum. Who gave it that datum, and hears it, knows that it was taken.
2. Only the node that was asked can answer, and only while the question is open. A node that takes a datum back closes
   its hand-over, so two nodes can never both delete a datum because of each other's answer.
3. How long a node waits follows what answers from this neighbour usually take (RFC 6298): the mean and four deviations.
   Only what was sent once is measured (Karn). Each time that it is sent again it waits twice as long, and at random.

The table is bounded by what it is about: a datum that is held has one hand-over at most, and one offer of a replica for
each neighbour; deletion reports and searches have bounds of their own.
"""

from __future__ import annotations

from collections.abc import Set
from math import inf
from typing import TypeVar

from rass_mav.core.datum import DatumId

#: Fact: How fast the mean and the deviation of a round trip follow new ones (RFC 6298).
TRIP_GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4
#: Fact: Deviations above the mean after which an answer is late (RFC 6298).
DEVIATIONS = 4.0
# Tuned: python -m tools.sensitivity exchange
#: The longest that answers wait for each other on a link whose frames leave at once, seconds: dozens of frames of
#: 802.11 at 6 Mbit/s. So no answer is late less than this after the mean of the round trip.
SPREAD_S = 0.02
#: What is not answered waits twice as long each time, up to this many times.
MOST_DOUBLINGS = 3
#: After so many tries in vain another neighbour is chosen, or a datum that is searched for is given up.
MAX_TRIES = 8


class Question:
    """Something that a neighbour has been asked; each kind of question is a class."""

    __slots__ = ("due", "id", "key", "sent", "to", "tries")

    def __init__(self, key: int | DatumId, id: DatumId, to: int, now: float) -> None:
        self.key = key
        """The number that the answer names, or the id."""
        self.id = id
        """The datum that it is about."""
        self.to = to
        """The node that may answer; BROADCAST: all neighbours."""
        self.sent = now
        """When it was last sent, seconds."""
        self.due = now
        """When something else is done if there is no answer, seconds."""
        self.tries = 1
        """How often it was sent."""

    @property
    def number(self) -> int:
        """The key of a question that was sent under a number."""
        assert isinstance(self.key, int)
        return self.key


def mark(number: int) -> int:
    """16 bits that depend on all bits of a number (Knuth's multiplicative hashing)."""
    return number * 2654435761 >> 16 & 0xFFFF


Q = TypeVar("Q", bound=Question)


class RoundTrip:
    """How long one neighbour takes to answer."""

    __slots__ = ("_deviation_s", "_least_s", "_missed", "known", "mean_s")

    def __init__(self) -> None:
        self.mean_s = 0.0
        """Seconds; 0: it is not known."""
        self.known = False
        self._deviation_s = 0.0
        self._least_s = 0.0
        """How long to wait at least, because answers did not come in time, seconds."""
        self._missed: float | None = None
        """When the first answer was missed since the last measurement, seconds."""

    def measure(self, trip_s: float) -> None:
        """An answer to what was sent once came after this time, seconds."""
        self._least_s, self._missed = 0.0, None
        if not self.known:
            self.known = True
            self.mean_s, self._deviation_s = trip_s, trip_s / 2
            return
        self._deviation_s += DEVIATION_GAIN * (abs(trip_s - self.mean_s) - self._deviation_s)
        self.mean_s += TRIP_GAIN * (trip_s - self.mean_s)

    def missed(self, now: float, waited_s: float, most_s: float) -> None:
        """No answer came in this time, so the same is sent again. Once it may be lost, where the time is known;
        otherwise it may be late. Then what is sent next waits twice as long, up to `most_s`, until a measurement shows
        how long answers take (Karn, too)."""
        if self._missed is None:
            self._missed = now
        if self._missed < now or not self.known:
            self._least_s = max(self._least_s, min(2 * waited_s, most_s))

    @property
    def usual_s(self) -> float:
        """Within what time this neighbour answers, seconds; 0: it is not known."""
        return self.mean_s + DEVIATIONS * self._deviation_s

    @property
    def wait_s(self) -> float:
        """How long to wait for an answer to what is sent for the first time, seconds; 0: it is not known."""
        return max(self.usual_s, self._least_s)


class Exchange:
    """The questions of one node, and how long its neighbours take to answer."""

    __slots__ = ("_last", "_trips", "due", "open")

    def __init__(self, last: int) -> None:
        """`last`: 32 random bits, the number before the first."""
        self._last = last
        self.open: dict[int | DatumId, Question] = {}
        """By key, the one asked the longest ago first."""
        self._trips: dict[int, RoundTrip] = {}
        self.due = inf
        """When the node is to look after what is not answered (`Node.tend`), seconds; infinity: in its next turn."""

    def wake(self, at: float) -> None:
        """Something that is not answered is due at this time, seconds."""
        self.due = min(self.due, at)

    def draw(self, taken_as: int = 0) -> int:
        """A number that none of the last 65,535 questions has (32 bits, not 0). `taken_as`: the number under which this
        node took the datum that it hands over now; 0: it is no such datum, and the number is new in this life."""
        last = self._last = (self._last + 1) & 0xFFFFFFFF
        return (last & 0xFFFF) << 16 | (mark(taken_as) if taken_as else last >> 16) or self.draw(taken_as)

    def ask(self, question: Q) -> Q:
        """A question is open now, the last of all, whether it was before or not."""
        self.open.pop(question.key, None)
        self.open[question.key] = question
        return question

    def close(self, question: Question) -> None:
        """Answers to a question are ignored from now on."""
        if self.open.get(question.key) is question:
            del self.open[question.key]

    def answered(self, key: int | DatumId, by: int) -> Question | None:
        """The question of this key that this node was asked; None: none is open."""
        question = self.open.get(key)
        return question if question is not None and question.to == by else None

    def of(self, kind: type[Q]) -> list[Q]:
        """The open questions of a kind, the one asked the longest ago first."""
        return [question for question in self.open.values() if isinstance(question, kind)]

    # -- round trips ---------------------------------------------------------------------------------------------------

    def trip(self, neighbour: int) -> RoundTrip:
        """How long a neighbour takes to answer."""
        trip = self._trips.get(neighbour)
        if trip is None:
            trip = self._trips[neighbour] = RoundTrip()
        return trip

    def keep(self, neighbours: Set[int]) -> None:
        """Forget how long all others took."""
        if len(self._trips) > 4 * len(neighbours):
            for id in self._trips.keys() - neighbours:
                del self._trips[id]
