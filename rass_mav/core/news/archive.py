"""A base's index of what has arrived there, and of what it was told is lost."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.news.arrivals import NOTHING, Known, completed, one

#: How many losses a base believes. Nobody proves them, so there must be an end.
MAX_TOLD_LOST = 1 << 20


class SequenceSet:
    """A set of sequence numbers that mostly grows without holes: all below `closed`, and some beyond."""

    __slots__ = ("beyond", "closed")

    def __init__(self) -> None:
        self.closed = 0
        self.beyond: set[int] = set()

    def add(self, sequence: int) -> bool:
        """False if it was there already."""
        if sequence in self:
            return False
        self.beyond.add(sequence)
        while self.closed in self.beyond:
            self.beyond.remove(self.closed)
            self.closed += 1
        return True

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.closed or sequence in self.beyond


class _Origin:
    """The data of one origin and epoch."""

    __slots__ = ("lost", "settled")

    def __init__(self) -> None:
        self.settled = SequenceSet()
        """Arrived, or told lost: a loss note closes the hole."""
        self.lost: set[int] = set()
        """Told lost, and not arrived."""

    def arrived(self, sequence: int) -> bool:
        return sequence in self.settled and sequence not in self.lost

    def last(self) -> int:
        """The highest number that has arrived; -1: none."""
        beyond = self.settled.beyond - self.lost
        if beyond:
            return max(beyond)
        last = self.settled.closed - 1
        while last in self.lost:
            last -= 1
        return last


class Archive:
    """What has become of all data, as far as one base knows. As large as what it has been told."""

    __slots__ = ("_origins", "told_lost")

    def __init__(self, ids: Iterable[DatumId] = (), losses: Iterable[tuple[DatumId, Fate]] = ()) -> None:
        """What its store holds, and its table of losses."""
        self._origins: dict[tuple[int, int], _Origin] = {}
        self.told_lost = 0
        """Data told lost that have not arrived."""
        for id in ids:
            self.add(id)
        for id, _ in losses:
            self.lose(id)

    def _origin(self, id: DatumId) -> _Origin:
        key = (id.origin, id.epoch)
        origin = self._origins.get(key)
        if origin is None:
            origin = self._origins[key] = _Origin()
        return origin

    def add(self, id: DatumId) -> bool:
        """A datum has arrived; if it was told lost, it is lost no longer. False: it had arrived before."""
        origin = self._origin(id)
        if id.sequence in origin.lost:
            origin.lost.remove(id.sequence)
            self.told_lost -= 1
            return True
        return origin.settled.add(id.sequence)

    def lose(self, id: DatumId) -> bool:
        """A datum was told lost. False: that is known, or it has arrived, or there is no end of losses."""
        if self.told_lost >= MAX_TOLD_LOST:
            return False
        origin = self._origin(id)
        if not origin.settled.add(id.sequence):
            return False
        origin.lost.add(id.sequence)
        self.told_lost += 1
        return True

    def is_lost(self, id: DatumId) -> bool:
        """Whether a datum was told lost, and has not arrived."""
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and id.sequence in origin.lost

    def __contains__(self, id: object) -> bool:
        """Whether a datum has arrived."""
        if not isinstance(id, DatumId):
            return False
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and origin.arrived(id.sequence)

    def __len__(self) -> int:
        """How many (origin, epoch) pairs there are."""
        return len(self._origins)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """(origin, epoch) of all data."""
        return iter(self._origins)

    def has(self, key: tuple[int, int]) -> bool:
        """Whether anything is known of an (origin, epoch)."""
        return key in self._origins

    def known(self, key: tuple[int, int]) -> Known:
        """What can be told of an (origin, epoch); KeyError if nothing is known of it."""
        last = self._origins[key].last()
        return self.completed(key, NOTHING if last < 0 else one(last))

    def completed(self, key: tuple[int, int], known: Known) -> Known:
        """A piece of knowledge of an (origin, epoch) with what this base can add to it."""
        origin = self._origins.get(key)
        return known if origin is None else completed(known, origin.arrived, origin.lost.__contains__)
