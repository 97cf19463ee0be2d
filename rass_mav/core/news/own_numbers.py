"""An origin watches its data: which of them has no base confirmed for long?

A node that takes custody may be an attacker, or may die. Only a base's statement tells the origin that a datum has
arrived. Where there is no replica that could be sent again, it can at least report this to the ground station.
"""

from __future__ import annotations

from collections.abc import Container

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.datum import DatumId
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.store import Store

# Tuned: python -m tools.sensitivity news.own_numbers
#: Turns in reach of a base within which a datum should be confirmed: data and receipts need a while.
CONFIRMED_TURNS = 300
#: How often it looks, turns.
LOOK_TURNS = CONFIRMED_TURNS // 6
#: Bound: The most numbers that it checks in one look.
MOST_LOOKED_AT = 512


class OwnNumbers:
    """Which of its own data a node waits for."""

    __slots__ = ("_alarms", "_epoch", "_marks", "_missing", "_next", "_node_id", "_receipts", "_store", "_turns")

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
        found = {number for number in range(self._next, end) if self._is_missing(number, held)}
        self._next = max(end, self._next)
        self._missing |= found
        if found:
            first = DatumId(self._node_id, self._epoch, min(self._missing))
            self._alarms.ring(Alarm.UNCONFIRMED, f"{len(self._missing)} data, the first is {first}")

    def _is_missing(self, number: int, held: Container[DatumId]) -> bool:
        id = DatumId(self._node_id, self._epoch, number)
        return id not in self._receipts and not self._receipts.is_reported_lost(id) and id not in held
