"""A base's index of what has arrived there, and of what was reported lost to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from rass_mav.core.datum import STORE_FAULTS, DatumId, Fate
from rass_mav.core.news.ranges import Ranges

#: How many losses a base accepts for one origin, and in all. Anybody can invent them, or with keys those of one drone,
#: so they are limited.
MAX_LOST_OF_ONE = 4096
MAX_TOLD_LOST = 32768
#: Epochs of one origin, and pairs of origin and epoch in all, of which a base knows losses and nothing else.
MAX_EPOCHS = 64
MAX_PAIRS = 4096
#: How many reports of damaged stores and unknown numbers a base keeps.
MAX_STORE_FAULTS = 1024


class _Origin:
    """The data of one origin and epoch."""

    __slots__ = ("arrived", "lost")

    def __init__(self) -> None:
        self.arrived = Ranges()
        self.lost = Ranges()
        """Reported lost; some of them may have arrived since."""


class Archive:
    """What has become of all data, as far as one base knows. Its size grows with what has arrived, in ranges; losses
    are bounded."""

    __slots__ = ("_epochs", "_losses_only", "_origins", "_told", "_told_of", "store_faults", "told_lost")

    def __init__(self, ids: Iterable[DatumId] = (), losses: Iterable[tuple[DatumId, Fate]] = ()) -> None:
        """What the store holds, and its table of losses."""
        self._origins: dict[tuple[int, int], _Origin] = {}
        self._losses_only: set[tuple[int, int]] = set()
        """Pairs of which nothing has arrived."""
        self._epochs: dict[int, int] = {}
        """How many of these an origin has."""
        self._told = 0
        """Data ever reported lost."""
        self._told_of: Counter[int] = Counter()
        """The same by origin."""
        self.told_lost = 0
        """Data reported lost that have not arrived."""
        self.store_faults: dict[DatumId, Fate] = {}
        """Reports about no single datum: of damaged stores, and of numbers that no node knows of."""
        for id in ids:
            self.add(id)
        for id, fate in losses:
            self.lose(id, fate)

    def add(self, id: DatumId) -> bool:
        """A datum has arrived; if it was reported lost, it is lost no longer. False: it had arrived before."""
        key = (id.origin, id.epoch)
        origin = self._origins.get(key)
        if origin is None:
            origin = self._origins[key] = _Origin()
        elif key in self._losses_only:
            self._losses_only.remove(key)
            self._epochs[id.origin] -= 1
        if id.sequence in origin.arrived:
            return False
        origin.arrived.add(id.sequence, id.sequence + 1)
        if id.sequence in origin.lost:
            self.told_lost -= 1
        return True

    def lose(self, id: DatumId, fate: Fate) -> bool:
        """A datum was reported lost, or a store damaged. False: that is known, or it has arrived, or there is no
        space."""
        if fate in STORE_FAULTS:
            if id in self.store_faults or len(self.store_faults) >= MAX_STORE_FAULTS:
                return False
            self.store_faults[id] = fate
            return True
        if self._told >= MAX_TOLD_LOST or self._told_of[id.origin] >= MAX_LOST_OF_ONE:
            return False
        key = (id.origin, id.epoch)
        origin = self._origins.get(key)
        if origin is None:
            epochs = self._epochs.get(id.origin, 0)
            if epochs >= MAX_EPOCHS or len(self._losses_only) >= MAX_PAIRS:
                return False
            self._epochs[id.origin] = epochs + 1
            self._losses_only.add(key)
            origin = self._origins[key] = _Origin()
        elif id.sequence in origin.lost or id.sequence in origin.arrived:
            return False
        origin.lost.add(id.sequence, id.sequence + 1)
        self._told += 1
        self._told_of[id.origin] += 1
        self.told_lost += 1
        return True

    def is_lost(self, id: DatumId) -> bool:
        """Whether a datum was reported lost, and has not arrived."""
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and id.sequence in origin.lost and id.sequence not in origin.arrived

    def __contains__(self, id: object) -> bool:
        """Whether a datum has arrived."""
        if not isinstance(id, DatumId):
            return False
        origin = self._origins.get((id.origin, id.epoch))
        return origin is not None and id.sequence in origin.arrived

    def __len__(self) -> int:
        """How many (origin, epoch) pairs there are."""
        return len(self._origins)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """(origin, epoch) of all data."""
        return iter(self._origins)

    def has(self, key: tuple[int, int]) -> bool:
        """Whether anything is known of an (origin, epoch)."""
        return key in self._origins

    def end(self, key: tuple[int, int]) -> int:
        """One more than the highest number of an (origin, epoch) that has arrived; 0: none has."""
        origin = self._origins.get(key)
        return 0 if origin is None else origin.arrived.end

    def ranges(self, key: tuple[int, int], *, lost: bool) -> Ranges:
        """What has arrived of an (origin, epoch), or was reported lost; KeyError if nothing is known of it."""
        origin = self._origins[key]
        return origin.lost if lost else origin.arrived
