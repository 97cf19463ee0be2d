"""What a node holds and answers for: taking data in, verifying them, letting go of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rass_mav.core.custody.handovers import Custody
from rass_mav.core.custody.holdings import Inventory
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.notes import LossNotes
from rass_mav.core.news.receipts import Pair, Receipts
from rass_mav.core.observer import Observer
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store

if TYPE_CHECKING:
    import random
    from collections.abc import Container

    from rass_mav.core.custody.transfers import Transfers
    from rass_mav.core.replica import Replica
    from rass_mav.core.spares.mirrors import Mirrors


#: What is dropped for one of these reasons is gone, as far as this node knows.
_BEYOND_REPAIR = (Fate.CORRUPTED, Fate.EXPIRED, Fate.OVERFLOW)


class Keeper:
    """The keeping half of a node. `Node` adds what is said to neighbours and Alg. 1."""

    __slots__ = (
        "_scrub_at",
        "archive",
        "custody",
        "index",
        "inventory",
        "mirrors",
        "notes",
        "observer",
        "receipts",
        "refused",
        "replica",
        "settings",
        "sink",
        "stirred",
        "store",
        "transfers",
    )

    mirrors: Mirrors | None
    replica: Replica | None
    transfers: Transfers

    def __init__(
        self,
        settings: NodeSettings,
        store: Store,
        rng: random.Random,
        observer: Observer | None,
        *,
        sink: bool,
        receipts: bool,
    ) -> None:
        """`sink`: what comes here has arrived for good. `receipts`: bases say what has arrived, nodes tell it on."""
        self.settings = settings
        self.store = store
        self.observer = observer or Observer()
        self.sink = sink
        """Whether what comes here has arrived for good."""
        self.index = Archive(store.ids(), store.losses()) if sink else None
        """At a base: what has become of all data."""
        self.receipts: Receipts | None = None
        """What receipts told of arrivals at bases."""
        if receipts:
            source = (settings.node_id, store.epoch) if sink else (0, 0)
            # Neighbours' turns should not come together, so ids are scattered (by Knuth's multiplicative hashing).
            phase = settings.node_id * 2654435761 % (1 << 32) >> 16
            self.receipts = Receipts(source, archive=self.index, period=settings.receipt_steps, phase=phase)
        heard: Container[DatumId] = frozenset() if self.receipts is None else self.receipts
        self.archive: Container[DatumId] = heard if self.index is None else self.index
        """What has arrived: at a base what is here, elsewhere what has reached a base as far as receipts told."""
        self.notes = LossNotes(store) if receipts and settings.acknowledged and not sink else None
        """Word of lost data, on its way to a base."""
        self.inventory = Inventory(
            store,
            capacity_items=settings.capacity_items,
            capacity_bytes=settings.capacity_bytes,
            own_share=settings.own_share,
            load=not sink,
        )
        self.custody = Custody(rng)
        self.refused = 0
        """Hand-overs refused for want of room."""
        self.stirred = False
        """Whether something came into custody that `Node.forward` has not looked at."""
        self._scrub_at = 0

    def take_custody(self, giver: int, number: int, datum: Datum) -> bool:
        """Accept a datum that arrived whole and intact. False: no room, the giver keeps it."""
        id = datum.id
        if self.has_custody(giver, number, id, datum.crc):
            return True
        size = len(datum.payload)
        if self.inventory.holds(id) or not (self.may_accept(size) or self.make_room(size, own=False)):
            self.refused += 1
            if number == 0:
                self.observer.declined(id)
            return False
        if self.sink:
            self.deliver(datum.arrived())
        else:
            self.hold(datum.arrived())
            if self.mirrors is not None:
                self.mirrors.took(id, giver)
        if number:
            self.custody.accept(giver, number, id)
        return True

    def keep_spare(self, giver: int, number: int, datum: Datum) -> bool:
        """Keep a spare copy for a neighbour that has custody. False: it cannot be kept, or not relied on."""
        if self.sink:
            return self.take_custody(giver, number, datum)
        if self.mirrors is None or not self.mirrors.keep(giver, datum):
            self.refused += 1
            return False
        return True

    def give_away(self, id: DatumId, to: int) -> None:
        """A neighbour has taken custody of a datum."""
        if self.mirrors is None:
            self.drop(id, Fate.PASSED_ON)
        else:
            self.mirrors.gave(id, to)

    def has_custody(self, giver: int, number: int, id: DatumId, crc: int) -> bool:
        """Whether a datum on offer needs no taking: it has arrived, or is here, or this offer was taken.

        False with `id` still in the inventory: what is held under this id is another datum, so the offer is refused.
        """
        inventory, mirrors = self.inventory, self.mirrors
        if id in self.archive:
            taken = True
        elif not inventory.holds(id):
            taken = bool(number) and self.custody.has_accepted(giver, number, id)
        else:
            # The giver will delete its copy on our word, so ours must be good at this moment; a bad one is dropped.
            held = self.load(id)
            if held is None or held.crc != crc:
                return False
            taken = bool(number) and self.custody.has_accepted(giver, number, id)
            if not taken:
                self._comes_round(giver, number, id)
                return True
        if taken and mirrors is not None and id not in inventory:
            mirrors.not_here(id, giver)
        return taken

    def _comes_round(self, giver: int, number: int, id: DatumId) -> None:
        """A datum is offered that is here already: this copy is what the giver may rely on from now on."""
        # Whatever we offered of it, nobody's answer may delete it any more.
        self.custody.cancel(id)
        self.transfers.cancel(id)
        if number:
            self.custody.accept(giver, number, id)
        if self.mirrors is not None:
            if id not in self.inventory:
                self.mirrors.take_back(id)
            self.mirrors.took(id, giver)

    def room_for(self, size: int, *, own: bool) -> bool:
        """Whether another datum of `size` bytes of payload can be stored, if need be in place of spares.

        `own`: a measurement of this node."""
        inventory = self.inventory
        return (self.sink or inventory.room_for(size, own=own)) and self.store.room_for(size - inventory.spare_bytes)

    def may_accept(self, size: int) -> bool:
        """Whether custody of a datum of `size` bytes of payload can be taken over."""
        return self.store.accepting and self.room_for(size, own=False)

    def make_room(self, size: int, *, own: bool) -> bool:
        """With `drop_oldest`: let go of the least recently used data until `size` bytes of payload fit."""
        if not self.settings.drop_oldest or self.sink or self.replica is not None or not self.store.accepting:
            return False
        while not self.room_for(size, own=own):
            oldest = next(iter(self.inventory), None)
            if oldest is None:
                return False
            self.drop(oldest, Fate.OVERFLOW)
        return True

    def hold(self, datum: Datum) -> None:
        """Store a datum in own custody."""
        mirrors = self.mirrors
        if mirrors is not None:
            mirrors.make_way(len(datum.payload))
        self.inventory.add(datum)
        if self.notes is not None:
            self.notes.forget(datum.id)
        self.stirred = True
        if mirrors is not None:
            mirrors.took(datum.id)
        self.observer.gained(datum)

    def deliver(self, datum: Datum) -> None:
        """A datum has arrived: at a base that is a sink."""
        index = self.index
        assert index is not None
        self.store.put(datum)
        if index.is_lost(datum.id):
            self.store.found(datum.id)
        index.add(datum.id)
        if self.receipts is not None:
            self.receipts.arrived(datum.id)
        self.observer.delivered(datum)

    def drop(self, id: DatumId, fate: Fate) -> None:
        """Let go of a datum in custody, or of a spare."""
        mirrors = self.mirrors
        if mirrors is not None and id not in self.inventory:
            mirrors.drop(id, fate)
            return
        self.custody.cancel(id)
        self.transfers.cancel(id)
        noted = fate
        if fate in (Fate.CORRUPTED, Fate.EXPIRED):
            self.custody.forget(id)
            if mirrors is not None and fate is Fate.CORRUPTED and mirrors.repair(id):
                # Another node has been asked to take the datum back: only the copy is lost.
                noted = Fate.PASSED_ON
                if self.notes is not None:
                    self.notes.suspect(id, fate)
            else:
                self.store.count(fate.value)
        if mirrors is not None:
            mirrors.left(id)
        if self.replica is not None:
            self.replica.forget(id, fate)
        self.inventory.remove(id, noted)
        self.observer.dropped(id, fate)
        if self.notes is not None and noted in _BEYOND_REPAIR:
            self.notes.make(id, noted)

    def beyond_repair(self, id: DatumId, fate: Fate) -> None:
        """A datum whose copy here is gone already cannot be had from its backer either: it is lost."""
        self.store.count(fate.value)
        if self.notes is None:
            self.store.lose(id, fate)
        else:
            self.notes.make(id, fate)

    # -- receipts and loss notes ---------------------------------------------------------------------------------------

    def heed(self, changed: set[Pair]) -> None:
        """Receipts told something new of these (origin, epoch) pairs."""
        receipts, mirrors, notes = self.receipts, self.mirrors, self.notes
        if receipts is None or self.sink:
            return
        inventory = self.inventory
        for id in [id for id in inventory.everything() if id[:2] in changed]:
            if id in receipts:
                self.drop(id, Fate.DELIVERED)
            elif mirrors is not None and receipts.told_lost(id) and self.load(id) is not None:
                # Whoever had custody thought it the last copy.
                mirrors.rescue(id)
        if notes is not None:
            for id in [id for id in notes.waiting if id[:2] in changed and (id in receipts or receipts.told_lost(id))]:
                notes.forget(id)

    def take_note(self, id: DatumId, fate: Fate) -> bool:
        """A neighbour hands on the note that a datum is lost. False: there is no room for it."""
        if id in self.archive:
            return True
        if self.index is not None:
            if self.index.lose(id):
                self.store.lose(id, fate)
                if self.receipts is not None:
                    self.receipts.lost(id)
                return True
            return self.index.is_lost(id)
        if self.inventory.holds(id) and self.load(id) is not None:
            # It is not: a good copy is here.
            if self.mirrors is not None:
                self.mirrors.rescue(id)
            return True
        if self.receipts is not None and self.receipts.told_lost(id):
            return True
        return self.notes is not None and self.notes.take(id, fate)

    # -- care of what is held ------------------------------------------------------------------------------------------

    def load(self, id: DatumId) -> Datum | None:
        """A held datum (or spare) as it may be sent. None: its bytes are corrupt, and it has been dropped."""
        datum = self.store.get(id)
        if datum is not None and datum.intact:
            return datum
        self.drop(id, Fate.CORRUPTED)
        return None

    def scrub(self) -> None:
        """Verify checksums of what is held, spares too, `scrub_items` of them, going round."""
        inventory = self.inventory
        count = len(inventory) + inventory.spares
        if not count:
            return
        limit = self.settings.scrub_items
        if limit is None or limit >= count:
            ids = list(inventory.everything())
        else:
            if self._scrub_at >= count:
                self._scrub_at = 0
            ids = inventory.oldest(self._scrub_at, limit)
            self._scrub_at += limit
        get = self.store.get
        for id in ids:
            datum = get(id)
            if datum is None or not datum.intact:
                self.drop(id, Fate.CORRUPTED)

    def expire(self, before: float) -> None:
        inventory = self.inventory
        for id in [id for id in inventory.everything() if inventory.created(id) < before]:
            self.drop(id, Fate.EXPIRED)
