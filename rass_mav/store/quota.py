"""How much a store may hold, and what a datum takes."""

from __future__ import annotations

from rass_mav.errors import StoreFullError

#: Bytes that a stored datum takes besides its payload: its row and its entry in the index, about 70 bytes in a SQLite
#: file, rounded up for pages that are not quite full.
ROW_OVERHEAD = 96
#: Payloads of this size, bytes, and larger ones lie beside the database. Smaller ones do not pay for a sync of
#: their own.
BESIDE_BYTES = 4096
#: Larger ones than any node creates do not, bytes: a size that a damaged row claims must not fill the memory.
MOST_BESIDE_BYTES = 2 << 20
#: What a store keeps at most of payloads that have not come whole, bytes: each counts with its whole size. The quota
#: does not count them.
MOST_PARTIAL_BYTES = 8 << 20
#: There each begins at a multiple of this, bytes: what a disk writes as a whole, or not at all.
SECTOR_BYTES = 512


def lies_beside(size: int) -> bool:
    """Whether a payload of `size` bytes lies beside the database."""
    return BESIDE_BYTES <= size <= MOST_BESIDE_BYTES


def sectors_of(size: int) -> int:
    """How many sectors `size` bytes take."""
    return -(-size // SECTOR_BYTES)


def cost(size: int) -> int:
    """The bytes that a datum takes, with `size` bytes of payload."""
    return ROW_OVERHEAD + (sectors_of(size) * SECTOR_BYTES if lies_beside(size) else size)


def charge(used: int, freed: int, size: int, quota: int | None) -> int:
    """Bytes in use after a datum of `size` bytes of payload is stored in place of `freed` bytes.

    `used` and `freed` are sums of `cost`, and so is the result. Raises `StoreFullError` when the result would exceed
    `quota` (None: no bound).
    """
    total = used - freed + cost(size)
    if quota is not None and total > quota:
        raise StoreFullError(f"quota of {quota} bytes: {used} in use, {cost(size)} more do not fit")
    return total
