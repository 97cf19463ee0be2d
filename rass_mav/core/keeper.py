"""What a node holds and answers for: taking data in, verifying them, letting go of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .archive import MAX_ORIGINS, Archive
from .custody import Custody
from .datum import Datum, DatumId, Fate
from .inventory import Inventory
from .observer import Observer
from .settings import NodeSettings
from .store import Store

if TYPE_CHECKING:
    import random

    from .replication import Replica
    from .transfers import Transfers


class Keeper:
    """The keeping half of a node. `Node` adds what is said to neighbours and Alg. 1."""

    __slots__ = (
        "_scrub_at",
        "archive",
        "custody",
        "inventory",
        "observer",
        "refused",
        "replica",
        "settings",
        "sink",
        "store",
        "transfers",
    )

    replica: Replica | None
    transfers: Transfers

    def __init__(
        self, settings: NodeSettings, store: Store, rng: random.Random, observer: Observer | None, *, sink: bool
    ) -> None:
        """`sink`: what comes here has arrived for good."""
        self.settings = settings
        self.store = store
        self.observer = observer or Observer()
        self.sink = sink
        """Whether what comes here has arrived for good."""
        self.archive = Archive(store.ids() if sink else (), max_origins=None if sink else MAX_ORIGINS)
        """What has arrived at a base: complete at the base itself, elsewhere as receipts told."""
        self.inventory = Inventory(
            store, capacity_items=settings.capacity_items, capacity_bytes=settings.capacity_bytes, load=not sink
        )
        self.custody = Custody(rng)
        self.refused = 0
        """Hand-overs refused for want of room."""
        self._scrub_at = 0

    def take_custody(self, giver: int, number: int, datum: Datum) -> bool:
        """Accept a datum that arrived whole and intact. False: no room, the giver keeps it."""
        id = datum.id
        if self.has_custody(giver, number, id, datum.crc):
            return True
        size = len(datum.payload)
        if id in self.inventory or not (self.may_accept(size) or self.make_room(size)):
            self.refused += 1
            if number == 0:
                self.observer.declined(id)
            return False
        if self.sink:
            self.deliver(datum.arrived())
        else:
            self.hold(datum.arrived())
        if number:
            self.custody.accept(giver, number, id)
        return True

    def has_custody(self, giver: int, number: int, id: DatumId, crc: int) -> bool:
        """Whether a datum on offer needs no taking: it has arrived, or is here, or this offer was taken.

        False with `id` still in the inventory: what is held under this id is another datum, so the offer is refused.
        """
        if id in self.archive:
            return True
        if id not in self.inventory:
            return bool(number) and self.custody.has_accepted(giver, number, id)
        # The giver will delete its copy on our word, so ours must be good at this moment; a bad one is dropped here.
        held = self.load(id)
        if held is None or held.crc != crc:
            return False
        if number and self.custody.has_accepted(giver, number, id):
            return True
        # The datum has come round: whatever we offered of it, nobody's answer may delete it any more.
        self.custody.cancel(id)
        self.transfers.cancel(id)
        if number:
            self.custody.accept(giver, number, id)
        return True

    def room_for(self, size: int) -> bool:
        """Whether a new datum of `size` bytes of payload can be stored."""
        return (self.sink or self.inventory.room_for(size)) and self.store.room_for(size)

    def may_accept(self, size: int) -> bool:
        """Whether custody of a datum of `size` bytes of payload can be taken over."""
        return self.store.accepting and self.room_for(size)

    def make_room(self, size: int) -> bool:
        """With `drop_oldest`: let go of the least recently used data until `size` bytes of payload fit."""
        if not self.settings.drop_oldest or self.sink or self.replica is not None or not self.store.accepting:
            return False
        while not self.room_for(size):
            oldest = next(iter(self.inventory), None)
            if oldest is None:
                return False
            self.drop(oldest, Fate.OVERFLOW)
        return True

    def hold(self, datum: Datum) -> None:
        """Store a datum in own custody."""
        self.inventory.add(datum)
        self.observer.gained(datum)

    def deliver(self, datum: Datum) -> None:
        """A datum has arrived: at a base that is a sink."""
        self.store.put(datum)
        self.archive.add(datum.id)
        self.observer.delivered(datum)

    def drop(self, id: DatumId, fate: Fate) -> None:
        """Let go of a held datum."""
        self.custody.cancel(id)
        self.transfers.cancel(id)
        if fate in (Fate.CORRUPTED, Fate.EXPIRED):
            self.custody.forget(id)
            self.store.count(fate.value)
        if self.replica is not None:
            self.replica.forget(id, fate)
        self.inventory.remove(id, fate)
        self.observer.dropped(id, fate)

    # -- care of what is held ------------------------------------------------------------------------------------------

    def load(self, id: DatumId) -> Datum | None:
        """A held datum as it may be sent. None: its bytes are corrupt, and it has been dropped."""
        datum = self.store.get(id)
        if datum is not None and datum.intact:
            return datum
        self.drop(id, Fate.CORRUPTED)
        return None

    def scrub(self) -> None:
        """Verify checksums of what is held, `scrub_items` of them, going round."""
        inventory = self.inventory
        count = len(inventory)
        if not count:
            return
        limit = self.settings.scrub_items
        if limit is None or limit >= count:
            ids = list(inventory)
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
        for id in [id for id in self.inventory if self.inventory.info(id).created < before]:
            self.drop(id, Fate.EXPIRED)
