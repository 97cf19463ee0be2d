"""What a node holds: metadata in memory, in the order of eviction; the bytes lie in the store.

Custody comes first. Spare copies (`mirrors`) lie in the room that custody leaves, and count as free: whoever adds a
datum in custody first lets go of spares, `crowded` and `yielding` tell when and which.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from itertools import chain, islice

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.store import Store, StoredInfo


class Inventory:
    """The data in a node's custody, least recently used first (the paper's LRU eviction), and its spare copies.

    Bounded by items and by bytes of payload; None: no bound of that kind. Length, iteration and `in` mean custody.
    """

    __slots__ = (
        "_active",
        "_bytes",
        "_items",
        "_onward",
        "_spare_bytes",
        "capacity_bytes",
        "capacity_items",
        "own_bytes",
        "own_items",
        "reserved",
        "store",
    )

    def __init__(
        self,
        store: Store,
        *,
        capacity_items: int | None = None,
        capacity_bytes: int | None = None,
        own_share: float = 0.0,
        load: bool = True,
    ) -> None:
        """`own_share`, 0..1: of what is bounded, that part is kept for the node's own measurements.

        `load`: take over what the store holds from an earlier life. All of it counts as custody: nobody remembers what
        was a spare, and a copy too many is allowed."""
        self.store = store
        self.capacity_items = capacity_items
        self.capacity_bytes = capacity_bytes
        self.own_items = int(own_share * (capacity_items or 0))
        """Places that others' data leave free."""
        self.own_bytes = int(own_share * (capacity_bytes or 0))
        self._items: OrderedDict[DatumId, StoredInfo] = OrderedDict()
        self._active: dict[DatumId, StoredInfo] = {}
        self._onward: dict[DatumId, StoredInfo] = {}
        self._bytes = 0
        self._spare_bytes = 0
        self.reserved = 0
        """Places kept for items that are to come back."""
        for info in store.held() if load else ():
            self._items[info.id] = info
            self._bytes += info.size

    def __len__(self) -> int:
        return len(self._items)

    def __contains__(self, id: object) -> bool:
        return id in self._items

    def __iter__(self) -> Iterator[DatumId]:
        return iter(self._items)

    @property
    def bytes(self) -> int:
        """Bytes of payload in custody."""
        return self._bytes

    def free(self) -> int:
        """Items of others that can be taken into custody, 0..65535 (65535: no bound). Spares count as free."""
        if self.capacity_bytes is not None and self._bytes >= self.capacity_bytes - self.own_bytes:
            return 0
        if self.capacity_items is None:
            return 0xFFFF
        return min(max(self.capacity_items - self.own_items - len(self._items) - self.reserved, 0), 0xFFFE)

    def room_for(self, size: int, *, own: bool) -> bool:
        """Whether a datum of `size` bytes of payload fits into custody. `own`: a measurement of this node."""
        if self.capacity_bytes is not None:
            limit = self.capacity_bytes if own else self.capacity_bytes - self.own_bytes
            if self._bytes + size > limit:
                return False
        if self.capacity_items is None:
            return True
        limit = self.capacity_items if own else self.capacity_items - self.own_items
        return len(self._items) + self.reserved < limit

    def room_to_grow(self, growth: int) -> bool:
        """Whether a held datum may be replaced by one that is `growth` bytes longer."""
        return self.capacity_bytes is None or self._bytes + growth <= self.capacity_bytes

    def info(self, id: DatumId) -> StoredInfo:
        """What is known of a datum in custody; KeyError if it is not."""
        return self._items[id]

    def add(self, datum: Datum) -> None:
        """Take a datum into custody as the most recently used one. Raises `StoreFullError` over the store's quota."""
        self.store.put(datum)
        id = datum.id
        old = self._items.pop(id, None)
        if old is not None:
            self._bytes -= old.size
        size = len(datum.payload)
        self._items[id] = StoredInfo(id, datum.kind, datum.created, datum.hops, datum.crc, size)
        self._bytes += size

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Let go of a datum in custody, or of a spare; KeyError if there is neither."""
        info = self._items.pop(id, None)
        if info is not None:
            self._bytes -= info.size
        else:
            info = self._active.pop(id, None) or self._onward.pop(id)
            self._spare_bytes -= info.size
        self.store.remove(id, fate)

    def touch(self, id: DatumId) -> None:
        """A datum in custody was used: it becomes the last to be evicted."""
        self._items.move_to_end(id)

    # -- spares --------------------------------------------------------------------------------------------------------

    @property
    def spares(self) -> int:
        """How many spares there are."""
        return len(self._active) + len(self._onward)

    @property
    def spare_bytes(self) -> int:
        """Bytes of payload of the spares."""
        return self._spare_bytes

    def holds(self, id: DatumId) -> bool:
        """Whether there is a copy here, in custody or spare."""
        return id in self._items or id in self._active or id in self._onward

    def is_active(self, id: DatumId) -> bool:
        """Whether this spare is one that somebody counts on."""
        return id in self._active

    def everything(self) -> Iterator[DatumId]:
        """All copies: those in custody, then the spares."""
        return chain(self._items, self._active, self._onward)

    def created(self, id: DatumId) -> float:
        """When a held datum, or a spare, was created, seconds; KeyError if there is neither."""
        return (self._items.get(id) or self._active.get(id) or self._onward[id]).created

    def oldest(self, start: int, count: int) -> list[DatumId]:
        """`count` copies from position `start` of `everything` (for a scrub that goes round)."""
        return list(islice(self.everything(), start, start + count))

    def demote(self, id: DatumId) -> None:
        """Custody has passed on: the copy here becomes an active spare."""
        info = self._items.pop(id)
        self._active[id] = info
        self._bytes -= info.size
        self._spare_bytes += info.size

    def pass_by(self, id: DatumId) -> None:
        """An active spare is not counted on any more: it yields before the active ones."""
        self._onward[id] = self._active.pop(id)

    def activate(self, id: DatumId) -> None:
        """An onward spare is counted on again."""
        self._active[id] = self._onward.pop(id)

    def promote(self, id: DatumId) -> None:
        """A spare comes into custody (again), as the most recently used one."""
        info = self._active.pop(id, None) or self._onward.pop(id)
        self._items[id] = info
        self._bytes += info.size
        self._spare_bytes -= info.size

    def add_spare(self, datum: Datum) -> None:
        """Store a datum as an active spare. Raises `StoreFullError` over the store's quota."""
        self.store.put(datum)
        size = len(datum.payload)
        self._active[datum.id] = StoredInfo(datum.id, datum.kind, datum.created, datum.hops, datum.crc, size)
        self._spare_bytes += size

    def crowded(self, size: int) -> bool:
        """Whether a datum of `size` bytes of payload does not fit beside all that is here, spares included."""
        if (
            self.capacity_items is not None
            and len(self._items) + len(self._active) + len(self._onward) + self.reserved >= self.capacity_items
        ):
            return True
        if self.capacity_bytes is not None and self._bytes + self._spare_bytes + size > self.capacity_bytes:
            return True
        return not self.store.room_for(size)

    def yielding(self, *, active: bool = True) -> DatumId | None:
        """The spare that goes first: the oldest onward one; if there is none, and `active`, the oldest active one."""
        id = next(iter(self._onward), None)
        return next(iter(self._active), None) if id is None and active else id
