"""What core expects of the keys of a node, and what a node without keys does. No cryptography here.

Keys seal data. And an answer to a hand-over confirms that this content is on disk, and not just something under this
number: without keys by a checksum, which a forger can match with another content. Nodes with keys use something else:
the sender deletes its copy because of the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Data, DeletionReport, Message, Offer

#: The bit of a kind that says that the payload is sealed: only the ground can read it, and only its origin has made it.
SEALED = 0x80


class NoSeals:
    """For a node without keys, whose data are open. A node with keys has something else here in each of its lives."""

    __slots__ = ()

    #: Bytes that sealing adds to a payload.
    added = 0
    #: Whether statements of bases come here only if the ground has signed them, so origins deny nothing.
    vouched = False

    def seal(self, id: DatumId, kind: int, payload: bytes, terms: bytes = b"") -> tuple[int, bytes]:
        """The kind and the payload of a new datum as they are stored. `kind`: 0..127. `terms`: they stay open, at the
        beginning.

        Raises `ValueError` for a number of this node that is not above those sealed before.
        """
        return kind, terms + payload

    def of_note(self, id: DatumId, reason: int) -> bytes:
        """The proof of a deletion report: its author and a tag; empty where there are no keys."""
        return b""

    def reporter(self, id: DatumId, reason: int, proof: bytes) -> int | None:
        """At a base: the node that says so; None: that is not known."""
        return None

    def is_authentic(self, datum: Datum) -> bool:
        """At a base: whether a datum was made by the node that it names, as far as that can be known."""
        return True


#: For all nodes without keys.
NO_SEALS = NoSeals()


#: The bits of a content hash that are on the wire: the checksum.
CRC_MASK = 0xFFFFFFFF


class ContentHashes:
    """For a node without keys. The low 32 bits of each content hash are what an answer to a hand-over repeats."""

    __slots__ = ()

    #: Whether answers prove who sent them. Nothing that proves less counts as one.
    proven = False

    def of(self, datum: Datum, *, replica: bool = False) -> int:
        """Of a datum that is handed over; `replica`: of a replica, with which custody stays at the sender."""
        return datum.crc

    def of_note(self, id: DatumId, reason: int) -> int:
        """Of a deletion report; its low 32 bits are 0."""
        return 0


def of_offers(
    message: Message, content_hashes: ContentHashes, get: Callable[[DatumId], Datum | None]
) -> Iterator[tuple[int, int]]:
    """The numbers under which a message hands something over, and the content hashes that the answers should confirm.

    `get`: returns a datum that is stored here.
    """
    if type(message) is Data:
        for number, datum in message.handovers:
            if number:
                yield number, content_hashes.of(datum, replica=message.replica)
    elif type(message) is Offer:
        stored = get(message.id)
        if stored is not None:
            yield message.number, content_hashes.of(stored)
    elif type(message) is DeletionReport:
        for entry in message.entries:
            yield entry.number, content_hashes.of_note(entry.id, entry.reason)
