"""The numbers of the hand-overs that a node has accepted.

The sender keeps a datum until the receiver has it on disk and sends COMMITTED with the number of that hand-over
(`rass_mav.core.exchange`). The receiver remembers the numbers that it has accepted (bounded). It answers the
retransmission of an accepted number with COMMITTED even when the datum has been passed on since, if the checksum is
that of the accepted datum. The sender acts on it only while that number is still open, that is while it has not taken
the datum back. Without this memory each lost answer on a lossy link creates a second copy at each hop. It is a memory
of hand-overs, not of data: the same datum offered under another number is accepted like any other. If a copy is found
corrupt, the entries of its datum are forgotten, so that it can be sent again.
"""

from __future__ import annotations

from rass_mav.core.datum import DatumId
from rass_mav.core.seals import CRC_MASK, ContentHashes
from rass_mav.core.shares import greediest

#: How many accepted hand-over numbers a node remembers. When there is one too many, the neighbour that has most of them
#: loses its oldest.
MAX_ACCEPTED = 1024


class HandoverNumbers:
    """The hand-over numbers that one node has accepted."""

    __slots__ = ("_accepted", "_count", "content_hashes")

    def __init__(self, content_hashes: ContentHashes) -> None:
        """`content_hashes`: of what is handed over."""
        self.content_hashes = content_hashes
        """Of what is handed over."""
        self._accepted: dict[int, dict[int, tuple[DatumId, int]]] = {}
        """What was accepted, and its content hash, by sender, then by number, the oldest first."""
        self._count = 0
        """How many there are in all."""

    def accept(self, custodian: int, number: int, id: DatumId, content_hash: int) -> None:
        """Remember that this hand-over of a datum with this content hash was accepted."""
        # A restarted sender may draw a number again.
        self._drop(custodian, number)
        self._accepted.setdefault(custodian, {})[number] = id, content_hash
        self._count += 1
        if self._count > MAX_ACCEPTED:
            most = greediest({custodian: len(numbers) for custodian, numbers in self._accepted.items()})
            self._drop(most, next(iter(self._accepted[most])))

    def _drop(self, custodian: int, number: int) -> None:
        numbers = self._accepted.get(custodian, {})
        if numbers.pop(number, None) is not None:
            self._count -= 1
            if not numbers:
                del self._accepted[custodian]

    def has_accepted(self, custodian: int, number: int, id: DatumId, content_hash: int) -> bool:
        """Whether this same hand-over was accepted before."""
        return self._accepted.get(custodian, {}).get(number) == (id, content_hash)

    def accepted(self, custodian: int, number: int, id: DatumId, crc: int) -> int | None:
        """The content hash of the datum with this checksum that was accepted under this number; None: there is none."""
        accepted_id, content_hash = self._accepted.get(custodian, {}).get(number, (None, 0))
        return content_hash if accepted_id == id and content_hash & CRC_MASK == crc else None

    def forget(self, id: DatumId) -> None:
        """A copy was found corrupt or has expired: it no longer counts as accepted."""
        accepted = self._accepted.items()
        for key in [(custodian, number) for custodian, of in accepted for number, (its, _) in of.items() if its == id]:
            self._drop(*key)
