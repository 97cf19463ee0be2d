"""Sealed data: what core expects of the keys of a node, and what a node without keys does. No cryptography here."""

from __future__ import annotations

from rass_mav.core.datum import Datum, DatumId

#: The bit of a kind that says that the payload is sealed: only the ground can read it, and only its origin has made it.
SEALED = 0x80


class NoSeals:
    """For a node without keys, whose data are open. A node with keys has something else here in each of its lives."""

    __slots__ = ()

    #: Bytes that sealing adds to a payload.
    added = 0

    def seal(self, id: DatumId, kind: int, payload: bytes, terms: bytes = b"") -> tuple[int, bytes]:
        """The kind and the payload of a new datum as they are stored. `kind`: 0..127. `terms`: they stay open, at the
        beginning.

        Raises `ValueError` for a number of this node that is not above those sealed before.
        """
        return kind, terms + payload

    def of_note(self, id: DatumId, reason: int) -> bytes:
        """Who says that a datum is lost, with its tag, as deletion reports carry it; empty where there are no keys."""
        return b""

    def reporter(self, id: DatumId, reason: int, proof: bytes) -> int | None:
        """At a base: the node that says so; None: that is not known."""
        return None

    def is_authentic(self, datum: Datum) -> bool:
        """At a base: whether a datum was made by the node that it names, as far as that can be known."""
        return True


#: For all nodes without keys.
NO_SEALS = NoSeals()
