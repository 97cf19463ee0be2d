"""Opens sealed data, with the ground's keys (docs/keys.md)."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.app.config import RunConfig
from rass_mav.config.keys import check_package
from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.seals import SEALED
from rass_mav.core.terms import parted
from rass_mav.errors import ForgedError, MalformedError, StoreError

#: Returns the contents of a sealed datum: its id, its kind without `SEALED`, its payload without terms, its terms.
#: Raises `ForgedError`, `MalformedError`.
Opens = Callable[[DatumId, int, bytes, bytes], bytes]


def opener_of(path: str) -> Opens:
    """With the ground's keys in a file. Raises `KeysError`."""
    check_package()
    from rass_mav.trust.keys.files import read_ground  # with PyNaCl, which is needed for nothing else here
    from rass_mav.trust.keys.sealing import Opener

    return Opener(read_ground(path)).open


def opener_of_node(config: RunConfig) -> Opens | None:
    """With the keys of a node; None: it has none, or it is a drone, which can open nothing. Raises `KeysError`."""
    return None if config.keys is None or not config.base else opener_of(config.keys.file)


def opened(name: str, datum: Datum, opens: Opens | None) -> bytes:
    """The contents of a datum. `StoreError`: it is sealed, and cannot be opened."""
    terms, payload = parted(datum.kind, datum.payload)
    if not datum.kind & SEALED:
        return payload
    if opens is None:
        raise StoreError(f"{name}: sealed; give the ground's keys with --keys")
    try:
        return opens(datum.id, datum.kind & ~SEALED, payload, terms)
    except (ForgedError, MalformedError) as error:
        raise StoreError(f"{name}: {error}") from None
