"""Messages between custodians and backers, collected until they are sent."""

from __future__ import annotations

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Message, PassedOn, Word, WordEntry, Words


class Speech:
    """Bounded by what comes in at a time: it is flushed with the answers to each message, and with each step."""

    __slots__ = ("_id", "_passed_on", "_words")

    def __init__(self, node_id: int) -> None:
        self._id = node_id
        self._passed_on: dict[int, dict[DatumId, None]] = {}
        self._words: dict[int, dict[DatumId, Word]] = {}

    def say(self, target: int, id: DatumId, word: Word) -> None:
        """Send it with the next `flush`; to BROADCAST: to all neighbours."""
        self._words.setdefault(target, {})[id] = word

    def passed_on(self, target: int, id: DatumId) -> None:
        """Tell a neighbour that a datum has been passed on, or has arrived."""
        self._passed_on.setdefault(target, {})[id] = None

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""
        if self._passed_on:
            out += [PassedOn(self._id, target, tuple(ids)) for target, ids in self._passed_on.items()]
            self._passed_on = {}
        if self._words:
            for target, words in self._words.items():
                out.append(Words(self._id, target, tuple([WordEntry(*entry) for entry in words.items()])))
            self._words = {}
