"""What the algorithm asks of a store. `rass_mav.store` implements it in memory and in SQLite."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple, Protocol

from rass_mav.core.datum import Datum, DatumId, Fate

#: How many second contents a store keeps apart in all, and under one id.
MAX_APART = 4096
MAX_APART_OF_ONE = 256


class StoredInfo(NamedTuple):
    """What the node keeps in memory about a datum whose bytes lie in the store."""

    id: DatumId
    kind: int
    created: float
    hops: int
    crc: int
    size: int
    """Bytes of payload."""
    at_least: bool = False
    """As in `Datum`."""


def info_of(datum: Datum) -> StoredInfo:
    """Of a datum whose bytes are at hand."""
    id, kind, created, hops, crc, payload, at_least = datum
    return StoredInfo(id, kind, created, hops, crc, len(payload), at_least)


class Store(Protocol):
    """Durable storage of one node. Not thread-safe, but for `write`.

    Changes are buffered: they are visible to `get` at once, and durable after a commit. The driver commits, THEN
    sends: `take` hands out what has changed since the last `take`, and `write` makes it durable in one transaction
    (one fsync for a whole turn: group commit). `write` may run on another thread while this one goes on buffering; at
    most one `write` is in flight.
    """

    @property
    def life(self) -> int:
        """32 bits, drawn when the store was created: another life has nothing of what this one held."""

    @property
    def epoch(self) -> int:
        """Of the ids that are given now, 32 bits: drawn anew whenever numbers may have been lost."""

    @property
    def given(self) -> int:
        """How many numbers of this epoch have been given: the one that `next_sequence` gives next."""

    @property
    def accepting(self) -> bool:
        """False while the disk fails: custody is refused then, own new data are still buffered."""

    @property
    def unwritten(self) -> bool:
        """Whether a datum, a loss or a meta number is not on disk yet: what is said of it has to wait. Cheap."""

    @property
    def used_bytes(self) -> int:
        """What the quota bounds: bytes of payload and an overhead for each datum."""

    def next_sequence(self) -> int:
        """Claim the next sequence number of this epoch; durable with the next commit. From 0, without holes."""

    def room_for(self, size: int) -> bool:
        """Whether a datum of `size` bytes of payload fits the quota. Cheap."""

    def put(self, datum: Datum) -> None:
        """Store a datum, or replace the one with its id. Raises `StoreFullError` over quota; nothing changes then."""

    def keep_apart(self, datum: Datum) -> bool:
        """Store a second content under the id of a stored datum, beside it. True also if this content is kept already.
        False: there is no room; `MAX_APART_OF_ONE` an id are kept, and `MAX_APART` in all."""

    def apart(self) -> Iterable[StoredInfo]:
        """What is kept apart; told from what is stored by its CRC."""

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        """One content that is kept apart, or None."""

    def get(self, id: DatumId) -> Datum | None:
        """The datum as its bytes are now (its checksum is not verified here), or None."""

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        """Those of some stored data whose bytes do not fit their checksum any more, in the same order."""

    def durable(self, id: DatumId) -> bool:
        """Whether a stored datum is on disk, so that it would be there after a crash."""

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum. `CORRUPTED` and `EXPIRED` are written to the table of losses. Unknown ids are ignored."""

    def lose(self, id: DatumId, fate: Fate) -> None:
        """Note a loss elsewhere (a loss note that came here) in the table of losses."""

    def found(self, id: DatumId) -> None:
        """Take an entry out of the table of losses: the datum turned up, or the loss has been told on. Need not be
        durable soon. Unknown ids are ignored."""

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a named counter that survives restarts (the node's ledger)."""

    def counters(self) -> dict[str, int]:
        """All named counters."""

    def held(self) -> Iterator[StoredInfo]:
        """What is stored, least recently stored first (the order of eviction after a restart)."""

    def ids(self) -> Iterable[DatumId]:
        """The ids of what is stored, in no particular order, without reading payloads."""

    def losses(self) -> Iterable[tuple[DatumId, Fate]]:
        """The table of losses."""

    def get_meta(self, key: str) -> int | None:
        """A small number that survives restarts (for example a base's announcement number)."""

    def set_meta(self, key: str, value: int) -> None:
        """Set such a number; durable with the next commit."""

    def meta_durable(self, key: str) -> bool:
        """Whether such a number is on disk as it was set last."""

    def take(self, *, force: bool = False) -> object | None:
        """What has to be written now, or None. Removals alone wait for company (they need no sync), unless `force`."""

    def roll_back(self) -> None:
        """Forget what has changed since the last `take`, numbers given included: all is as a restart would find it if
        what that handed out came to the disk. Whether it is on its way, or its write has failed: it stays."""

    def write(self, batch: object) -> None:
        """Make a batch durable. Blocking; may be called on another thread, one call at a time."""
