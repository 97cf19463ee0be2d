"""Overheard data: copies that no node knows of, and that cost no airtime.

On a radio all nodes in range hear a hand-over. A node keeps the data that others hand over to each other, as long as it
has much free space, and some of them if it has little. They are in memory only: after a restart they are gone, and no
disk is worn by them. They give way to all other copies, and no node counts on them. An overheard copy ends when its
datum has arrived, comes to this node in another way, or has been kept for `KEPT_TURNS`. It comes into custody when a
custodian asks for the datum, or when the datum is reported lost.

Any radio can send a frame, so nothing else that is held here changes because of one. One neighbour, and the data of
one origin, get only a part of the places.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from rass_mav.core.custody.holdings import Holdings
from rass_mav.core.custody.journal import PATIENCE_TURNS
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import INLINE_BYTES, Handover
from rass_mav.core.shares import NOTHING, count

#: Data a node keeps at most, if its capacity allows more.
MAX_OVERHEARD = 1024
#: Bytes of large ones at most: they are in memory.
MAX_BYTES = 8 << 20
# Tuned: python -m tools.sensitivity custody.overheard
#: The chance that a datum is kept is so many times the free part of the capacity: certain, as long as a third is free.
EAGER = 3
#: Bound: One neighbour may fill one place and one byte in this many, and so may the data of one origin.
PART = 4
#: Turns after which a copy is forgotten, and the chunks of a datum if no other was heard: twice as long as a node waits
#: for a receipt before it sends data again.
KEPT_TURNS = 2 * PATIENCE_TURNS


class Overheard:
    """The overheard data of one node."""

    __slots__ = (
        "_holdings",
        "_of_one",
        "_origins",
        "_rng",
        "_senders",
        "_sources",
        "bytes",
        "data",
    )  # fmt: skip

    def __init__(self, holdings: Holdings, rng: random.Random) -> None:
        self._holdings = holdings
        self._rng = rng
        self.data: dict[DatumId, Datum] = {}
        """The oldest first; radiation may strike them, so the checksum is verified before use."""
        self.bytes = 0
        """Their payloads together."""
        self._sources: dict[DatumId, tuple[int, float]] = {}
        """The sender of each, and when it was sent, seconds."""
        self._senders: dict[int, list[int]] = {}
        """How many are from each, and their bytes of payload."""
        self._origins: dict[int, list[int]] = {}
        """The same by origin."""
        most = min(holdings.capacity_items or MAX_OVERHEARD, MAX_OVERHEARD)
        self._of_one = max(1, most // PART)
        """How many may come from one neighbour, and how many from one origin."""

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        data, senders, origins = self.data, dict[int, list[int]](), dict[int, list[int]]()
        for id, datum in data.items():
            count(senders, self._sources[id][0], 1, len(datum.payload))
            count(origins, id.origin, 1, len(datum.payload))
        if (senders, origins) != (self._senders, self._origins):
            return "the shares are not those of the data"
        if any(items > self._of_one for items, _ in (*senders.values(), *origins.values())):
            return "one neighbour or one origin has more than its part"
        if list(self._sources) != list(data) or self.bytes != sum(len(datum.payload) for datum in data.values()):
            return "the ages or the bytes are not those of the data"
        return ""

    def hear(self, sender: int, handovers: Iterable[Handover], now: float, is_wanted: Callable[[Datum], bool]) -> None:
        """A neighbour sends data to another node. `is_wanted`: whether a datum may be kept here at all."""
        data, holdings = self.data, self._holdings
        free: float | None = None
        for _, datum in handovers:
            id = datum.id
            if id in data or id in holdings:
                continue
            if free is None:
                free = min(holdings.free_part(len(data), self.bytes), 1.0 - len(data) / MAX_OVERHEARD)
            if self._rng.random() < EAGER * free and self._has_place(sender, datum) and is_wanted(datum):
                data[id] = datum
                size = len(datum.payload)
                self.bytes += size
                self._sources[id] = sender, now
                count(self._senders, sender, 1, size)
                count(self._origins, id.origin, 1, size)

    def _has_place(self, sender: int, datum: Datum) -> bool:
        size = len(datum.payload)
        of_sender, sender_bytes = self._senders.get(sender, NOTHING)
        of_origin, origin_bytes = self._origins.get(datum.id.origin, NOTHING)
        return (
            of_sender < self._of_one
            and of_origin < self._of_one
            and self._has_bytes(max(sender_bytes, origin_bytes), size)
            and not self._holdings.crowded(self.bytes + size, len(self.data))
        )

    def _has_bytes(self, of_one: int, size: int) -> bool:
        """Whether so many bytes may come from one that has sent so many. Small data are few bytes in all, and find room
        beside large ones."""
        return size <= INLINE_BYTES or (self.bytes + size <= MAX_BYTES and of_one + size <= MAX_BYTES // PART)

    def forget(self, id: DatumId) -> None:
        """A copy is not needed any more. Unknown ids are ignored."""
        datum = self.data.pop(id, None)
        if datum is None:
            return
        size = len(datum.payload)
        self.bytes -= size
        sender, _ = self._sources.pop(id)
        count(self._senders, sender, -1, -size)
        count(self._origins, id.origin, -1, -size)

    def make_way(self, size: int) -> None:
        """Another copy of `size` bytes of payload is about to be stored: forget the oldest until it fits beside the
        rest."""
        crowded, data = self._holdings.crowded, self.data
        while data and crowded(self.bytes + size, len(data)):
            self.forget(next(iter(data)))

    def step(self, now: float, turn_s: float, lifetime_s: float | None) -> None:
        """Once a turn: forget what has been kept for too long, or is older than `lifetime_s`. What expires by its own
        terms is forgotten when somebody asks for it."""
        before = now - KEPT_TURNS * turn_s
        while self._sources:
            id, (_, heard) = next(iter(self._sources.items()))
            if heard >= before:
                break
            self.forget(id)
        if lifetime_s is not None:
            for id in [id for id, datum in self.data.items() if datum.created < now - lifetime_s]:
                self.forget(id)

    def get(self, id: DatumId, now: float) -> Datum | None:
        """An overheard datum that is intact, and has not expired by its own terms; None: there is none."""
        datum = self.data.get(id)
        if datum is None:
            return None
        ttl_s = datum.terms.ttl_s
        if not datum.intact or (ttl_s is not None and datum.created + ttl_s < now):
            self.forget(id)
            return None
        return datum
