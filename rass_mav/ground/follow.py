"""Follows a store while data arrive, and makes something of them that is kept in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from math import isinf
from typing import Generic, Protocol, TypeVar

from rass_mav.app.clock import DateNote
from rass_mav.core.datum import DatumId, Fate
from rass_mav.errors import RassError

from .attention.rules import RuleBook
from .attention.watch import NO_NOTE, Rules
from .entry import Data, Entry
from .feed import Cursor, Feed, Look

#: Data that are read in one look, so that questions between two looks do not wait long.
MOST_IN_A_LOOK = 5000
#: If the base's clock is set by more than this, what was made of the data has wrong times: it is made anew. Seconds.
MOST_SHIFT_S = 60.0


class Made(Protocol):
    """What is made of the data."""

    rules: Rules

    def take(self, entries: Iterable[Entry]) -> int:
        """Data that have arrived. Returns how many."""

    def hear(self, losses: Iterable[tuple[DatumId, Fate]], at: float | None = None) -> bool:
        """All data that are known to be lost now. Returns whether any are new."""


M = TypeVar("M", bound=Made)


class Follower(Generic[M]):
    """Reads a store. One thread at a time uses it."""

    def __init__(
        self, open: Callable[[], Data], make: Callable[[], M], rules: RuleBook | None = None, *, keep: bool = False
    ) -> None:
        """`open` and `keep`: as of a `Feed`. `make`: returns what the data go to. Raises what `open` raises now."""
        self._make, self._rules = make, RuleBook() if rules is None else rules
        self.mission = self._begin()
        self.begins = False
        """Whether it was made anew in the last look: the store has a new life, or its node has learned the date."""
        self.trouble = ""
        """Why the store cannot be read now; empty: it can."""
        self.remarks: list[str] = []
        """What is wrong with the store, for people."""
        self.behind = True
        """Whether there may be more to read at once."""
        self.date: DateNote = NO_NOTE
        """What the store says about the time of its node."""
        self.taken = 0
        """How many data have come since it was made."""
        self.ended = False
        """Whether nothing more will come."""
        self.open = open
        """Opens the data once more, for another reader."""
        self._feed = Feed(open, keep=keep)
        self._cursor: Cursor | None = None
        with self._feed.look(None) as look:
            self.name, self.title = look.data.path.name, look.data.title
            self.remarks = [*look.data.notes, *look.data.remarks]
            self.date = look.data.date

    def _begin(self) -> M:
        made = self._make()
        made.rules = self._rules.renewed()
        self.taken = 0
        return made

    def look(self) -> bool:
        """Read what has arrived. Returns whether any of it is new."""
        before = self._shown
        lost = self.begins = False
        self.mission.rules = self._rules.renewed()
        try:
            with self._feed.look(self._cursor) as look:
                lost = self._read(look)
            self.trouble = ""
        except RassError as error:
            self.trouble = " ".join(error.lines())
            self.behind = False
        return lost or self.begins or before != self._shown

    @property
    def _shown(self) -> tuple[object, ...]:
        # That all is read may show only in a look that finds nothing more.
        return self.taken, self.trouble, self.remarks, self.behind, self.ended

    def _read(self, look: Look) -> bool:
        behind = self.behind
        shifted = abs(look.data.date.offset_s - self.date.offset_s) > MOST_SHIFT_S
        self.date, self.ended = look.data.date, look.data.ended
        if look.restarted or shifted:
            self.mission, self.begins, behind = self._begin(), True, True
        # The beginning of the same store, if its times have changed.
        self._cursor = Cursor(*look.start[:2]) if shifted else look.start
        start = look if not shifted else look._replace(start=self._cursor)
        read = self.mission.take(islice(self._new(start), MOST_IN_A_LOOK))
        self.behind = read == MOST_IN_A_LOOK
        self.taken += read
        wrote = self.date.lived_s + self.date.offset_s
        # Of what was lost before this looked for the first time, nobody has noted when.
        new = self.mission.hear(look.data.losses(), None if behind or isinf(wrote) else wrote)
        self.remarks = [*look.data.notes, *look.data.remarks]
        return new

    def _new(self, look: Look) -> Iterator[Entry]:
        for entry, cursor in look.arrivals():
            self._cursor = cursor
            yield entry

    def close(self) -> None:
        """Release the files."""
        self._feed.close()
