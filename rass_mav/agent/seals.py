"""What the keys of a node do to data: it seals its own, and a base tells what others have made."""

from __future__ import annotations

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.seals import SEALED, NoSeals
from rass_mav.core.store import Store
from rass_mav.core.terms import parted
from rass_mav.errors import ForgedError, MalformedError
from rass_mav.keys.keyring import Keyring
from rass_mav.keys.sealing import SEAL_SIZE, Opener, Sealer


class DataKeys:
    """What all lives of a node have in common."""

    __slots__ = ("_accept_open", "_keys", "_opener")

    def __init__(self, keyring: Keyring, *, accept_open: bool = False) -> None:
        """`accept_open`: at a base, data that nobody has sealed count as made by the node that they name."""
        self._keys = keyring.own
        self._opener = None if keyring.ground is None else Opener(keyring.ground)
        self._accept_open = accept_open

    def __call__(self, store: Store) -> Seals:
        """For a life that begins with what the store holds now."""
        return Seals(Sealer(self._keys, store.epoch, store.given), self._opener, accept_open=self._accept_open)


class Seals(NoSeals):
    """One life of a node with keys.

    A number may be sealed again in another life, if the store has rolled back: nothing of the first one has left then,
    because no frame leaves before the datum in it is on disk (`agent.commits`).
    """

    __slots__ = ("_accept_open", "_opener", "_sealer")

    added = SEAL_SIZE

    def __init__(self, sealer: Sealer, opener: Opener | None, *, accept_open: bool) -> None:
        """`opener`: None: a drone, which opens nothing."""
        self._sealer = sealer
        self._opener = opener
        self._accept_open = accept_open

    def seal(self, id: DatumId, kind: int, payload: bytes, terms: bytes = b"") -> tuple[int, bytes]:
        return kind | SEALED, terms + self._sealer.seal(id.sequence, kind, payload, terms)

    def is_made(self, datum: Datum) -> bool:
        if self._opener is None:
            return True
        if not datum.kind & SEALED:
            return self._accept_open
        terms, sealed = parted(datum.kind, datum.payload)
        try:
            self._opener.open(datum.id, datum.kind & ~SEALED, sealed, terms)
        except (ForgedError, MalformedError):
            return False
        return True
