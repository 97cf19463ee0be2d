"""Messages between custodians and holders, collected until they are sent."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BROADCAST, CopyStatus, CopyStatusEntry, CopyStatuses, Message, PassedOn

#: Fact: So many fill a frame: they do not wait for the next step.
_MOST_PASSED_ON = 11


class ReplicaMessages:
    """Bounded by what comes in at a time: they are flushed with the answers to each message, and with each step."""

    __slots__ = ("_counts", "_id", "_passed_on", "_tells", "_words")

    def __init__(self, node_id: int, counts: Callable[[DatumId], bool]) -> None:
        """`counts`: whether this node counts on a neighbour's copy of a datum, or has just offered one."""
        self._id = node_id
        self._counts = counts
        self._passed_on: dict[tuple[DatumId, int], None] = {}
        """Which datum, and to which neighbour. They leave together, once a step."""
        self._tells = False
        self._words: dict[int, dict[DatumId, CopyStatus]] = {}

    def say(self, target: int, id: DatumId, word: CopyStatus) -> None:
        """Send it with the next `flush`; to BROADCAST: to all neighbours."""
        self._words.setdefault(target, {})[id] = word

    def passed_on(self, target: int, id: DatumId, *, soon: bool = False) -> None:
        """Tell a neighbour that a datum has been passed on, or has arrived: with the next step, or `soon`."""
        self._passed_on[id, target] = None
        self._tells |= soon

    def counts_on(self, target: int, id: DatumId) -> None:
        """This node counts on the neighbour's copy again: what it was going to tell it is no longer true."""
        self._passed_on.pop((id, target), None)

    def step(self) -> None:
        """Once a step: tell what was passed on since the last."""
        self._tells = True

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""
        if self._passed_on and (self._tells or len(self._passed_on) >= _MOST_PASSED_ON):
            self._tell(out)
        self._tells = False
        if self._words:
            for target, words in self._words.items():
                out.append(CopyStatuses(self._id, target, tuple([CopyStatusEntry(*entry) for entry in words.items()])))
            self._words = {}

    def _tell(self, out: list[Message]) -> None:
        """What was passed on: in one frame for all neighbours, because those to which a datum means nothing ignore it.
        But a datum of which this node counts on another neighbour's copy is named only to those that it concerns."""
        ids: dict[int, dict[DatumId, None]] = {}
        for id, target in self._passed_on:
            ids.setdefault(target if self._counts(id) else BROADCAST, {})[id] = None
        shared_with = {target for id, target in self._passed_on if id in ids.get(BROADCAST, ())}
        for target, some in ids.items():
            if target == BROADCAST and len(shared_with) > 1:
                out.append(PassedOn(self._id, BROADCAST, tuple(some), tuple(sorted(shared_with))))
            else:
                out.append(PassedOn(self._id, shared_with.pop() if target == BROADCAST else target, tuple(some)))
        self._passed_on = {}
