"""Chunked transfers: data too large for one frame, one transfer for each neighbour and direction.

The giver offers. The receiver accepts and names the transfer with a handle. Chunks follow in a fixed window, and
selective acknowledgements report what is missing. The offer is also the probe: after a step without any answer it is
repeated, and the answer says where to continue. There is no congestion control: the window is a constant.

The other side is not trusted. An answer about chunks that were never sent is ignored, and a transfer counts as alive
only while more is acknowledged than ever before.
"""

from __future__ import annotations

from rass_mav.core.datum import Datum, DatumId, datum_crc
from rass_mav.core.messages import Accept, Chunk, Offer, Sack

#: Chunks that may be unacknowledged.
WINDOW = 32
#: Chunks after which the receiver acknowledges. It also does so on request, and at the end.
SACK_EVERY = 8
#: A chunk counts as lost when one sent this much later has arrived.
REORDER_MARGIN = 3


class Sending:
    """The giver's side of a transfer."""

    __slots__ = (
        "_acked", "_highest", "_most", "_resent", "_sent", "count", "datum", "handle", "moved", "neighbour", "number",
        "size",
    )  # fmt: skip

    def __init__(self, datum: Datum, neighbour: int, number: int, chunk_size: int) -> None:
        self.datum = datum
        self.neighbour = neighbour
        self.number = number
        """The hand-over number."""
        self.size = chunk_size
        self.count = -(-len(datum.payload) // chunk_size)
        """Number of chunks."""
        self.handle: int | None = None
        self.moved = False
        """Whether more has been acknowledged than ever before, since the last probe."""
        self._most = -1
        """The most chunks that were ever acknowledged; -1: no answer yet."""
        self._acked: set[int] = set()
        self._sent = 0
        """The next chunk to be sent for the first time, or again after an interruption."""
        self._highest = 0
        """Chunks below this one may be known to the receiver."""
        self._resent: dict[int, int] = {}

    def offer(self, sender: int) -> Offer:
        """The offer, which is also the probe."""
        d = self.datum
        return Offer(
            sender, self.neighbour, self.number, d.id, d.kind, d.created, d.hops, d.crc, len(d.payload), self.size,
            d.at_least,
        )  # fmt: skip

    def on_accept(self, accept: Accept) -> list[Chunk]:
        """Start, or continue after an interruption. Returns nothing if that is beyond what the receiver can have."""
        next_index = accept.next_index
        if next_index >= self.count:
            return []
        if accept.handle != self.handle:
            self.handle = accept.handle
            self._acked.clear()
            # It may know chunks from an earlier transfer that broke off.
            self._highest = self.count if next_index else 0
        elif next_index > self._highest:
            return []
        if next_index in self._acked:
            # The earlier acknowledgement was wrong.
            self._acked.clear()
        self._acked.update(range(next_index))
        self._resent.clear()
        self._sent = next_index
        self._count()
        return self._fill()

    def _count(self) -> None:
        if len(self._acked) > self._most:
            self._most = len(self._acked)
            self.moved = True

    def on_sack(self, sack: Sack) -> list[Chunk]:
        """Resend what is missing, and send more. A sack of chunks that were never sent is ignored."""
        acked = self._acked
        known = sack.next_index + 1 + sack.bitmap.bit_length() if sack.bitmap else sack.next_index
        if known > self._highest or sack.next_index >= self.count:
            return []
        acked.update(range(sack.next_index))
        bitmap, index = sack.bitmap, sack.next_index + 1
        highest = sack.next_index - 1
        while bitmap:
            if bitmap & 1:
                acked.add(index)
                highest = index
            bitmap >>= 1
            index += 1
        self._count()
        again = []
        for missing in range(sack.next_index, highest - REORDER_MARGIN + 1):
            if missing not in acked and self._resent.get(missing, missing) <= highest - REORDER_MARGIN:
                self._resent[missing] = self._sent
                again.append(missing)
        return self._fill(again)

    def _fill(self, again: list[int] | None = None) -> list[Chunk]:
        indexes = again or []
        base = self._sent
        waiting = sum(1 for i in range(max(0, base - 8 * WINDOW), base) if i not in self._acked)
        while self._sent < self.count and waiting < WINDOW:
            if self._sent not in self._acked:
                indexes.append(self._sent)
                waiting += 1
            self._sent += 1
        self._highest = max(self._highest, self._sent)
        payload, size, handle = self.datum.payload, self.size, self.handle
        assert handle is not None
        last = len(indexes) - 1
        return [
            Chunk(self.neighbour, handle, index, n == last, payload[index * size : (index + 1) * size])
            for n, index in enumerate(indexes)
        ]


class Receiving:
    """The receiver's side of a transfer. Holds at most one datum's bytes."""

    __slots__ = ("_chunks", "_next", "_since", "count", "handle", "heard", "moved", "offer")

    def __init__(self, offer: Offer, handle: int, now: float) -> None:
        self.offer = offer
        self.handle = handle
        self.count = -(-offer.size // offer.chunk_size)
        self.heard = now
        """When the giver was last heard, seconds."""
        self.moved = now
        """When the last missing chunk came, seconds."""
        self._chunks: dict[int, bytes] = {}
        self._next = 0
        self._since = 0

    @property
    def id(self) -> DatumId:
        """The datum that is being transferred."""
        return self.offer.id

    def accept(self, receiver: int) -> Accept:
        """The answer to the offer, at first and after an interruption."""
        return Accept(receiver, self.offer.sender, self.offer.number, self.handle, self._next)

    def on_chunk(self, chunk: Chunk, now: float) -> bool:
        """Accept a chunk. Returns whether to acknowledge now. A chunk of a wrong length is ignored."""
        index = chunk.position
        self.heard = now
        if index < self.count and index not in self._chunks and len(chunk.data) == self._length(index):
            self._chunks[index] = chunk.data
            self.moved = now
            self._since += 1
            while self._next in self._chunks:
                self._next += 1
        if chunk.poll or self._since >= SACK_EVERY:
            self._since = 0
            return True
        return False

    def _length(self, index: int) -> int:
        size = self.offer.chunk_size
        return size if index < self.count - 1 else self.offer.size - size * (self.count - 1)

    @property
    def complete(self) -> bool:
        """Whether all chunks are there."""
        return self._next == self.count

    def sack(self, receiver: int) -> Sack:
        """What has arrived."""
        bitmap = 0
        first = self._next + 1
        for offset in range(256):
            if first + offset in self._chunks:
                bitmap |= 1 << offset
        return Sack(receiver, self.offer.sender, self.handle, self._next, bitmap)

    def datum(self) -> Datum | None:
        """The datum as it was offered; None if its checksum does not match. Only when complete."""
        offer = self.offer
        payload = b"".join(self._chunks[i] for i in range(self.count))
        if datum_crc(offer.id, offer.kind, payload) != offer.crc:
            return None
        return Datum(offer.id, offer.kind, offer.created, offer.hops, offer.crc, payload, offer.at_least)
