"""When answers leave, and on which frames.

Where frames contend for the air, a node that has heard a frame does not answer it at once: its neighbours would do the
same, and so would the sender with its next datum. Answers, and the data that move on, wait for a random time first
(RFC 5148 recommends that for forwarded messages). What comes together in that time shares frames.
"""

from __future__ import annotations

import math
import random

from rass_mav.core.messages import Message, is_of_transfer, joined, let_ride

#: The longest wait on a link whose frames leave at once, seconds: dozens of frames of 802.11 at 6 Mbit/s.
SPREAD_S = 0.02
#: Messages that may wait. When there are more, they leave at once.
MAX_WAITING = 64


class Answers:
    """What one node has to say about the messages that it has heard. Time is an argument."""

    __slots__ = ("_answers", "_moves", "_rng", "due", "ride", "spread_s")

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._answers: list[Message] = []
        self._moves: list[Message] = []
        self.due = math.inf
        """When what waits leaves, seconds; infinity: nothing waits."""
        self.ride = True
        """Whether answers may share a frame with data for another node: where a frame reaches all neighbours."""
        self.spread_s = 0.0
        """The longest wait, seconds. 0: where frames do not contend for the air."""

    def wait(self, to: Message, answers: list[Message], moves: list[Message], now: float) -> bool:
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

    def take(self, *, overhear: bool) -> list[Message]:
        """What leaves. `overhear`: whether the nodes of this swarm read what is for others. Otherwise they would not
        find answers there."""
        answers, moves = self._answers, self._moves
        if self.due < math.inf:
            answers, moves = joined(answers), joined(moves)
        self.forget()
        return let_ride(answers, moves) if self.ride and overhear else answers + moves

    def forget(self) -> None:
        """Drop what waits."""
        self._answers = []
        self._moves = []
        self.due = math.inf
