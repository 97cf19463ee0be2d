"""What an answer to a hand-over confirms: that this content is on disk, and not just something under this number.

Without keys that is a checksum, which anybody can match with another content. Nodes with keys use something else: the
sender deletes its copy because of the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import Data, DeletionReport, Message, Offer

#: The bits of a content hash that are on the wire: the checksum.
CRC_MASK = 0xFFFFFFFF


class ContentHashes:
    """For a node without keys. The low 32 bits of each content hash are what an answer to a hand-over repeats."""

    __slots__ = ()

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
