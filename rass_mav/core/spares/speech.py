"""Messages between custodians and backers, collected until they are sent."""

from __future__ import annotations

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BROADCAST, Message, PassedOn, Word, WordEntry, Words

#: What was passed on is told together, at most this many steps later: before a backer asks (`ASK_STEPS`).
TELL_STEPS = 4
#: So many fill a frame.
_MOST_PASSED_ON = 11


class Speech:
    """Bounded by what comes in at a time: words are flushed with the answers to each message, and with each step."""

    __slots__ = ("_id", "_passed_on", "_steps", "_words")

    def __init__(self, node_id: int) -> None:
        self._id = node_id
        self._passed_on: dict[tuple[DatumId, int], None] = {}
        """Which datum, and to which neighbour."""
        self._steps = 0
        """Until they are told."""
        self._words: dict[int, dict[DatumId, Word]] = {}

    def say(self, target: int, id: DatumId, word: Word) -> None:
        """Send it with the next `flush`; to BROADCAST: to all neighbours."""
        self._words.setdefault(target, {})[id] = word

    def passed_on(self, target: int, id: DatumId) -> None:
        """Tell a neighbour that a datum has been passed on, or has arrived. It may wait."""
        if not self._passed_on:
            self._steps = TELL_STEPS
        self._passed_on[id, target] = None

    def counts_on(self, target: int, id: DatumId) -> None:
        """This node counts on the neighbour's copy again: what it was going to tell it is no longer true."""
        self._passed_on.pop((id, target), None)

    def step(self) -> None:
        """Once a step."""
        self._steps -= 1

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""
        if self._passed_on and (self._steps <= 0 or len(self._passed_on) >= _MOST_PASSED_ON):
            # One frame for all neighbours: those to which a datum means nothing ignore it.
            targets = {target for _, target in self._passed_on}
            ids = dict.fromkeys(id for id, _ in self._passed_on)
            out.append(PassedOn(self._id, targets.pop() if len(targets) == 1 else BROADCAST, tuple(ids)))
            self._passed_on = {}
        if self._words:
            for target, words in self._words.items():
                out.append(Words(self._id, target, tuple([WordEntry(*entry) for entry in words.items()])))
            self._words = {}
