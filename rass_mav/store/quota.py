"""How much a store may hold."""

from __future__ import annotations

from rass_mav.errors import StoreFullError

#: Bytes that a stored datum takes besides its payload: its row and its entry in the index, about 70 bytes in a SQLite
#: file, rounded up for pages that are not quite full.
ROW_OVERHEAD = 96


def charge(used: int, freed: int, size: int, quota: int | None) -> int:
    """Bytes in use after a datum of `size` bytes of payload is stored in place of `freed` bytes.

    `used` and `freed` count `ROW_OVERHEAD` for each datum, and so does the result. Raises `StoreFullError` when the
    result would exceed `quota` (None: no bound).
    """
    total = used - freed + size + ROW_OVERHEAD
    if quota is not None and total > quota:
        raise StoreFullError(f"quota of {quota} bytes: {used} are in use, {size + ROW_OVERHEAD} more do not fit")
    return total
