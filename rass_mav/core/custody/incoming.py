"""What comes to one node in chunks: a few transfers from each neighbour, and bounded in all."""

from __future__ import annotations

import random
from collections import deque
from math import inf

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.flow import SACK_EVERY, round_s
from rass_mav.core.custody.listening import Listening
from rass_mav.core.custody.receiving import Content, Receiving, content_of
from rass_mav.core.custody.transfers import MAX_CHUNKS, MAX_OF_ONE, MAX_TRANSFERS
from rass_mav.core.datum import MAX_PAYLOAD, Datum
from rass_mav.core.messages import MAX_OTHERS, OTHER_BITS, REPORT_BITS, Chunk, Committed, Message, Offer, Sack
from rass_mav.core.pace import Pace
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.store import PartialKey

# Tuned: python -m tools.sensitivity custody.incoming
#: Transfers are kept for at least so long, seconds, however short a turn is: the sender may be starting again, or
#: its chunks wait in a queue, and under a new handle it would send them once more. They give way to those of others.
LEAST_KEPT_S = 120.0


class Incoming:
    """The data that come to one node in chunks, and its reports about them.

    Once a turn the store gets the chunks that are new. Another transfer of the same content, from any sender, also
    after a restart, begins with what has come.
    """

    __slots__ = (
        "_custody_store",
        "_done",
        "_id",
        "_pace",
        "_rng",
        "_routing",
        "_spoilt",
        "_unreported",
        "lifetime_s",
        "listening",
        "receiving",
    )  # fmt: skip

    def __init__(self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, rng: random.Random) -> None:
        self._id = custody_store.settings.node_id
        self._custody_store = custody_store
        self._routing = routing
        self._pace = pace
        self._rng = rng
        self.lifetime_s = routing.lifetime_s
        """Transfers of a sender that is silent for longer are given up; what has come stays in the store."""
        self.receiving: dict[int, Receiving] = {}
        """By handle."""
        self._done: deque[tuple[int, Offer]] = deque(maxlen=MAX_TRANSFERS)
        """Handles and offers of the last data that came in whole: the sender may ask again."""
        self._unreported: dict[int, int] = {}
        """Chunks that came since the last Sack, by sender."""
        self._spoilt: deque[PartialKey] = deque(maxlen=MAX_TRANSFERS)
        """Contents of which the chunks that came in other ways were wrong. They come from one sender at a time from
        now on: a sender of wrong ones must not spoil those of others again and again."""
        self.listening = Listening(custody_store, routing, pace)
        """What neighbours hand over to others."""

    def age(self, now: float) -> None:
        """Save what has come, and give up the transfers of silent senders."""
        self.listening.age(now)
        if not self.receiving:
            return
        heard: dict[int, float] = {}
        for transfer in self.receiving.values():
            self._save(transfer)
            custodian = transfer.offer.sender
            heard[custodian] = max(heard.get(custodian, -inf), transfer.heard)
        for transfer in list(self.receiving.values()):
            if now - heard[transfer.offer.sender] > max(self.lifetime_s, LEAST_KEPT_S):
                self._end(transfer)

    def _from(self, custodian: int) -> list[Receiving]:
        return [transfer for transfer in self.receiving.values() if transfer.offer.sender == custodian]

    def _save(self, transfer: Receiving) -> None:
        key, store = transfer.key, self._custody_store.store
        if key not in self._spoilt:
            for offset, data in transfer.unsaved():
                store.keep_partial(key, offset, data)

    def _give_up(self, transfer: Receiving) -> None:
        self._save(transfer)
        self._end(transfer)

    def _end(self, transfer: Receiving) -> None:
        """A transfer is over, or given up."""
        del self.receiving[transfer.handle]
        if not self._from(transfer.offer.sender):
            self._unreported.pop(transfer.offer.sender, None)

    def on_offer(self, offer: Offer, now: float) -> list[Message]:
        """A neighbour offers a large datum: it is here already, there is no space, or it may come."""
        if (here := self._here(offer)) is not None:
            return [here]
        for running in self._from(offer.sender):
            if running.content == content_of(offer):
                running.offer = offer
                running.heard = now
                return [running.accept(self._id)]
            if running.id == offer.id:
                self._give_up(running)
        if len(of_custodian := self._from(offer.sender)) >= MAX_OF_ONE:
            # A sender has no more at a time, so it has given up one of them.
            self._give_up(min(of_custodian, key=lambda transfer: transfer.heard))
        acceptable = self._acceptable(offer)
        if acceptable and (overheard := self._overheard(offer)) is not None:
            return [self._taken(offer, overheard)]
        if not acceptable or not self._has_place(offer, now):
            self._custody_store.refused += 1
            return [self._refused(offer)]
        handle = self._rng.getrandbits(16)
        while handle in self.receiving or any(handle == done for done, _ in self._done):
            handle = self._rng.getrandbits(16)
        transfer = Receiving(offer, handle, now)
        self._begin(transfer)
        self.receiving[handle] = transfer
        return self._complete(transfer) if transfer.complete else [transfer.accept(self._id)]

    def _begin(self, transfer: Receiving) -> None:
        """Begin with the chunks that have come in other ways, and those in the store."""
        key, come = transfer.key, self._come(transfer.content)
        if key in self._spoilt:
            return
        for other in self.receiving.values():
            if other.key == key:
                self._save(other)
        stored = transfer.whole(self._custody_store.store.partial(key))
        transfer.begin_with(come | stored, stored)

    def _overheard(self, offer: Offer) -> Datum | None:
        """The datum on offer, if all of it was heard when it was handed over to another node."""
        datum = self._custody_store.overheard.get(offer.id, self._custody_store.now)
        if datum is None or (datum.crc, len(datum.payload)) != (offer.crc, offer.size):
            return None
        return datum._replace(created=offer.created, hops=offer.hops, at_least=offer.at_least)

    def _come(self, content: Content) -> dict[int, bytes]:
        """The chunks of a datum that were heard while it was handed over to others, or that other senders have
        sent."""
        chunks = self.listening.take(content)
        for transfer in self.receiving.values():
            if transfer.content == content:
                chunks |= transfer.chunks
        return chunks

    def _here(self, offer: Offer) -> Committed | None:
        """The answer to an offer of what is here already; None: it is not."""
        custody_store = self._custody_store
        if not custody_store.has_custody(offer.sender, offer.number, offer.id, offer.crc):
            return None
        custody_store.rejuvenate(offer.id, offer.created, at_least=offer.at_least)
        return self._committed(offer, custody_store.confirmed(offer.sender, offer.number, offer.id, offer.crc))

    def _acceptable(self, offer: Offer) -> bool:
        return (
            offer.size <= MAX_PAYLOAD
            and -(-offer.size // offer.chunk_size) <= MAX_CHUNKS
            # Names are easy to invent, and each would take a place.
            and offer.sender in self._routing.neighbours
            and not self._custody_store.is_occupied(offer.id)
            and not self._custody_store.has_id_conflict(offer.id)
            and self._custody_store.is_fair(offer.sender, offer.id.origin, offer.size)
        )

    def _has_place(self, offer: Offer, now: float) -> bool:
        """Whether one more transfer may come in; those of idle senders are dropped for it, the longest idle
        first."""
        receiving, may_accept = self.receiving, self._custody_store.may_accept
        moved: dict[int, float] = {}
        for t in receiving.values():
            moved[t.offer.sender] = max(moved.get(t.offer.sender, -inf), t.moved)
        idle = sorted(
            (t for t in receiving.values() if now - moved[t.offer.sender] > round_s(self._pace)), key=lambda t: t.moved
        )
        staying = [t for t in receiving.values() if t not in idle]
        for leaving in range(len(idle) + 1):
            others = [*staying, *idle[leaving:]]
            akin = sum(t.id.origin == offer.id.origin for t in others)
            if len(others) >= MAX_TRANSFERS or akin >= MAX_OF_ONE:
                continue
            if may_accept(offer.size + sum(t.offer.size for t in others), 1 + len(others)):
                for transfer in idle[:leaving]:
                    self._give_up(transfer)
                return True
        return False

    def on_chunk(self, chunk: Chunk, now: float) -> list[Message]:
        """A piece of a datum, or a question; if the handle is not ours, it belongs to another node's transfer."""
        transfer = self.receiving.get(chunk.handle)
        if transfer is None:
            self.listening.on_chunk(chunk, now)
            return self._after_the_end(chunk) if chunk.poll else []
        custodian, unreported = transfer.offer.sender, self._unreported
        if transfer.take(chunk, now):
            unreported[custodian] = unreported.get(custodian, 0) + 1
        if transfer.complete:
            return self._complete(transfer)
        # While nothing is missing there is less to say.
        if chunk.poll or unreported.get(custodian, 0) >= (SACK_EVERY if transfer.has_gaps else 2 * SACK_EVERY):
            return [self._sack(transfer, 0 if chunk.data else chunk.position)]
        return []

    def _complete(self, transfer: Receiving) -> list[Message]:
        offer, datum = transfer.offer, transfer.datum()
        self._end(transfer)
        if datum is None:
            # Chunks of another transfer with the same handle got mixed in: the sender's next offer starts it again,
            # without those that others have sent.
            for other in [other for other in self.receiving.values() if other.content == transfer.content]:
                self._end(other)
            self._custody_store.corrupt_received += 1
            self._custody_store.store.forget_partial(transfer.key)
            if transfer.helped:
                self._spoilt.append(transfer.key)
            return []
        answer = self._taken(offer, datum)
        if answer.committed:
            self._done.append((transfer.handle, offer))
        else:
            self._save(transfer)
        return [answer]

    def _taken(self, offer: Offer, datum: Datum) -> Committed:
        """The answer when the whole datum is there: custody of it is taken, or there is no space."""
        if not self._custody_store.take_custody(offer.sender, offer.number, datum):
            return self._refused(offer)
        return self._committed(offer, self._custody_store.numbers.content_hashes.of(datum))

    def _after_the_end(self, chunk: Chunk) -> list[Message]:
        """The sender wants a report of a transfer that is over: it has not heard the answer."""
        custodian = next((offer.sender for handle, offer in self._done if handle == chunk.handle), None)
        if custodian is None:
            return []
        here = [
            answer for _, offer in self._done if offer.sender == custodian and (answer := self._here(offer)) is not None
        ]
        pairs = tuple([pair for answer in here[-MAX_OF_ONE:] for pair in answer.committed])
        question = 0 if chunk.data else chunk.position
        sacks = [self._sack(transfer, question) for transfer in self._from(custodian)[:1]]
        return [*([Committed(self._id, custodian, pairs, ())] if pairs else []), *sacks]

    def _sack(self, transfer: Receiving, question: int) -> Sack:
        """What has arrived in this transfer, and in others of the same sender."""
        custodian = transfer.offer.sender
        self._unreported[custodian] = 0
        further = [t.report(OTHER_BITS) for t in self._from(custodian) if t is not transfer]
        report = transfer.report(REPORT_BITS)
        return Sack(self._id, custodian, *report, question, tuple(further[:MAX_OTHERS]))

    def _committed(self, offer: Offer, content_hash: int) -> Committed:
        return Committed(self._id, offer.sender, ((offer.number, content_hash),), ())

    def _refused(self, offer: Offer) -> Committed:
        return Committed(self._id, offer.sender, (), (offer.number,))
