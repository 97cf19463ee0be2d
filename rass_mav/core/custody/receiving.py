"""The receiver's side of a transfer: the chunks of one datum that have come."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from typing import NamedTuple

from rass_mav.core.datum import Datum, DatumId, datum_crc
from rass_mav.core.messages import REPORT_BITS, Accept, Chunk, Offer, Report
from rass_mav.core.store import PartialKey


class Content(NamedTuple):
    """A datum and its cut: the same chunks from any sender."""

    id: DatumId
    kind: int
    crc: int
    size: int
    chunk_size: int


def content_of(offer: Offer) -> Content:
    """What is offered."""
    return Content(offer.id, offer.kind, offer.crc, offer.size, offer.chunk_size)


class Receiving:
    """One datum that comes in chunks. Holds at most the datum's bytes."""

    __slots__ = (
        "_here", "_next", "_unsaved", "chunks", "content", "count", "handle", "heard", "helped", "moved", "offer",
    )  # fmt: skip

    def __init__(self, offer: Offer, handle: int, now: float) -> None:
        self.offer = offer
        self.content = content_of(offer)
        self.handle = handle
        self.count = -(-offer.size // offer.chunk_size)
        self.heard = now
        """When the sender was last heard about this datum, seconds."""
        self.moved = now
        """When the last missing chunk came, seconds."""
        self.chunks: dict[int, bytes] = {}
        """What has come, by index."""
        self._here = 0
        """The same as bits."""
        self._next = 0
        self._unsaved: list[int] = []
        """The chunks that came since `unsaved` was asked."""
        self.helped = False
        """Whether some chunks did not come in this transfer."""

    @property
    def key(self) -> PartialKey:
        """Under which the store keeps what has come."""
        return PartialKey(self.offer.id, self.offer.crc, self.offer.size)

    @property
    def id(self) -> DatumId:
        """The datum that is being transferred."""
        return self.offer.id

    def accept(self, receiver: int) -> Accept:
        """The answer to the offer, at first and after an interruption."""
        _, next_index, bitmap = self.report(REPORT_BITS)
        return Accept(receiver, self.offer.sender, self.offer.number, self.handle, next_index, bitmap)

    def take(self, chunk: Chunk, now: float) -> bool:
        """Keep a chunk. False: it is here already, or of a wrong length."""
        index = chunk.position
        self.heard = now
        if index >= self.count or index in self.chunks or len(chunk.data) != self.length(index):
            return False
        self._put(index, chunk.data)
        self._unsaved.append(index)
        self.moved = now
        return True

    def whole(self, pieces: Iterable[tuple[int, bytes]]) -> dict[int, bytes]:
        """The chunks, by index, that are wholly among these pieces of the payload, each with its offset. They may
        overlap, and come from a transfer with other chunks."""
        joined: list[tuple[int, bytearray]] = []
        for offset, data in sorted(pieces):
            if joined and offset <= (end := joined[-1][0] + len(joined[-1][1])):
                joined[-1][1].extend(data[end - offset :])
            else:
                joined.append((offset, bytearray(data)))
        found, size = {}, self.offer.chunk_size
        for offset, some in joined:
            for index in range(-(-offset // size), self.count):
                at = index * size - offset
                if at + self.length(index) > len(some):
                    break
                found[index] = bytes(some[at : at + self.length(index)])
        return found

    def begin_with(self, chunks: Mapping[int, bytes], saved: Container[int] = ()) -> None:
        """Have these chunks of the same content from the start, as far as `accept` can name them: the sender ignores
        reports of others that it has not sent. `saved`: the indexes of those that the store has."""
        for index in sorted(chunks):
            if index > self._next + REPORT_BITS:
                break
            self._put(index, chunks[index])
            self.helped = True
            if index not in saved:
                self._unsaved.append(index)

    def unsaved(self) -> list[tuple[int, bytes]]:
        """What came since this was asked last: runs of chunks, each with its offset."""
        runs: list[list[int]] = []
        for index in sorted(self._unsaved):
            if runs and index == runs[-1][-1] + 1:
                runs[-1].append(index)
            else:
                runs.append([index])
        self._unsaved.clear()
        return [(run[0] * self.offer.chunk_size, b"".join([self.chunks[i] for i in run])) for run in runs]

    def _put(self, index: int, data: bytes) -> None:
        self.chunks[index] = data
        self._here |= 1 << index
        while self._next in self.chunks:
            self._next += 1

    def length(self, index: int) -> int:
        size = self.offer.chunk_size
        return size if index < self.count - 1 else self.offer.size - size * (self.count - 1)

    @property
    def has_gaps(self) -> bool:
        """Whether a chunk has come before one that belongs in front of it."""
        return len(self.chunks) > self._next

    @property
    def complete(self) -> bool:
        """Whether all chunks are there."""
        return self._next == self.count

    def report(self, bits: int) -> Report:
        """What has come, up to so many chunks after the first missing one."""
        return Report(self.handle, self._next, self._here >> self._next + 1 & (1 << bits) - 1)

    def datum(self) -> Datum | None:
        """The datum as it was offered; None if its checksum does not match. Only when complete."""
        offer = self.offer
        payload = b"".join(self.chunks[i] for i in range(self.count))
        if datum_crc(offer.id, offer.kind, payload) != offer.crc:
            return None
        return Datum(offer.id, offer.kind, offer.created, offer.hops, offer.crc, payload, offer.at_least)
