"""Gossip: how everything spreads that all nodes should know. It is Trickle (RFC 6206) over items of one kind.

An item has a key and a value, and means nothing here. It enters once its receiver believes it. A `Gossip` is one node's
scheduler for one kind of items; each kind keeps what it knows in a table of its own. The rules:

1. A new item is hot: it leaves at a random time within the interval `NEW`, unless it is heard `ENOUGH` times before.
   Then it rests. All hearers began to wait with the same frame, so none has to listen for half of the interval first.
   Where the sender is known, each sender counts once, and the one that brought the item does not count: no sender can
   silence a relay alone. An item that a neighbour asks for is new again.
2. Intervals that double belong to the kind, not to the item. The hash in the beacon shows who lacks something, and as
   long as all hashes are equal nothing is sent. While one differs, all items are offered again, at a random time in the
   second half of each interval. The first interval is `IMIN`, each further one is twice as long, and after `IMAX` the
   kind rests.
3. The intervals begin again when a neighbour's hash differs and this is not the difference of the last time: another
   neighbour differs, or this node knows something else. That happens at most once in `IMAX`, so no neighbour keeps
   others talking.
4. Hash 0 means "do not compare". A node that had to forget something sends it, and such a node begins no intervals.
5. One item leaves in a period on average, and at most two do. New ones come before those that are offered again: of one
   source's the one due first, and each source that has some is as likely as another. But one frame in `OFFERED_SHARE`
   is for what is offered again, the latest first. What a neighbour sends is not offered any more.
6. Of each kind a bounded number is hot. When there is one too many, the source with the most loses its oldest. An item
   that two sources bring counts for the one with fewer.

Times are in turns of the node. A period is `custody.receipt_steps` turns, unless the kind has its own.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

from rass_mav.core.shares import greediest

# Tuned: python -m tools.sensitivity gossip
#: The interval in which a new item leaves, and the shortest and the longest interval of its kind, periods.
NEW, IMIN = 1, 8
IMAX = 8 * IMIN
#: The redundancy constant, k of RFC 6206: a new item heard so many times again does not leave.
ENOUGH = 2
#: While there are new items, one frame in this many is for what is offered again.
OFFERED_SHARE = 4
#: Hot items of a kind.
MAX_HOT = 256

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class _Hot(Generic[V]):
    """A new item that has not left yet."""

    __slots__ = ("due", "senders", "source", "value")

    def __init__(self, value: V, source: Hashable, due: int, senders: tuple[Hashable, ...]) -> None:
        self.value = value
        self.source = source
        """Of whose share it takes a place."""
        self.due = due
        """The turn from which on it may leave."""
        self.senders = senders
        """The node that brought it, and those that have sent it since."""


class Gossip(Generic[K, V]):
    """One node's items of one kind."""

    __slots__ = (
        "_again", "_at", "_begun", "_differing", "_enough", "_hash", "_hot", "_interval", "_most", "_rng",
        "_sent", "free_at", "period",
    )  # fmt: skip

    def __init__(self, rng: random.Random, *, period: int = 1, most: int = MAX_HOT) -> None:
        """:param period: turns from one item that leaves to the next, at least.
        :param most: items that may be hot.
        """
        self._rng = rng
        self.period = period
        self._most = most
        self.free_at = 0
        """The turn from which on the next item may leave."""
        self._hot: dict[K, _Hot[V]] = {}
        """New items, the oldest first."""
        self._again: dict[K, V] = {}
        """Items that are offered again, the next one last."""
        self._sent = 0
        self._interval = IMAX + 1
        """Periods; above `IMAX`: the kind rests."""
        self._begun: float = -float("inf")
        """The turn in which the intervals began last."""
        self._at: int | None = None
        """The turn in which all items are offered next; None: at present no neighbour differs."""
        self._hash = 0
        """Own hash when the intervals began, and the neighbours that differed."""
        self._differing: frozenset[Hashable] = frozenset()

    def __contains__(self, key: K) -> bool:
        """Whether an item waits to leave."""
        return key in self._hot or key in self._again

    @property
    def news(self) -> int:
        """How many new items wait to leave."""
        return len(self._hot)

    def keys(self) -> set[K]:
        """All items that wait to leave."""
        return self._hot.keys() | self._again.keys()

    # -- what comes in -------------------------------------------------------------------------------------------------

    def add(self, key: K, value: V, source: Hashable, turn: int, senders: tuple[Hashable, ...] = ()) -> None:
        """An item is new, or a neighbour needs it.

        :param source: of whose share it takes a place. :param senders: those so far, the first one brought it;
            empty: the source.
        """
        hot = self._hot.get(key)
        if hot is not None:
            hot.value = value
            if hot.source != source:
                shares = self._shares()
                hot.source = min(hot.source, source, key=lambda one: shares[one])
            return
        self._again.pop(key, None)
        if len(senders) > ENOUGH:
            return
        self._hot[key] = _Hot(value, source, turn + self._wait(), senders or (source,))
        if len(self._hot) > self._most:
            most = greediest(self._shares())
            del self._hot[next(key for key, hot in self._hot.items() if hot.source == most)]

    def _shares(self) -> Counter[Hashable]:
        return Counter(hot.source for hot in self._hot.values())

    def _wait(self) -> int:
        """Turns until a new item may leave. Where one may leave in every turn, none waits."""
        return 0 if self.period == 1 else 1 + self._rng.randrange(self.period * NEW)

    def hear(self, key: K, sender: Hashable = None) -> None:
        """A neighbour has sent an item that is known here. `sender`: which one; None: that is not known."""
        self._again.pop(key, None)
        hot = self._hot.get(key)
        if hot is not None and (sender is None or sender not in hot.senders):
            hot.senders += (sender,)
            if len(hot.senders) > ENOUGH:
                del self._hot[key]

    def drop(self, key: K) -> None:
        """An item is not to leave."""
        self._hot.pop(key, None)
        self._again.pop(key, None)

    # -- what neighbours lack ------------------------------------------------------------------------------------------

    def differs(self, turn: int, own: int, hashes: Iterable[tuple[Hashable, int]]) -> bool:
        """Whether it is time to offer all items again. To be called once a period.

        :param own: hash of what this node knows. :param hashes: of what its neighbours know.
        """
        differing = frozenset([who for who, other in hashes if other not in (own, 0)]) if own else frozenset()
        if not differing:
            self._again.clear()
            self._at, self._differing = None, differing
            return False
        if turn - self._begun >= IMAX * self.period and (own != self._hash or not differing <= self._differing):
            self._begun, self._hash, self._differing = turn, own, differing
            self._interval, self._at = IMIN, None
        else:
            # A neighbour that goes and comes back is another one.
            self._differing &= differing
        if self._again or self._interval > IMAX:
            return False
        if self._at is None:
            self._at = turn + self._half()
        if turn < self._at:
            return False
        self._interval *= 2
        self._at = turn + self._half()
        return True

    def _half(self) -> int:
        """A time in the second half of the interval."""
        half = self._interval * self.period // 2
        return half + self._rng.randrange(half + 1)

    def offer(self, items: Iterable[tuple[K, V]]) -> None:
        """Items that neighbours lack, the last one first."""
        self._again.update((key, value) for key, value in items if key not in self._hot)

    # -- what goes out -------------------------------------------------------------------------------------------------

    def leave(self, turn: int) -> tuple[K, V] | None:
        """The item that leaves in this turn; None: none does."""
        if turn < self.free_at or not (self._hot or self._again):
            return None
        first: dict[Hashable, K] = {}
        for key, hot in self._hot.items():
            if hot.due <= turn and (hot.source not in first or hot.due < self._hot[first[hot.source]].due):
                first[hot.source] = key
        due = [*first.values()]
        if self._again and (not due or (self._sent + 1) % OFFERED_SHARE == 0):
            self.spend(turn)
            return self._again.popitem()
        if not due:
            return None
        self.spend(turn)
        key = due[0] if len(due) == 1 else self._rng.choice(due)
        return key, self._hot.pop(key).value

    def spend(self, turn: int) -> None:
        """An item leaves."""
        self._sent += 1
        self.free_at = max(self.free_at, turn - self.period) + self.period
