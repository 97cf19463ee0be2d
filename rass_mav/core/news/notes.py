"""Loss notes: word that a datum is lost, on its way to a base.

A node that finds a datum in its custody beyond repair makes a note of it. Notes are handed from node to node along the
route, with a number and COMMITTED, like data; a node keeps them in its store's table of losses until then. A base that
takes one knows what has become of the datum. A note is only a belief of its maker: somebody may have a good copy all
the same. So a note deletes nothing anywhere, and who has a good copy, or knows that a base has the datum, swallows it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import LossNote, LossNoteEntry
from rass_mav.core.store import Store

#: Notes a node keeps at most. For one of its own the oldest goes; one of a neighbour's is refused.
MAX_NOTES = 256
#: Notes in a frame, and on their way unanswered.
NOTES_IN_FRAME = 8

_REASONS = {
    Fate.CORRUPTED: 1, Fate.EXPIRED: 2, Fate.OVERFLOW: 3, Fate.DIED: 4, Fate.VANISHED: 5, Fate.UNKNOWN: 6,
    Fate.DAMAGED: 7,
}  # fmt: skip
_FATES = {reason: fate for fate, reason in _REASONS.items()}


def fate_of(reason: int) -> Fate:
    """What a note says. A reason that is not known counts as `VANISHED`."""
    return _FATES.get(reason, Fate.VANISHED)


class NoLossNotes:
    """Of a node that makes and takes no notes: a base, or where nobody tells of losses."""

    __slots__ = ("_store", "waiting")

    told = False
    """Whether notes are made and taken."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.waiting: dict[DatumId, Fate] = {}
        """Notes to hand on, the oldest first."""

    def make(self, id: DatumId, fate: Fate) -> None:
        """A datum in own custody is beyond repair; the store knows."""

    def give_up(self, id: DatumId, fate: Fate) -> None:
        """A datum that was looked for is beyond repair."""
        self._store.lose(id, fate)

    def suspect(self, id: DatumId, fate: Fate) -> None:
        """The copy in own custody is gone, and another node is asked for the datum: `make` or `forget` follow."""

    def take(self, id: DatumId, fate: Fate) -> bool:
        """A neighbour hands a note on. False: there is no room."""
        return False

    def forget(self, id: DatumId) -> None:
        """There is nothing to be told of a datum (any more)."""

    def turn(self, sender: int, next_hop: int | None, draw: Callable[[], int]) -> LossNote | None:
        """What to send, one frame at most: what was not answered again, or the oldest. `draw`: gives numbers."""
        return None

    def committed(self, number: int, sender: int) -> None:
        """A neighbour has taken the note of this number."""

    def refused(self, number: int, sender: int) -> None:
        """A neighbour has no room for it: it is offered again under a new number."""


class LossNotes(NoLossNotes):
    """The notes of one drone."""

    __slots__ = ("_numbers", "_target", "suspected")

    told = True

    def __init__(self, store: Store) -> None:
        """Takes up what the table of losses holds from an earlier life."""
        super().__init__(store)
        self.suspected: dict[DatumId, Fate] = {}
        """Notes held back while another node is asked for the datum. On disk too, so that a restart does not lose them.
        Bounded by `repairs.MAX_SEARCHES`."""
        self._numbers: dict[int, DatumId] = {}
        """Notes that are on their way, by hand-over number."""
        self._target = 0
        """To whom."""
        for id, fate in store.losses():
            self.waiting[id] = fate
            self._bound()

    def make(self, id: DatumId, fate: Fate) -> None:
        self._store.lose(id, fate)
        self.suspected.pop(id, None)
        self.waiting.setdefault(id, fate)
        self._bound()

    def give_up(self, id: DatumId, fate: Fate) -> None:
        self.make(id, fate)

    def suspect(self, id: DatumId, fate: Fate) -> None:
        self._store.lose(id, fate)
        self.suspected[id] = fate

    def _bound(self) -> None:
        if len(self.waiting) > MAX_NOTES:
            self.forget(next(iter(self.waiting)))
            self._store.count("notes_dropped")

    def take(self, id: DatumId, fate: Fate) -> bool:
        if id in self.waiting:
            # It has come round: whatever was offered of it, nobody's answer may delete it any more.
            self._cancel(id)
            return True
        if len(self.waiting) >= MAX_NOTES:
            return False
        self.make(id, fate)
        return True

    def forget(self, id: DatumId) -> None:
        if self.waiting and self.waiting.pop(id, None) is not None:
            self._cancel(id)
            self._store.found(id)
        elif self.suspected and self.suspected.pop(id, None) is not None:
            self._store.found(id)

    def _cancel(self, id: DatumId) -> None:
        self._numbers = {number: other for number, other in self._numbers.items() if other != id}

    def turn(self, sender: int, next_hop: int | None, draw: Callable[[], int]) -> LossNote | None:
        if next_hop is None or not self.waiting:
            return None
        if next_hop != self._target or not self._numbers:
            self._target = next_hop
            self._numbers = {draw(): id for id in islice(self.waiting, NOTES_IN_FRAME)}
        entries = [LossNoteEntry(number, id, _REASONS[self.waiting[id]]) for number, id in self._numbers.items()]
        return LossNote(sender, next_hop, tuple(entries))

    def committed(self, number: int, sender: int) -> None:
        id = self._numbers.get(number)
        if id is not None and sender == self._target:
            self.forget(id)

    def refused(self, number: int, sender: int) -> None:
        if sender == self._target:
            self._numbers.pop(number, None)
