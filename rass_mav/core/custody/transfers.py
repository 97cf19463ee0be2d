"""The chunked transfers of one node, out and in: at most one a neighbour in each direction, bounded over all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rass_mav.core.custody.handovers import Pending
from rass_mav.core.custody.transfer import Incoming, Outgoing
from rass_mav.core.datum import MAX_PAYLOAD, Datum, DatumId
from rass_mav.core.messages import Accept, Chunk, Committed, Message, Offer, Sack

if TYPE_CHECKING:
    from rass_mav.core.node import Node

#: Transfers at a time, each way. Each holds at most one datum (1 MiB) in memory.
MAX_TRANSFERS = 8
#: Chunk indexes have 14 bits.
MAX_CHUNKS = 1 << 14


class Transfers:
    """Offers, chunks and their acknowledgement for one node."""

    def __init__(self, node: Node, lifetime_s: float) -> None:
        """`lifetime_s`: an incoming transfer silent for longer is given up, and its bytes forgotten."""
        self._node = node
        self.lifetime_s = lifetime_s
        self._out: dict[int, Outgoing] = {}
        """By neighbour."""
        self._in: dict[int, Incoming] = {}
        """By handle."""
        self.sent_chunks = 0

    def free(self, neighbour: int) -> bool:
        """Whether a transfer to this neighbour can begin."""
        return neighbour not in self._out and len(self._out) < MAX_TRANSFERS

    def begin(self, datum: Datum, neighbour: int, now: float, out: list[Message]) -> None:
        """Offer a datum to a neighbour that is `free`."""
        node = self._node
        number = node.custody.give(datum.id, neighbour, now).number
        transfer = Outgoing(datum, neighbour, number, node.settings.chunk_bytes)
        self._out[neighbour] = transfer
        out.append(transfer.offer(node.id))

    def retry(self, pending: Pending, now: float, out: list[Message]) -> bool:
        """If this hand-over is a transfer: probe it when nothing was heard since the last probe. False: it is none."""
        transfer = self._out.get(pending.neighbour)
        if transfer is None or transfer.number != pending.number:
            return False
        pending.sent = now
        if transfer.answered:
            pending.tries = 1
            transfer.answered = False
        else:
            pending.tries += 1
            out.append(transfer.offer(self._node.id))
        return True

    def cancel(self, id: DatumId) -> None:
        """The datum is not to be handed over any more."""
        for neighbour, transfer in self._out.items():
            if transfer.datum.id == id:
                del self._out[neighbour]
                return

    def age(self, now: float) -> None:
        """Give up silent incoming transfers."""
        if self._in:
            for handle in [h for h, t in self._in.items() if now - t.heard > self.lifetime_s]:
                del self._in[handle]

    def on_accept(self, accept: Accept, now: float) -> list[Message]:
        """The neighbour opened a transfer (again): send, from where it says."""
        transfer = self._out.get(accept.sender)
        if transfer is None or transfer.number != accept.number:
            return []
        return self._sent(transfer.on_accept(accept))

    def on_sack(self, sack: Sack, now: float) -> list[Message]:
        """The neighbour says what it has."""
        transfer = self._out.get(sack.sender)
        if transfer is None or transfer.handle != sack.handle:
            return []
        return self._sent(transfer.on_sack(sack))

    def _sent(self, chunks: list[Chunk]) -> list[Message]:
        self.sent_chunks += len(chunks)
        self._node.sent_data += len(chunks)
        return list(chunks)

    def on_offer(self, offer: Offer, now: float) -> list[Message]:
        """A neighbour offers a large datum: it is here already, there is no room, or it may come."""
        node = self._node
        id = offer.id
        if node.has_custody(offer.sender, offer.number, id, offer.crc):
            return [Committed(node.id, offer.sender, ((offer.number, offer.crc),), ())]
        running = next((t for t in self._in.values() if t.offer.sender == offer.sender), None)
        if running is not None:
            same = running.offer
            if (same.id, same.crc, same.size, same.chunk_size) == (id, offer.crc, offer.size, offer.chunk_size):
                running.offer = offer
                running.heard = now
                return [running.accept(node.id)]
            del self._in[running.handle]
        if not self._acceptable(offer):
            node.refused += 1
            return [Committed(node.id, offer.sender, (), (offer.number,))]
        handle = node.rng.getrandbits(16)
        while handle in self._in:
            handle = node.rng.getrandbits(16)
        transfer = Incoming(offer, handle, now)
        self._in[handle] = transfer
        return [transfer.accept(node.id)]

    def _acceptable(self, offer: Offer) -> bool:
        node = self._node
        if (
            offer.size > MAX_PAYLOAD
            or -(-offer.size // offer.chunk_size) > MAX_CHUNKS
            or len(self._in) >= MAX_TRANSFERS
            or node.inventory.holds(offer.id)
        ):
            return False
        return node.may_accept(offer.size + sum(t.offer.size for t in self._in.values()))

    def on_chunk(self, chunk: Chunk, now: float) -> list[Message]:
        """A piece of a datum; of another's transfer, if the handle is not ours."""
        node = self._node
        transfer = self._in.get(chunk.handle)
        if transfer is None:
            return []
        acknowledge = transfer.on_chunk(chunk, now)
        if not transfer.complete:
            return [transfer.sack(node.id)] if acknowledge else []
        del self._in[chunk.handle]
        datum = transfer.datum()
        offer = transfer.offer
        if datum is None:
            # Chunks of a stranger with the same handle got mixed in: the giver's next probe starts it afresh.
            node.corrupt_received += 1
            return []
        if node.take_custody(offer.sender, offer.number, datum):
            return [Committed(node.id, offer.sender, ((offer.number, offer.crc),), ())]
        return [Committed(node.id, offer.sender, (), (offer.number,))]
