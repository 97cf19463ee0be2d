"""The datum: one item of user data, its identity, its checksum, its terms, and what can become of it."""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple
from zlib import crc32

from rass_mav.errors import DatumError

#: The bit of a kind that says that the payload begins with terms.
TERMS = 0x40
#: How many bytes they have.
TERMS_SIZE = 4
#: Priorities are those of JMS (Jakarta Messaging 3.1, section 3.4.9): 0 may wait, 9 is most urgent.
USUAL_PRIORITY = 4
MOST_PRIORITY = 9
#: The longest lifetime, seconds: 194 days.
MOST_TTL_S = (1 << 24) - 1

# The priority, and above it the lifetime.
_TERMS = struct.Struct("<I")


class Terms(NamedTuple):
    """What the origin says of a datum to all who carry it: how urgent it is, and how long it is of use.

    They are open, at the beginning of its payload, also where the rest is sealed: all who carry it keep to
    them.
    """

    priority: int = USUAL_PRIORITY
    """0..`MOST_PRIORITY`; higher ones leave a node first."""
    ttl_s: int | None = None
    """The datum expires when it is older than this, seconds, 1..`MOST_TTL_S`; None: never."""

    def pack(self) -> bytes:
        """As they travel; empty for the usual terms. Raises `DatumError` if they are out of range."""
        priority, ttl_s = self
        if not 0 <= priority <= MOST_PRIORITY:
            raise DatumError(f"a priority is 0 to {MOST_PRIORITY}, got {priority}")
        if ttl_s is not None and not 1 <= ttl_s <= MOST_TTL_S:
            raise DatumError(f"a lifetime is 1 to {MOST_TTL_S} s, got {ttl_s}")
        return b"" if self == USUAL else _TERMS.pack(priority | (ttl_s or 0) << 8)


#: Of a datum that has none.
USUAL = Terms()


def terms_of(kind: int, head: bytes) -> Terms:
    """The terms of a datum. `head`: the beginning of its payload; one that is cut off says nothing.

    Priorities of later versions, above `MOST_PRIORITY`, count as this one.
    """
    if not kind & TERMS or len(head) < TERMS_SIZE:
        return USUAL
    (packed,) = _TERMS.unpack_from(head)
    return Terms(min(packed & 0xFF, MOST_PRIORITY), packed >> 8 or None)


def parted(kind: int, payload: bytes) -> tuple[bytes, bytes]:
    """The terms of a datum as they travelled, empty if it has none; and the rest of its payload."""
    size = TERMS_SIZE if kind & TERMS else 0
    return payload[:size], payload[size:]


_pack_head = struct.Struct("<HIIB").pack

#: Largest datum that may be created, in bytes of payload.
MAX_PAYLOAD = 1 << 20


class DatumId(NamedTuple):
    """The permanent, global name of a datum."""

    origin: int
    """Node id of the node that created it, 0..65534."""
    epoch: int
    """Epoch of the origin's store (32 bits): a new one is drawn when a store is created, so ids are never used
    twice."""
    sequence: int
    """Number within the epoch, from 0 without gaps (32 bits)."""

    def __str__(self) -> str:
        return f"{self.origin}-{self.epoch:08x}-{self.sequence}"


class Kind(enum.IntEnum):
    """What the payload of a datum holds."""

    BYTES = 0
    """Opaque bytes, for example a line that an operator entered."""
    MEASUREMENT = 1
    """A position and a reading, see `rass_mav.wire.measurement`."""
    FILE = 2
    """A small named file: one byte with the length of its name, the name in UTF-8, the content."""
    STATUS = 3
    """What a node says about itself, see `rass_mav.wire.nodestatus`."""
    MANIFEST = 4
    """What a larger file is, see `rass_mav.wire.file`. Its contents are in data of the next kinds."""
    PART = 5
    """A part of a file."""
    SHARE = 6
    """One of the data of a file of which some may be lost. It needs no replica, and goes another way than others."""


#: Kinds of data that are parts of a file.
PARTS = (Kind.PART, Kind.SHARE)


def is_share(kind: int) -> bool:
    """Whether a datum is a share, sealed or not."""
    return kind & 63 == Kind.SHARE


class Fate(enum.Enum):
    """Why a datum, or a copy of it, is no longer held."""

    DELIVERED = "delivered"
    """A base has it (seen at that base), or a receipt says so."""
    PASSED_ON = "passed_on"
    """Custody went to a neighbour, which sent COMMITTED."""
    CORRUPTED = "corrupted"
    """Its checksum failed."""
    OVERFLOW = "overflow"
    """There was no space."""
    EXPIRED = "expired"
    """Its lifetime ran out."""
    DIED = "died"
    """All copies were on drones that died for good or were wiped."""
    VANISHED = "vanished"
    """Sent without custody and never received."""
    UNFOUNDED = "unfounded"
    """In custody, and deleted because of a message that no base and no other node can confirm."""
    UNKNOWN = "unknown"
    """About a closed epoch: numbers from one on may have been assigned, but no node knows. About no single datum."""
    DAMAGED = "damaged"
    """A node's store was damaged, and data in it may be lost. About no single datum."""


#: What a store records in its table of losses when it removes a datum.
RECORDED = (Fate.CORRUPTED, Fate.EXPIRED)
#: Data in custody dropped for one of these reasons are gone, as far as the node knows: it reports them to the bases.
BEYOND_REPAIR = (Fate.CORRUPTED, Fate.EXPIRED, Fate.OVERFLOW)
#: Reported like a loss, but about no single datum.
STORE_FAULTS = (Fate.UNKNOWN, Fate.DAMAGED)
#: Numbers of fates in deletion reports. A number is never used for another one.
REASONS = {
    Fate.CORRUPTED: 1, Fate.EXPIRED: 2, Fate.OVERFLOW: 3, Fate.DIED: 4, Fate.VANISHED: 5, Fate.UNKNOWN: 6,
    Fate.DAMAGED: 7,
}  # fmt: skip


class Datum(NamedTuple):
    """A datum with its bytes. Immutable; a hop creates a new one with `hops` raised."""

    id: DatumId
    kind: int
    """A `Kind`, with the bits `seals.SEALED` if the payload is sealed, and `terms.TERMS` if it begins with terms; data
    of unknown kinds are carried unchanged."""
    created: float
    """When it was created, in seconds on the node's timeline. On the wire it travels as an age."""
    hops: int
    """Hand-overs so far, 0 at the origin, at most 255."""
    crc: int
    """CRC-32 of id, kind and payload, computed once at the origin and carried to the base."""
    payload: bytes
    at_least: bool = False
    """It is at least as old as `created` says: a node that had it was switched off for an unknown time."""

    @property
    def intact(self) -> bool:
        """Whether the checksum from the origin still matches."""
        (origin, epoch, sequence), kind, _, _, crc, payload, _ = self
        return crc32(payload, crc32(_pack_head(origin, epoch, sequence, kind))) == crc

    @property
    def terms(self) -> Terms:
        """How urgent it is, and how long it is of use."""
        return terms_of(self.kind, self.payload)

    def arrived(self) -> Datum:
        """The same datum, one hand-over further."""
        hops = self.hops
        return Datum(
            self.id, self.kind, self.created, hops + 1 if hops < 255 else 255, self.crc, self.payload, self.at_least
        )  # fmt: skip


def datum_crc(id: DatumId, kind: int, payload: bytes) -> int:
    """CRC-32 (IEEE 802.3) over `<HIIB` origin, epoch, sequence, kind and then the payload."""
    return crc32(payload, crc32(_pack_head(id[0], id[1], id[2], kind)))


def make_datum(id: DatumId, kind: int, created: float, payload: bytes) -> Datum:
    """A new datum at its origin, with its checksum."""
    return Datum(id, kind, created, 0, datum_crc(id, kind, payload), payload)
