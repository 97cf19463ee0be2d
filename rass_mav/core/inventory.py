"""What a node holds: metadata in memory, in the order of eviction; the bytes lie in the store."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from itertools import islice

from .datum import Datum, DatumId, Fate
from .store import Store, StoredInfo


class Inventory:
    """The data in a node's custody, least recently used first (the paper's LRU eviction).

    Bounded by items and by bytes of payload; None: no bound of that kind.
    """

    __slots__ = ("_bytes", "_items", "capacity_bytes", "capacity_items", "reserved", "store")

    def __init__(
        self, store: Store, *, capacity_items: int | None = None, capacity_bytes: int | None = None, load: bool = True
    ) -> None:
        """`load`: take over what the store holds from an earlier life."""
        self.store = store
        self.capacity_items = capacity_items
        self.capacity_bytes = capacity_bytes
        self._items: OrderedDict[DatumId, StoredInfo] = OrderedDict()
        self._bytes = 0
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
        """Bytes of payload held."""
        return self._bytes

    def free(self) -> int:
        """Items that can still be taken, 0..65535 (65535: no bound)."""
        if self.capacity_bytes is not None and self._bytes >= self.capacity_bytes:
            return 0
        if self.capacity_items is None:
            return 0xFFFF
        return min(max(self.capacity_items - len(self._items) - self.reserved, 0), 0xFFFE)

    def room_for(self, size: int) -> bool:
        """Whether a datum of `size` bytes of payload fits."""
        if self.capacity_bytes is not None and self._bytes + size > self.capacity_bytes:
            return False
        return self.capacity_items is None or len(self._items) + self.reserved < self.capacity_items

    def room_to_grow(self, growth: int) -> bool:
        """Whether a held datum may be replaced by one that is `growth` bytes longer."""
        return self.capacity_bytes is None or self._bytes + growth <= self.capacity_bytes

    def info(self, id: DatumId) -> StoredInfo:
        """What is known of a held datum; KeyError if it is not held."""
        return self._items[id]

    def add(self, datum: Datum) -> None:
        """Store a datum as the most recently used one. Raises `StoreFullError` over the store's quota."""
        self.store.put(datum)
        id = datum.id
        old = self._items.pop(id, None)
        if old is not None:
            self._bytes -= old.size
        size = len(datum.payload)
        self._items[id] = StoredInfo(id, datum.kind, datum.created, datum.hops, datum.crc, size)
        self._bytes += size

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Let go of a held datum; KeyError if it is not held."""
        self._bytes -= self._items.pop(id).size
        self.store.remove(id, fate)

    def touch(self, id: DatumId) -> None:
        """A held datum was used: it becomes the last to be evicted."""
        self._items.move_to_end(id)

    def oldest(self, start: int, count: int) -> list[DatumId]:
        """`count` ids from position `start` in the order of eviction (for a scrub that goes round)."""
        return list(islice(self._items, start, start + count))
