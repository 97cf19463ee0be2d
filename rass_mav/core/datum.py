"""The datum: one item of user data, its identity and its checksum."""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple
from zlib import crc32

from rass_mav.core.terms import Terms, terms_of

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
