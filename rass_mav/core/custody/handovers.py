"""Hand-overs: who has been offered what, and what has been answered.

The giver keeps a datum until the receiver has it on disk and says COMMITTED with the number of that very hand-over.
A number is drawn for one hand-over and never used again. Accepting a datum that one is handing over at this moment
cancels that hand-over, and a late answer to its number is ignored; therefore two nodes can never both delete a datum on
the word of each other.

The receiver remembers the numbers it has accepted (bounded). A retransmission of a number that it has accepted is
answered COMMITTED even when the datum has been passed on since: the giver acts on it only while that number is still
pending, that is while it has not taken the datum back. Without this memory each lost answer on a lossy link makes a
second copy at each hop. It is a memory of hand-overs, not of data: the same datum offered under another number is
accepted like any other. Entries of a datum whose copy is found corrupt are forgotten, so that it can be sent again.
"""

from __future__ import annotations

import random
from collections import OrderedDict

from rass_mav.core.datum import DatumId

#: How many accepted hand-over numbers a node remembers.
MAX_ACCEPTED = 1024


class Pending:
    """A hand-over that has not been answered."""

    __slots__ = ("id", "neighbour", "number", "sent", "tries")

    def __init__(self, number: int, id: DatumId, neighbour: int, sent: float) -> None:
        self.number = number
        self.id = id
        self.neighbour = neighbour
        self.sent = sent
        """When it was last sent, seconds."""
        self.tries = 1


class Custody:
    """The hand-overs of one node, outgoing and accepted. Outgoing ones are bounded by what the node holds."""

    __slots__ = ("_accepted", "_next", "_numbers", "pending")

    def __init__(self, rng: random.Random) -> None:
        self.pending: dict[DatumId, Pending] = {}
        self._numbers: dict[int, DatumId] = {}
        # A random start, so that an answer to a hand-over of an earlier life does not name one of this life.
        self._next = rng.getrandbits(32)
        self._accepted: OrderedDict[tuple[int, int], DatumId] = OrderedDict()

    def draw(self) -> int:
        """A number that this node has not used in this life (32 bits, not 0)."""
        self._next = (self._next + 1) & 0xFFFFFFFF or 1
        return self._next

    def give(self, id: DatumId, neighbour: int, now: float) -> Pending:
        """Begin a hand-over; one that was pending for this datum is cancelled."""
        self.cancel(id)
        pending = Pending(self.draw(), id, neighbour, now)
        self.pending[id] = pending
        self._numbers[pending.number] = id
        return pending

    def cancel(self, id: DatumId) -> None:
        """Forget the pending hand-over of a datum, if any: answers to it will be ignored."""
        pending = self.pending.pop(id, None)
        if pending is not None:
            del self._numbers[pending.number]

    def answered(self, number: int, neighbour: int) -> DatumId | None:
        """The datum of a pending hand-over to this neighbour, or None if the number is not pending with it."""
        id = self._numbers.get(number)
        if id is None or self.pending[id].neighbour != neighbour:
            return None
        return id

    def accept(self, giver: int, number: int, id: DatumId) -> None:
        """Remember that this hand-over was accepted."""
        accepted = self._accepted
        accepted[giver, number] = id
        if len(accepted) > MAX_ACCEPTED:
            accepted.popitem(last=False)

    def has_accepted(self, giver: int, number: int, id: DatumId) -> bool:
        """Whether this very hand-over was accepted before."""
        return self._accepted.get((giver, number)) == id

    def forget(self, id: DatumId) -> None:
        """A copy was found corrupt or has expired: it is not true any more that it was taken."""
        for key in [key for key, value in self._accepted.items() if value == id]:
            del self._accepted[key]
