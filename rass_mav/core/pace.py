"""How often a node has its turn, and how much it may send in one."""

from __future__ import annotations

# Tuned: python -m tools.sensitivity pace
#: One in this many is reserved for what would wait for ever otherwise. Of the bandwidth, where data move on at once,
#: for replicas of new data, which no other node has yet, and as much for data that are sent again. Of the turns, which
#: count as not full whatever is known, for what waits for airtime.
RESERVED = 10
#: Where more than this share of the frames gets lost, that is worth airtime or patience.
LOSSY = 0.02
#: The share of what is lost, or sent again, follows each frame by this much.
SHARE_GAIN = 0.02
#: The air is full while more than this share of what is sent has been sent before, in vain.
FULL = 0.2


class Pace:
    """The bandwidth of the paper: a number of data a step, retransmissions included."""

    __slots__ = ("_in_vain", "_keeps", "_turns", "items", "left", "queue", "reserved", "sent", "turn_s")

    def __init__(self, turn_s: float, items: int, *, keeps: bool, phase: int = 0) -> None:
        """`keeps`: reserve a part for replicas of new data. `phase`: so that not all nodes spare airtime at once."""
        self.turn_s = turn_s
        """Seconds between two turns, and so between two beacons: the step length, or more."""
        self.items = items
        """Data that may be sent in a turn."""
        self._keeps = keeps
        self.left = 0
        """Data that may still be sent in this turn."""
        self.reserved = 0
        """How many of them are reserved for replicas."""
        self.sent = 0
        """Data, copies and chunks sent in this life, retransmissions included."""
        self.queue = 0
        """Frames that wait in the driver, or bytes that wait behind it."""
        self._in_vain = 0.0
        self._turns = phase

    def begin_turn(self) -> None:
        """The bandwidth of a new turn."""
        self._turns += 1
        self.left = self.items
        self.reserved = self.items // RESERVED if self._keeps else 0

    def spend(self, *, again: bool = False) -> None:
        """A datum is being sent. `again`: not for the first time."""
        self.left -= 1
        self.sent += 1
        self._in_vain += SHARE_GAIN * (again - self._in_vain)

    @property
    def spares(self) -> bool:
        """Whether this is the one turn of many for what otherwise waits."""
        return self._turns % RESERVED == 0

    @property
    def full(self) -> bool:
        """Whether there is no airtime to spare in this turn: a queue waits, or much gets lost."""
        return (self.queue > 0 or self._in_vain > FULL) and not self.spares
