"""An origin watches its data: which of them has no base confirmed for long?

A node that takes custody may be an attacker, or may die. Only a base's statement tells the origin that a datum has
arrived. Where there is no replica that could be sent again, it can at least report this to the ground station.

Among many nodes such statements take long to come. A summary proves nothing, but for a datum that one matches, the
origin waits longer.
"""

from __future__ import annotations

from collections.abc import Container

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Summary
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.summaries import matched
from rass_mav.core.store import Store

#: Turns in reach of a base within which a datum should be confirmed: data and receipts need a while.
CONFIRMED_TURNS = 300
#: The same for data that a summary matches.
MATCHED_TURNS = 1200
#: How often it looks, turns.
LOOK_TURNS = 50
#: The most numbers that it checks in one look.
MOST_LOOKED_AT = 512


class OwnNumbers:
    """Which of its own data a node waits for."""

    __slots__ = (
        "_alarms",
        "_epoch",
        "_marks",
        "_missing",
        "_next",
        "_node_id",
        "_receipts",
        "_store",
        "_turns",
        "matched",
    )  # fmt: skip

    def __init__(self, node_id: int, store: Store, receipts: NoReceipts, alarms: Alarms) -> None:
        self._node_id = node_id
        self._store = store
        self._receipts = receipts
        self._alarms = alarms
        self._epoch = store.epoch
        self._turns = 0
        self._marks: list[int] = []
        """How many numbers had been assigned at each look of the last `CONFIRMED_TURNS` turns, the oldest first."""
        self._next = 0
        """All numbers below are settled, or missing."""
        self._missing: set[int] = set()
        """Numbers that have been missing for long enough. At most as many as are checked in one look."""
        self.matched: dict[int, int] = {}
        """Numbers that a summary matches and no base is known to have stated, and the turn in which the wait for that
        is over. At most as many as are checked in one look."""

    def turn(self, held: Container[DatumId]) -> None:
        """Once a turn in which a base is in reach. `held`: the data of which this node has a copy."""
        self._turns += 1
        if self._turns % LOOK_TURNS:
            return
        self._marks.append(self._store.assigned)
        if len(self._marks) <= CONFIRMED_TURNS // LOOK_TURNS:
            return
        self._missing = {number for number in self._missing if self._is_missing(number, held)}
        end = min(self._marks.pop(0), self._next + MOST_LOOKED_AT - len(self._missing))
        due = {number for number, turn in self.matched.items() if turn <= self._turns}
        due.update(number for number in range(self._next, end) if number not in self.matched)
        found = {number for number in due if self._is_missing(number, held)}
        self.matched = {number: turn for number, turn in self.matched.items() if self._is_waited_for(number, turn)}
        self._next = max(end, self._next)
        self._missing |= found
        if found:
            first = DatumId(self._node_id, self._epoch, min(self._missing))
            self._alarms.ring(Alarm.UNCONFIRMED, f"{len(self._missing)} data, the first is {first}")

    def apply_summary(self, summary: Summary) -> None:
        """A base reports what has arrived of late."""
        numbers = range(self._next, min(self._store.assigned, self._next + MOST_LOOKED_AT))
        for id in matched(summary, [self._id(number) for number in numbers if number not in self.matched]):
            if len(self.matched) < MOST_LOOKED_AT and id not in self._receipts:
                self.matched[id.sequence] = self._turns + MATCHED_TURNS

    def _id(self, number: int) -> DatumId:
        return DatumId(self._node_id, self._epoch, number)

    def _is_waited_for(self, number: int, turn: int) -> bool:
        return turn > self._turns and self._id(number) not in self._receipts

    def _is_missing(self, number: int, held: Container[DatumId]) -> bool:
        id = self._id(number)
        return id not in self._receipts and not self._receipts.is_reported_lost(id) and id not in held
