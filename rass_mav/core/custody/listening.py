"""Large data that neighbours hand over to others. Their chunks are heard here too, and cost no airtime.

A datum of which all chunks were heard is overheard, like a small one. The chunks of the others wait in memory until
this node is offered the datum: then only the rest is sent. No node counts on them, and they change nothing else. A
forged chunk costs as much as one in a transfer to this node, which then has to begin anew.
"""

from __future__ import annotations

from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.overheard import KEPT_TURNS
from rass_mav.core.custody.receiving import Content, Receiving, content_of
from rass_mav.core.datum import MAX_PAYLOAD
from rass_mav.core.messages import Accept, Chunk, Handover, Offer
from rass_mav.core.pace import Pace
from rass_mav.core.routes.table import RoutingTable

#: How many data are listened to, their bytes, and how many offers are remembered until they are answered.
MAX_PARTS, MAX_BYTES, MAX_OFFERS = 64, 4 << 20, 64
#: Bound: Data and offers of one neighbour are one in this many.
SHARE = 4


class Listening:
    """What one node hears of transfers between others."""

    __slots__ = ("_by_handle", "_custody_store", "_neighbours", "_offers", "_pace", "_parts")

    def __init__(self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace) -> None:
        self._custody_store = custody_store
        self._neighbours = routing.neighbours
        self._pace = pace
        self._offers: dict[tuple[int, int, int], Offer] = {}
        """By sender, receiver and number, the oldest first."""
        self._parts: dict[Content, Receiving] = {}
        self._by_handle: dict[int, Receiving] = {}
        """The same by the names that their receivers have given them last."""

    def on_offer(self, offer: Offer) -> None:
        """A neighbour offers a datum to another node."""
        if offer.sender not in self._neighbours or not self._is_wanted(content_of(offer)):
            return
        key, offers = (offer.sender, offer.target, offer.number), self._offers
        offers.pop(key, None)
        offers[key] = offer
        of_custodian = [key for key in offers if key[0] == offer.sender]
        if len(of_custodian) > MAX_OFFERS // SHARE:
            del offers[of_custodian[0]]
        elif len(offers) > MAX_OFFERS:
            del offers[next(iter(offers))]

    def _is_wanted(self, content: Content) -> bool:
        custody_store, id = self._custody_store, content.id
        return (
            content.size <= MAX_PAYLOAD
            and id not in custody_store.arrived
            and id not in custody_store.holdings
            and id not in custody_store.overheard.data
            and not custody_store.has_id_conflict(id)
        )

    def on_accept(self, accept: Accept, now: float) -> None:
        """The other node has answered an offer: its chunks will have this handle."""
        offer = self._offers.pop((accept.target, accept.sender, accept.number), None)
        if offer is None or not self._is_wanted(content := content_of(offer)):
            return
        part = self._parts.setdefault(content, Receiving(offer, accept.handle, now))
        if self._by_handle.get(part.handle) is part:
            del self._by_handle[part.handle]
        part.offer, part.handle, part.heard = offer, accept.handle, now
        self._by_handle[accept.handle] = part
        self._make_way([part for part in self._parts.values() if part.offer.sender == offer.sender], SHARE)
        self._make_way(list(self._parts.values()), 1)

    def _make_way(self, parts: list[Receiving], share: int) -> None:
        """Forget what was not heard for longest, until these are no more than one in `share` of all that may be."""
        parts.sort(key=lambda part: part.heard)
        while len(parts) > MAX_PARTS // share or sum(part.offer.size for part in parts) > MAX_BYTES // share:
            self.take(parts.pop(0).content)

    def take(self, content: Content) -> dict[int, bytes]:
        """The chunks that were heard of a datum, by index. They are not kept here any more."""
        part = self._parts.pop(content, None)
        if part is None:
            return {}
        if self._by_handle.get(part.handle) is part:
            del self._by_handle[part.handle]
        return part.chunks

    def on_chunk(self, chunk: Chunk, now: float) -> None:
        """A piece of a datum, or a question, for another node."""
        part = self._by_handle.get(chunk.handle)
        if part is None or not part.take(chunk, now) or not part.complete:
            return
        self.take(part.content)
        datum = part.datum()
        if datum is not None:
            self._custody_store.overhear(part.offer.sender, [Handover(0, datum)], now)

    def age(self, now: float) -> None:
        """Forget what was not heard for long, and what has come to this node or to a base in another way."""
        before = now - KEPT_TURNS * self._pace.turn_s
        for content, part in list(self._parts.items()):
            if part.heard < before or not self._is_wanted(content):
                self.take(content)
