"""The chunked transfers of one node, out and in: at most one for each neighbour and direction, and bounded in all."""

from __future__ import annotations

import random

from rass_mav.core.custody.holdings import Holding, Pending
from rass_mav.core.custody.keeper import Keeper
from rass_mav.core.custody.transfer import Receiving, Sending
from rass_mav.core.datum import MAX_PAYLOAD, Datum
from rass_mav.core.messages import Accept, Chunk, Committed, Message, Offer, Sack
from rass_mav.core.pace import Pace
from rass_mav.core.routes.table import RoutingTable

#: Transfers at a time, in each direction. Each holds at most one datum (1 MiB) in memory.
MAX_TRANSFERS = 8
#: How many incoming transfers may be data of one origin.
MAX_OF_ONE_ORIGIN = 4
#: Chunk indexes have 14 bits.
MAX_CHUNKS = 1 << 14


class Transfers:
    """Offers, chunks and their acknowledgement for one node."""

    __slots__ = ("_id", "_keeper", "_pace", "_receiving", "_rng", "_routing", "lifetime_s")

    def __init__(self, keeper: Keeper, routing: RoutingTable, pace: Pace, rng: random.Random) -> None:
        self._id = keeper.settings.node_id
        self._keeper = keeper
        self._routing = routing
        self._pace = pace
        self._rng = rng
        self.lifetime_s = routing.lifetime_s
        """An incoming transfer silent for longer is given up, and its bytes forgotten."""
        self._receiving: dict[int, Receiving] = {}
        """By handle."""

    # -- outgoing ------------------------------------------------------------------------------------------------------

    def free(self, neighbour: int) -> bool:
        """Whether a transfer to this neighbour can begin."""
        large = self._keeper.holdings.large
        return neighbour not in large and len(large) < MAX_TRANSFERS

    def begin(self, holding: Holding, datum: Datum, neighbour: int, now: float, out: list[Message]) -> None:
        """Offer a datum to a neighbour that is `free`."""
        keeper = self._keeper
        number = keeper.numbers.draw()
        sending = Sending(datum, neighbour, number, keeper.settings.chunk_bytes)
        pending = Pending(number, neighbour, now, sending)
        pending.due = now + (keeper.settings.retry_steps - 0.5) * self._pace.turn_s
        keeper.holdings.give(holding, pending)
        out.append(sending.offer(self._id))

    def probe(self, pending: Pending, sending: Sending, now: float, out: list[Message]) -> None:
        """Repeat the offer of a chunked datum if its transfer has made no progress since the last time."""
        pending.sent = now
        if sending.moved:
            pending.tries = 1
            sending.moved = False
        else:
            pending.tries += 1
            out.append(sending.offer(self._id))

    def _to(self, neighbour: int) -> Sending | None:
        holding = self._keeper.holdings.large.get(neighbour)
        return None if holding is None or holding.pending is None else holding.pending.sending

    def on_accept(self, accept: Accept, now: float) -> list[Message]:
        """The neighbour opened a transfer (again): send, starting where it asks."""
        sending = self._to(accept.sender)
        if sending is None or sending.number != accept.number:
            return []
        return self._sent(sending.on_accept(accept))

    def on_sack(self, sack: Sack, now: float) -> list[Message]:
        """The neighbour reports the chunks it has."""
        sending = self._to(sack.sender)
        if sending is None or sending.handle != sack.handle:
            return []
        return self._sent(sending.on_sack(sack))

    def _sent(self, chunks: list[Chunk]) -> list[Message]:
        self._pace.sent += len(chunks)
        return list(chunks)

    # -- incoming ------------------------------------------------------------------------------------------------------

    def age(self, now: float) -> None:
        """Give up silent incoming transfers."""
        if self._receiving:
            for handle in [h for h, t in self._receiving.items() if now - t.heard > self.lifetime_s]:
                del self._receiving[handle]

    def on_offer(self, offer: Offer, now: float) -> list[Message]:
        """A neighbour offers a large datum: it is here already, there is no space, or it may come."""
        keeper = self._keeper
        if keeper.has_custody(offer.sender, offer.number, offer.id, offer.crc):
            keeper.rejuvenate(offer.id, offer.created, at_least=offer.at_least)
            return [self._committed(offer, keeper.confirmed(offer.sender, offer.number, offer.id, offer.crc))]
        running = next((t for t in self._receiving.values() if t.offer.sender == offer.sender), None)
        if running is not None:
            same = running.offer
            if (same.id, same.crc, same.size, same.chunk_size) == (offer.id, offer.crc, offer.size, offer.chunk_size):
                running.offer = offer
                running.heard = now
                return [running.accept(self._id)]
            del self._receiving[running.handle]
        if not self._acceptable(offer) or not self._has_place(offer, now):
            keeper.refused += 1
            return [self._refused(offer)]
        handle = self._rng.getrandbits(16)
        while handle in self._receiving:
            handle = self._rng.getrandbits(16)
        transfer = self._receiving[handle] = Receiving(offer, handle, now)
        return [transfer.accept(self._id)]

    def _acceptable(self, offer: Offer) -> bool:
        return (
            offer.size <= MAX_PAYLOAD
            and -(-offer.size // offer.chunk_size) <= MAX_CHUNKS
            # Names are easy to invent, and each would take a place.
            and offer.sender in self._routing.neighbours
            and not self._keeper.is_occupied(offer.id, offer.kind)
            and not self._keeper.is_squatted(offer.id)
            and self._keeper.is_fair(offer.sender, offer.id.origin, offer.size)
        )

    def _has_place(self, offer: Offer, now: float) -> bool:
        """Whether one more transfer may come in; idle transfers are dropped for it, the longest idle first."""
        receiving, may_accept = self._receiving, self._keeper.may_accept
        idle = sorted((t for t in receiving.values() if now - t.moved > self._pace.turn_s), key=lambda t: t.moved)
        staying = [t for t in receiving.values() if t not in idle]
        for leaving in range(len(idle) + 1):
            others = [*staying, *idle[leaving:]]
            akin = sum(t.id.origin == offer.id.origin for t in others)
            if len(others) >= MAX_TRANSFERS or akin >= MAX_OF_ONE_ORIGIN:
                continue
            if may_accept(offer.size + sum(t.offer.size for t in others)):
                for transfer in idle[:leaving]:
                    del receiving[transfer.handle]
                return True
        return False

    def on_chunk(self, chunk: Chunk, now: float) -> list[Message]:
        """A piece of a datum; if the handle is not ours, it belongs to another node's transfer."""
        transfer = self._receiving.get(chunk.handle)
        if transfer is None:
            return []
        acknowledge = transfer.on_chunk(chunk, now)
        if not transfer.complete:
            return [transfer.sack(self._id)] if acknowledge else []
        del self._receiving[chunk.handle]
        datum, offer = transfer.datum(), transfer.offer
        if datum is None:
            # Chunks of another transfer with the same handle got mixed in: the giver's next probe starts it again.
            self._keeper.corrupt_received += 1
            return []
        taken = self._keeper.take_custody(offer.sender, offer.number, datum)
        return [self._committed(offer, self._keeper.numbers.prints.of(datum)) if taken else self._refused(offer)]

    def _committed(self, offer: Offer, fingerprint: int) -> Committed:
        return Committed(self._id, offer.sender, ((offer.number, fingerprint),), ())

    def _refused(self, offer: Offer) -> Committed:
        return Committed(self._id, offer.sender, (), (offer.number,))
