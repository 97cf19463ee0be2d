"""Messages between custodians and holders, collected until they are sent."""

from __future__ import annotations

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import CopyStatus, CopyStatusEntry, CopyStatuses, Message


class ReplicaMessages:
    """Bounded by what comes in at a time: they are flushed with the answers to each message, and with each step."""

    __slots__ = ("_id", "_words")

    def __init__(self, node_id: int) -> None:
        self._id = node_id
        self._words: dict[int, dict[DatumId, CopyStatus]] = {}

    def say(self, target: int, id: DatumId, word: CopyStatus) -> None:
        """Send it with the next `flush`; to BROADCAST: to all neighbours."""
        self._words.setdefault(target, {})[id] = word

    def counts_on(self, target: int, id: DatumId) -> None:
        """This node counts on the neighbour's copy again: that it has passed the datum on is no longer true."""
        words = self._words.get(target, {})
        if words.get(id) == CopyStatus.PASSED_ON:
            del words[id]

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""
        if self._words:
            for target, words in self._words.items():
                if words:
                    entries = tuple([CopyStatusEntry(*entry) for entry in words.items()])
                    out.append(CopyStatuses(self._id, target, entries))
            self._words = {}
