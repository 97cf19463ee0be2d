"""The global ledger of a mock swarm: what became of each datum, over all nodes."""

from __future__ import annotations

from collections import Counter
from typing import Any

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.observer import Observer
from rass_mav.core.store import Store

#: The fates that the summary counts as lost, in its order.
LOST = (Fate.CORRUPTED, Fate.OVERFLOW, Fate.EXPIRED, Fate.DIED, Fate.VANISHED, Fate.UNFOUNDED)


def outcome(created: int, delivered: int, held: int, lost: dict[str, int], altered: int) -> dict[str, Any]:
    """What became of the data, for a summary. `lost`: by reason."""
    kept = created - sum(count for fate, count in lost.items() if fate != Fate.VANISHED.value)
    return {
        "created": created,
        "delivered": delivered,
        "held": held,
        "lost": lost,
        "altered": altered,
        "reliability": round(kept / created, 6) if created else 1.0,
        "delivered_share": round(delivered / created, 6) if created else 1.0,
    }


class InvariantError(AssertionError):
    """The swarm broke a promise: our bug, never the user's."""


class Ledger:
    """Counts distinct data, incrementally: created = delivered + held + lost.

    A datum is lost when its last copy goes. If a copy turns up again (in a late frame), the datum is held again.
    """

    def __init__(self, *, custody: bool) -> None:
        """`custody`: nodes keep data until another node has them."""
        self._baseless = Fate.UNFOUNDED if custody else Fate.VANISHED
        self.step = 0
        """The present step; the world sets it."""
        self.payloads: dict[DatumId, bytes] = {}
        """Each datum's bytes as they were created."""
        self.born: dict[DatumId, int] = {}
        """Step of creation."""
        self.copies: dict[DatumId, int] = {}
        """Copies in drones' stores, of data with at least one."""
        self.arrived: dict[DatumId, int] = {}
        """Step of first arrival at a base."""
        self.lost: dict[DatumId, Fate] = {}
        self.spoilt: dict[DatumId, Fate] = {}
        """Why a copy was lost while another was left: the latest reason."""
        self.overflow = 0
        """Measurements refused by full nodes: created and lost, but they never got an id."""
        self.altered = 0
        """Delivered data whose bytes are not those created."""
        self.apart = 0
        """Second contents that bases have kept apart."""
        self.hops: list[int] = []
        self.stored = 0
        """Copies in all drones' stores."""
        self.waiting = 0
        """Data with a copy that have not been delivered."""
        self.waiting_copies = 0
        """Their copies."""
        self.lies = False
        """Whether a node may hand over data that no node created; such data are not counted."""
        self.false_delivered = 0
        """Data that arrived at a base and that no node created."""

    def book(self, *, base: bool) -> Observer:
        """A book for one node."""
        return _Book(self, base=base)

    @property
    def created(self) -> int:
        """Data created, including those that were refused."""
        return len(self.born) + self.overflow

    @property
    def held(self) -> int:
        """Data that are held and not delivered."""
        return self.waiting

    def losses(self) -> dict[str, int]:
        """Lost data by reason."""
        counts = Counter(self.lost.values())
        counts[Fate.OVERFLOW] += self.overflow
        return {fate.value: counts[fate] for fate in LOST}

    def delays(self) -> list[int]:
        """Steps from creation to arrival, of data that arrived."""
        return [step - self.born[id] for id, step in self.arrived.items()]

    def is_genuine(self, datum: Datum) -> bool:
        """Whether a node of the swarm created it, byte by byte."""
        return self.payloads.get(datum.id) == datum.payload

    def gain(self, id: DatumId) -> None:
        """A drone has one copy more."""
        copies = self.copies.get(id, 0) + 1
        self.copies[id] = copies
        self.stored += 1
        if id not in self.arrived:
            self.waiting_copies += 1
            if copies == 1:
                self.waiting += 1
                self.lost.pop(id, None)

    def drop(self, id: DatumId, fate: Fate) -> None:
        """A drone has one copy less."""
        copies = self.copies.get(id, 0)
        if copies:
            copies -= 1
            self.stored -= 1
            if copies:
                self.copies[id] = copies
            else:
                del self.copies[id]
        if id in self.arrived:
            return
        self.waiting_copies -= 1
        trusted = fate in (Fate.PASSED_ON, Fate.DELIVERED)
        if copies:
            if not trusted and (fate is not Fate.OVERFLOW or id not in self.spoilt):
                self.spoilt[id] = fate
        else:
            self.waiting -= 1
            # Another node was believed to have it, and there is no copy: that node has lost it since, and this is why
            # it is lost. If no node did, it was sent without custody, and is in the air until it turns up; or, with
            # custody, it was deleted because of a false message. The same where the last copy was a replica that gave
            # way to another datum.
            if trusted or fate is Fate.OVERFLOW:
                fate = self.spoilt.get(id, self._baseless if trusted else fate)
            self.lost[id] = fate

    def decline(self, id: DatumId) -> None:
        """A datum sent without custody was not accepted. Unless there is another copy, it is lost."""
        if id not in self.copies and id not in self.arrived:
            self.lost[id] = Fate.OVERFLOW

    def deliver(self, datum: Datum) -> None:
        """A datum arrived at a base."""
        id = datum.id
        if id in self.arrived:
            return
        self.arrived[id] = self.step
        self.hops.append(datum.hops)
        if datum.payload != self.payloads.get(id):
            self.altered += 1
        copies = self.copies.get(id, 0)
        if copies:
            self.waiting -= 1
            self.waiting_copies -= copies
        self.lost.pop(id, None)


class _Book(Observer):
    def __init__(self, ledger: Ledger, *, base: bool) -> None:
        self._ledger = ledger
        self._base = base
        self._false: set[DatumId] = set()
        """The data held here that no node created."""

    def created(self, datum: Datum) -> None:
        ledger = self._ledger
        ledger.payloads[datum.id] = datum.payload
        ledger.born[datum.id] = ledger.step

    def overflow(self) -> None:
        self._ledger.overflow += 1

    def gained(self, datum: Datum) -> None:
        if self._base:
            return
        if self._ledger.lies and not self._ledger.is_genuine(datum):
            self._false.add(datum.id)
        else:
            self._ledger.gain(datum.id)

    def dropped(self, id: DatumId, fate: Fate) -> None:
        if self._base:
            return
        if id in self._false:
            self._false.remove(id)
        else:
            self._ledger.drop(id, fate)

    def declined(self, id: DatumId) -> None:
        self._ledger.decline(id)

    def delivered(self, datum: Datum) -> None:
        if self._ledger.lies and not self._ledger.is_genuine(datum):
            self._ledger.false_delivered += 1
        else:
            self._ledger.deliver(datum)

    def kept_apart(self, datum: Datum) -> None:
        self._ledger.apart += 1
        if self._ledger.is_genuine(datum):
            # Another node had created one under its id before.
            self._ledger.deliver(datum)


class Diary(Observer):
    """The book of a node with a disk. It follows the disk: changes wait for the commit that covers them, and a power
    cut forgets those that wait. A datum is created when its commit is done."""

    def __init__(self, ledger: Ledger, *, base: bool) -> None:
        self.stored: set[DatumId] = set()
        """What is on disk by all completed commits, and has not been released."""
        self._ledger = ledger
        self._book = ledger.book(base=base)
        self._tell = self._book.delivered if base else self._book.gained
        # A datum that is here, or the fate of one that no longer is.
        self._waiting: list[tuple[DatumId, Datum | Fate]] = []
        self._begun: list[tuple[DatumId, Datum | Fate]] = []

    def overflow(self) -> None:
        self._book.overflow()

    def declined(self, id: DatumId) -> None:
        self._book.declined(id)

    def kept_apart(self, datum: Datum) -> None:
        self._book.kept_apart(datum)

    def gained(self, datum: Datum) -> None:
        self._waiting.append((datum.id, datum))

    delivered = gained

    def dropped(self, id: DatumId, fate: Fate) -> None:
        self._waiting.append((id, fate))

    @property
    def leaving(self) -> dict[DatumId, Fate]:
        """What has been released since the last completed commit."""
        return {id: news for id, news in self._begun + self._waiting if isinstance(news, Fate)}

    def begin(self) -> None:
        """A commit of all changes so far begins; or the last one, which failed, is tried again."""
        self._begun += self._waiting
        self._waiting = []

    def done(self) -> None:
        """The commit is done."""
        begun, self._begun = self._begun, []
        for id, news in begun:
            if not isinstance(news, Fate):
                self._keep(news)
            elif id in self.stored:
                self._let_go(id, news)

    def wake(self, store: Store, *, damaged: bool) -> None:
        """The power is back, and this is what was on disk. Data that no commit had acknowledged may be there or not.

        `damaged`: by flipped bits; otherwise all that is `stored` must be there, or `InvariantError` is raised.
        """
        self._waiting = []
        leaving, self._begun = self.leaving, []
        found = set(store.ids())
        for id in sorted(self.stored - found):
            if not damaged and id not in leaving:
                raise InvariantError(f"{id} was on disk, and is missing after a power cut")
            self._let_go(id, leaving.get(id, Fate.DIED))
        for id in sorted(found - self.stored):
            datum = store.get(id)
            if datum is not None and datum.intact:
                self._keep(datum)

    def lose_all(self) -> None:
        """The disk is gone."""
        for id in sorted(self.stored):
            self._let_go(id, Fate.DIED)

    def _keep(self, datum: Datum) -> None:
        # Replaced: by a newer value, or by another datum if flipped bits have made a node forget its last number.
        if datum.id in self.stored:
            return
        self.stored.add(datum.id)
        if datum.id not in self._ledger.born:
            self._book.created(datum)
        self._tell(datum)

    def _let_go(self, id: DatumId, fate: Fate) -> None:
        self.stored.discard(id)
        self._book.dropped(id, fate)
