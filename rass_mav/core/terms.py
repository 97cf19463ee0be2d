"""The terms of a datum: how urgent it is, and how long it is of use.

They are open, at the beginning of its payload, also where the rest is sealed: every node on its route keeps to them.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

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
    """What the origin says of a datum to all who carry it."""

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
