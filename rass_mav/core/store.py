"""What the algorithm expects of a store. `rass_mav.store` implements it in memory and in SQLite."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple, Protocol

from rass_mav.core.datum import USUAL, Datum, DatumId, Fate, Terms, terms_of

#: How many second contents a store keeps apart in all, and under one id.
MAX_APART = 4096
MAX_APART_OF_ONE = 256
#: How many data of which only a part has come a store keeps.
MAX_PARTIALS = 8


class Loss(NamedTuple):
    """A row of the table of losses, without the id."""

    fate: Fate
    proof: bytes = b""
    """Of the deletion report that came here; empty: none."""


class StoredInfo(NamedTuple):
    """What the node keeps in memory about a datum whose bytes are in the store."""

    id: DatumId
    kind: int
    created: float
    hops: int
    crc: int
    size: int
    """Bytes of payload."""
    at_least: bool = False
    """As in `Datum`."""
    terms: Terms = USUAL
    """The same."""


def info_of(datum: Datum) -> StoredInfo:
    """The info of a datum whose bytes are at hand."""
    id, kind, created, hops, crc, payload, at_least = datum
    return StoredInfo(id, kind, created, hops, crc, len(payload), at_least, terms_of(kind, payload))


class PartialKey(NamedTuple):
    """What is coming in, by its content: it does not matter who brings it."""

    id: DatumId
    crc: int
    """Of the whole datum."""
    size: int
    """Bytes of the whole payload."""


def key_of(datum: Datum) -> PartialKey:
    """The key under which pieces of a datum were kept before all of it was there."""
    return PartialKey(datum.id, datum.crc, len(datum.payload))


class Store(Protocol):
    """Durable storage of one node. Not thread-safe, except for `write`.

    Changes are buffered: they are visible to `get` at once, and durable after a commit. The driver commits, THEN sends:
    `take` returns what has changed since the last `take`, and `write` makes it durable in one transaction (one fsync
    for a whole turn: group commit). `write` may run on another thread while this one continues to buffer; at most one
    `write` is in flight.
    """

    @property
    def life(self) -> int:
        """32 bits, drawn when the store was created: another life has none of the data of this one."""

    @property
    def epoch(self) -> int:
        """The epoch of ids assigned now, 32 bits: a new one is drawn whenever numbers may have been lost."""

    @property
    def assigned(self) -> int:
        """How many numbers of this epoch have been assigned: the one that `next_sequence` returns next."""

    @property
    def accepting(self) -> bool:
        """False while the disk fails: custody is then refused, but own new data are still buffered."""

    @property
    def unwritten(self) -> bool:
        """Whether a datum, a loss or a meta number is not on disk yet: messages about it have to wait. Cheap."""

    @property
    def quota_bytes(self) -> int | None:
        """What `used_bytes` may be now at most; None: there is no bound. On a disk it changes with what is free there.
        Cheap."""

    @property
    def used_bytes(self) -> int:
        """What the quota bounds: bytes of payload and an overhead for each datum. Cheap where there is a quota."""

    def next_sequence(self) -> int:
        """Claim the next sequence number of this epoch; durable with the next commit. From 0, without gaps."""

    def room_for(self, size: int) -> bool:
        """Whether a datum of `size` bytes of payload fits the quota. Cheap."""

    def put(self, datum: Datum) -> None:
        """Store a datum, or replace the one with its id. Raises `StoreFullError` over quota, and then changes
        nothing."""

    def keep_apart(self, datum: Datum) -> bool:
        """Store a second content under the id of a stored datum, beside it. Also true if this content is kept already.
        False: there is no space; at most `MAX_APART_OF_ONE` an id and `MAX_APART` in all are kept."""

    def apart(self) -> Iterable[StoredInfo]:
        """The second contents; their CRC distinguishes them from the stored ones."""

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        """One second content, or None."""

    def get(self, id: DatumId) -> Datum | None:
        """The datum as its bytes are now (its checksum is not verified here), or None."""

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        """The ids, among some stored data, whose bytes no longer match their checksum, in the same order."""

    def durable(self, id: DatumId) -> bool:
        """Whether a stored datum is on disk, so that it would be there after a crash."""

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum. `CORRUPTED` and `EXPIRED` are written to the table of losses. Unknown ids are ignored."""

    def lose(self, id: DatumId, fate: Fate, proof: bytes = b"") -> None:
        """Record in the table of losses a loss elsewhere (a deletion report that came here). `proof`: of that note."""

    def found(self, id: DatumId) -> None:
        """Remove an entry from the table of losses: the datum turned up, or the loss has been handed over. Need not be
        durable soon. Unknown ids are ignored."""

    def keep_partial(self, key: PartialKey, offset: int, data: bytes) -> None:
        """Keep a piece of a payload of which the rest has not come. The store may forget it at any time; it does so
        when the datum is stored, and when there are more than `MAX_PARTIALS`. Never durable soon, and never an error:
        no promise rests on it."""

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        """The pieces that were kept and are there, each with its offset: in no order, and they may overlap."""

    def forget_partial(self, key: PartialKey) -> None:
        """The pieces are of no use. Unknown keys are ignored."""

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

    def proofs(self) -> dict[DatumId, bytes]:
        """The proofs in the table of losses, where there are any."""

    def get_meta(self, key: str) -> int | None:
        """A small number that survives restarts (for example a base's announcement number)."""

    def set_meta(self, key: str, value: int) -> None:
        """Set such a number; durable with the next commit."""

    def meta_durable(self, key: str) -> bool:
        """Whether such a number is on disk with its latest value."""

    def take(self, *, force: bool = False) -> object | None:
        """What has to be written now, or None. Removals alone wait for other changes (they need no sync), unless
        `force`."""

    def roll_back(self) -> None:
        """Forget what has changed since the last `take`, assigned numbers included: the state is as after a restart, if
        the result of that `take` reached the disk. It stays, whether its write is under way or has failed."""

    def write(self, batch: object) -> None:
        """Make a batch durable. Blocking; may be called on another thread, one call at a time."""
