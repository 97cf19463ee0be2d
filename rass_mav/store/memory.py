"""A store without a disk: for the mock swarm, where a thousand nodes live in one process, and for tests."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from rass_mav.core.datum import RECORDED, Datum, DatumId, Fate
from rass_mav.core.store import MAX_APART, MAX_APART_OF_ONE, MAX_PARTIALS, Loss, PartialKey, StoredInfo, info_of, key_of
from rass_mav.errors import StoreFullError

from .quota import MOST_PARTIAL_BYTES, charge, cost, lies_beside


def flipped(datum: Datum, bit: int) -> Datum:
    """A datum with one bit of its payload flipped and its checksum unchanged. IndexError: it has no such bit.

    `bit`: 0 .. 8 * size - 1; bit 0 is the least significant bit of the first byte.
    """
    payload = bytearray(datum.payload)
    if not 0 <= bit < 8 * len(payload):
        raise IndexError(f"bit {bit} of a payload of {len(payload)} bytes")
    payload[bit >> 3] ^= 1 << (bit & 7)
    return datum._replace(payload=bytes(payload))


class MemoryStore:
    """A `Store` in a dict. Data are there permanently: there is nothing to commit, so `take` returns None.

    The data survive a restart of the node for as long as the object is kept.
    """

    __slots__ = (
        "_apart", "_counters", "_data", "_flipped", "_losses", "_meta", "_partials", "_sequence", "_used", "epoch",
        "life", "quota_bytes",
    )  # fmt: skip
    accepting = True
    """Always."""
    unwritten = False
    """Never."""

    def __init__(self, epoch: int, *, quota_bytes: int | None = None) -> None:
        """`epoch`: 32 bits. `quota_bytes`: bound of `used_bytes`; None: no bound."""
        if not 0 <= epoch < 1 << 32:
            raise ValueError(f"an epoch has 32 bits, got {epoch}")
        self.life = self.epoch = epoch
        """32 bits, given when the store was created."""
        self._sequence = 0
        # A dict keeps the order of insertion: the order of arrival, as long as a replaced datum is moved to the end.
        self._data: dict[DatumId, Datum] = {}
        self._apart: dict[tuple[DatumId, int], Datum] = {}
        self._flipped: set[DatumId] = set()
        """Data that may not match their checksum: only `flip_bit` changes bytes in memory."""
        self._losses: dict[DatumId, Loss] = {}
        self._counters: dict[str, int] = {}
        self._meta: dict[str, int] = {}
        self._partials: dict[PartialKey, dict[int, bytes]] = {}
        """Pieces by their offset. What grew last is last."""
        self.quota_bytes = quota_bytes
        """Bound of `used_bytes`; None: no bound."""
        self._used = 0  # counted only under a quota: without one, not every put has to ask

    @property
    def used_bytes(self) -> int:
        """The sum of `cost`, as on a disk: what the quota bounds."""
        if self.quota_bytes is not None:
            return self._used
        data = (*self._data.values(), *self._apart.values())
        return sum(cost(len(datum.payload)) for datum in data)

    @property
    def assigned(self) -> int:
        """How many numbers of this epoch have been assigned."""
        return self._sequence

    def next_sequence(self) -> int:
        """Claim the next sequence number of this epoch."""
        sequence = self._sequence
        if sequence == 1 << 32:
            raise StoreFullError("all sequence numbers of this epoch are in use")
        self._sequence = sequence + 1
        return sequence

    def room_for(self, size: int) -> bool:
        """Whether a datum of `size` bytes of payload fits the quota."""
        return self.quota_bytes is None or self._used + cost(size) <= self.quota_bytes

    def put(self, datum: Datum) -> None:
        """Store a datum as the latest, or replace the one with its id. `StoreFullError` over the quota."""
        id = datum[0]
        data = self._data
        if self.quota_bytes is not None:
            old = data.get(id)
            freed = 0 if old is None else cost(len(old.payload))
            self._used = charge(self._used, freed, len(datum.payload), self.quota_bytes)
        if id in data:
            del data[id]
            self._flipped.discard(id)
        data[id] = datum
        if self._partials:
            self._partials.pop(key_of(datum), None)

    def keep_apart(self, datum: Datum) -> bool:
        """Keep a second content of an id beside the stored one. True: it is kept, or was. False: there is no space."""
        id, size = datum.id, len(datum.payload)
        stored = self._data.get(id)
        if (id, datum.crc) in self._apart or (stored is not None and stored.crc == datum.crc):
            return True
        of_this_id = sum(other == id for other, _ in self._apart)
        if len(self._apart) >= MAX_APART or of_this_id >= MAX_APART_OF_ONE or not self.room_for(size):
            return False
        if self.quota_bytes is not None:
            self._used += cost(size)
        self._apart[id, datum.crc] = datum
        return True

    def apart(self) -> Iterable[StoredInfo]:
        """The second contents: a list, safe to keep while the store changes."""
        return list(map(info_of, self._apart.values()))

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        """One second content, or None."""
        return self._apart.get((id, crc))

    def get(self, id: DatumId) -> Datum | None:
        """The datum as its bytes are now, or None."""
        return self._data.get(id)

    def data(self) -> Collection[Datum]:
        """All data as their bytes are now, the oldest first."""
        return self._data.values()

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        """The ids, among some stored data, whose bytes no longer match their checksum, in the same order."""
        flipped_ids = self._flipped
        return [id for id in ids if id in flipped_ids and not self._data[id].intact] if flipped_ids else []

    def durable(self, id: DatumId) -> bool:
        """Always: the content survives a restart of the node."""
        return True

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum; record the loss if it was corrupted or expired. Unknown ids are ignored."""
        datum = self._data.pop(id, None)
        if datum is None:
            return
        self._flipped.discard(id)
        if self.quota_bytes is not None:
            self._used -= cost(len(datum.payload))
        if fate in RECORDED:
            self._losses.setdefault(id, Loss(fate))

    def lose(self, id: DatumId, fate: Fate, proof: bytes = b"") -> None:
        """Record a loss elsewhere. The first fate recorded for an id stays."""
        self._losses.setdefault(id, Loss(fate, proof))

    def found(self, id: DatumId) -> None:
        """Remove an entry from the table of losses. Unknown ids are ignored."""
        self._losses.pop(id, None)

    def flip_bit(self, id: DatumId, bit: int) -> None:
        """Radiation: flip one bit of a stored payload and leave its checksum unchanged.

        `bit`: 0 .. 8 * size - 1; bit 0 is the least significant bit of the first byte. Raises KeyError if `id` is not
        held and IndexError for a bit that the payload does not have.
        """
        self._data[id] = flipped(self._data[id], bit)
        self._flipped.add(id)

    def keep_partial(self, key: PartialKey, offset: int, data: bytes) -> None:
        """Keep a piece of a payload of which the rest has not come."""
        if not lies_beside(key.size) or key.id in self._data:
            return
        partials = self._partials
        pieces = partials.pop(key, {})
        pieces[offset] = data
        while partials and (
            len(partials) >= MAX_PARTIALS or key.size + sum(other.size for other in partials) > MOST_PARTIAL_BYTES
        ):
            del partials[next(iter(partials))]
        partials[key] = pieces

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        """The pieces that were kept and are there."""
        return list(self._partials.get(key, {}).items())

    def forget_partial(self, key: PartialKey) -> None:
        """The pieces are of no use."""
        self._partials.pop(key, None)

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a named counter."""
        counters = self._counters
        counters[name] = counters.get(name, 0) + amount

    def counters(self) -> dict[str, int]:
        """All named counters."""
        return dict(self._counters)

    def held(self) -> Iterator[StoredInfo]:
        """What is stored, least recently stored first."""
        yield from map(info_of, list(self._data.values()))

    def note_time(self, now_ms: int) -> None:
        """Arrivals in memory have no time."""

    def mark_at_least(self) -> None:
        """Every datum that is stored now is at least as old as recorded."""
        self._data = {id: datum._replace(at_least=True) for id, datum in self._data.items()}
        self._apart = {key: datum._replace(at_least=True) for key, datum in self._apart.items()}

    def amend(self, ids: Collection[DatumId], off_s: float) -> None:
        """These data are `off_s` seconds older than recorded, and not `at_least` so old. Unknown ids are ignored."""
        for id in frozenset(ids):
            datum = self._data.get(id)
            if datum is not None:
                self._data[id] = datum._replace(created=datum.created - off_s, at_least=False)

    def ids(self) -> Iterable[DatumId]:
        """The ids of what is stored: a list, safe to keep while the store changes."""
        return list(self._data)

    def losses(self) -> Iterable[tuple[DatumId, Fate]]:
        """The table of losses: a list, safe to keep while the store changes."""
        return [(id, loss.fate) for id, loss in self._losses.items()]

    def proofs(self) -> dict[DatumId, bytes]:
        """The proofs in the table of losses, where there are any."""
        return {id: loss.proof for id, loss in self._losses.items() if loss.proof}

    def get_meta(self, key: str) -> int | None:
        """A small number that survives a restart."""
        return self._meta.get(key)

    def set_meta(self, key: str, value: int) -> None:
        """Set such a number."""
        self._meta[key] = value

    def meta_durable(self, key: str) -> bool:
        """Always: the content survives a restart of the node."""
        return True

    def take(self, *, force: bool = False) -> object | None:
        """None: there is never anything to write."""
        return None

    def roll_back(self) -> None:
        """Does nothing: data are there permanently."""

    def write(self, batch: object) -> None:
        """Never called, since `take` returns nothing; RuntimeError if it is."""
        raise RuntimeError("a MemoryStore has no batches")

    def close(self) -> None:
        """Nothing to release."""
