"""What the keys of a node do to data: it seals its own, and a base tells what others have made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from struct import Struct

from rass_mav.core.datum import Datum, DatumId, parted
from rass_mav.core.messages import NOTE_PROOF_BYTES
from rass_mav.core.seals import SEALED, NoSeals
from rass_mav.core.store import Store
from rass_mav.errors import ForgedError, MalformedError
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.sealing import SEAL_SIZE, Opener, Sealer

_NODE = Struct("<H")
_LOSS = Struct("<HIIB")


class DataKeys:
    """What all lives of a node have in common."""

    __slots__ = ("_accept_open", "_keys", "_opener")

    def __init__(
        self, keyring: Keyring, serials: Callable[[], Mapping[int, int]], *, accept_open: bool = False
    ) -> None:
        """`serials`: those that the ground has assigned by now (`KeyUpdates.serials`). `accept_open`: at a base, data
        without a seal count as made by the node that they name."""
        self._keys = keyring.own
        self._opener = None if keyring.ground is None else Opener(keyring.ground, serials)
        self._accept_open = accept_open

    def __call__(self, store: Store) -> Seals:
        """For a life that begins with what the store holds now."""
        sealer = Sealer(self._keys, store.epoch, store.assigned)
        return Seals(self._keys.certificate.node_id, sealer, self._opener, accept_open=self._accept_open)


class Seals(NoSeals):
    """One life of a node with keys.

    A number may be sealed again in another life, if the store has rolled back: nothing of the first one has left then,
    because no frame leaves before the datum in it is on disk (`agent.commits`).
    """

    __slots__ = ("_accept_open", "_node_id", "_opener", "_sealer")

    added = SEAL_SIZE
    vouched = True

    def __init__(self, node_id: int, sealer: Sealer, opener: Opener | None, *, accept_open: bool) -> None:
        """`opener`: None: a drone, which opens nothing."""
        self._sealer = sealer
        self._opener = opener
        self._accept_open = accept_open
        self._node_id = node_id

    def seal(self, id: DatumId, kind: int, payload: bytes, terms: bytes = b"") -> tuple[int, bytes]:
        return kind | SEALED, terms + self._sealer.seal(id.sequence, kind, payload, terms)

    def of_note(self, id: DatumId, reason: int) -> bytes:
        return _NODE.pack(self._node_id) + self._sealer.loss_tag(_LOSS.pack(*id, reason))

    def reporter(self, id: DatumId, reason: int, proof: bytes) -> int | None:
        if self._opener is None or len(proof) != NOTE_PROOF_BYTES:
            return None
        (node_id,) = _NODE.unpack_from(proof)
        return node_id if self._opener.made(node_id, _LOSS.pack(*id, reason), proof[_NODE.size :]) else None

    def is_authentic(self, datum: Datum) -> bool:
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
