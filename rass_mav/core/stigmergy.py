"""Virtual stigmergy (Buzz; Pinciroli and Beltrame, 2016): a participant that copies instead of handing over.

A node that learns something new broadcasts it once, and every node with space keeps it. A base is a peer like the
others.

An entry whose value was found corrupt keeps its place in the store: the node knows the key, asks a random neighbour for
the value (as Buzz does when it reads an entry), and stores it again. Entries thus stay in all stores, and new entries
find no space. This is why the stigmergy in the paper fills up permanently.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Any

from rass_mav.core import messages
from rass_mav.core.custody.holdings import Holding, Holdings
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import INLINE_BYTES, QUERY_IDS, Committed, Message
from rass_mav.core.participant import Participant

#: How often a lost value is asked for before its place is released.
MAX_QUERIES = 50


def wins(lamport: int, writer: int, over_lamport: int, over_writer: int) -> bool:
    """Whether a write beats another: the later Lamport timestamp wins; if they are equal, the higher robot id."""
    return (lamport, writer) > (over_lamport, over_writer)


class StigmergyNode(Participant):
    """A participant in a virtual stigmergy."""

    __slots__ = ("_dirty", "_fresh", "missing", "refused", "versions")

    def _take_up(self, now: float) -> Holdings:
        self.versions: dict[DatumId, tuple[int, int]] = {}
        """(Lamport timestamp, robot id of the writer) of each entry held."""
        self.missing: dict[DatumId, int] = {}
        """Keys whose values were lost to corruption, and how often they were asked for. Bounded by the capacity."""
        self.refused = 0
        """Entries refused for lack of space."""
        self._fresh: dict[DatumId, None] = {}
        """Entries that came in since they were last broadcast."""
        self._dirty = False
        """Whether an entry came in that `forward` has not looked at."""
        return Holdings(self.store, self.settings, self.settings.capacity(self.policy.own_share), self.exchange)

    # -- Alg. 1, with copies -------------------------------------------------------------------------------------------

    def step(self, now: float) -> list[Message]:
        """One turn. Returns what to send, the beacon first."""
        self._steps += 1
        for holding in self.holdings.damaged(self.settings.store.scrub_items):
            self._drop(holding, Fate.CORRUPTED)
        self.pace.begin_turn()
        lifetime_s = self.settings.data.lifetime_s
        if lifetime_s is not None:
            for holding in self.holdings.older(now - lifetime_s):
                self._drop(holding, Fate.EXPIRED)
        for holding in self.holdings.by_terms.ended(now):
            if self._load(holding) is not None:
                self._drop(holding, Fate.EXPIRED)
        self.update_routing_table(now)
        out: list[Message] = [self.update_fitness(now)]
        self._ask(out)
        self._dirty = False
        self._broadcast(out)
        return out

    def forward(self, now: float) -> list[Message]:
        """Broadcast new entries at once."""
        out: list[Message] = []
        if self._dirty:
            self._dirty = False
            self._broadcast(out)
        return out

    def _broadcast(self, out: list[Message]) -> None:
        """Broadcast new entries, first in first out, within the bandwidth."""
        if not self.routing.neighbours:
            return
        for id in list(islice(self._fresh, max(self.pace.left, 0))):
            del self._fresh[id]
            self._say(id, out)

    def _say(self, id: DatumId, out: list[Message]) -> None:
        holding = self.holdings.get(id)
        datum = None if holding is None else self._load(holding)
        if datum is not None:
            self.pace.spend()
            lamport, writer = self.versions.get(id, (1, id.origin))
            out.append(messages.Put(self.id, lamport, writer, datum))

    def _ask(self, out: list[Message]) -> None:
        """Ask a neighbour, chosen at random, for lost values."""
        if not self.missing or not self.routing.neighbours:
            return
        neighbours = list(self.routing.neighbours)
        ids = list(self.missing)[:QUERY_IDS]
        out.append(messages.Query(self.id, neighbours[self.rng.randrange(len(neighbours))], tuple(ids)))
        for id in ids:
            tries = self.missing.pop(id) + 1
            if tries < MAX_QUERIES:
                # Move it to the end, so that the others have their turn.
                self.missing[id] = tries
        self.holdings.reserved = len(self.missing)

    # -- stored entries ------------------------------------------------------------------------------------------------

    @property
    def most_bytes(self) -> int:
        """An entry goes whole in one frame."""
        return INLINE_BYTES

    def _has_room(self, size: int, *, own: bool) -> bool:
        return self.holdings.room_for(size, own=own) and self.store.room_for(size)

    def _has_room_for_own(self, size: int) -> bool:
        return self._has_room(size, own=True)

    def _keep_own(self, datum: Datum) -> None:
        self._keep(datum)
        self.versions[datum.id] = (1, self.id)
        self._fresh[datum.id] = None

    def _keep(self, datum: Datum) -> None:
        self.holdings.add(datum)
        self._dirty = True
        self.observer.gained(datum)

    def _load(self, holding: Holding) -> Datum | None:
        """The value of an entry. None: it is corrupt, and has been dropped."""
        datum = self.store.get(holding.id)
        if datum is not None and datum.intact:
            return datum
        self._drop(holding, Fate.CORRUPTED)
        return None

    def _drop(self, holding: Holding, fate: Fate) -> None:
        """The entry is no longer held. If it was corrupt its place is kept."""
        id = holding.id
        self.store.count(fate.value)
        self.versions.pop(id, None)
        self._fresh.pop(id, None)
        if fate is Fate.CORRUPTED:
            self.missing[id] = 0
            self.holdings.reserved = len(self.missing)
        self.holdings.remove(holding, fate)
        self.observer.dropped(id, fate)

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {"sent_data": self.pace.sent, "refused": self.refused, "corrupt_received": 0, "handovers_pending": 0}

    # -- incoming messages ---------------------------------------------------------------------------------------------

    def receive(self, message: Message, now: float) -> list[Message]:
        """A message from a neighbour. Returns the answers; they may be sent once the store has committed."""
        return HANDLERS[type(message)](self, message, now)

    def _on_put(self, put: messages.Put, now: float) -> list[Message]:
        """A neighbour broadcast an entry: keep it if it wins and there is space, and relay it."""
        id, size = put.datum.id, len(put.datum.payload)
        if not put.datum.intact:
            return []
        lost = self.missing.pop(id, None) is not None
        self.holdings.reserved = len(self.missing)
        held = self.holdings.get(id)
        if held is not None:
            lamport, writer = self.versions.get(id, (1, id.origin))
            if not wins(put.lamport, put.writer, lamport, writer):
                return []
            growth = size - held.size
            if growth > 0 and not (self.store.room_for(growth) and self.holdings.room_to_grow(growth)):
                self.refused += 1
                return []
            self.holdings.add(put.datum.arrived())
        elif self.store.accepting and self._has_room(size, own=False):
            self._keep(put.datum.arrived())
        else:
            self.refused += 1
            return []
        self.versions[id] = (put.lamport, put.writer)
        if not lost:
            self._fresh[id] = None
        if self.base:
            self.observer.delivered(put.datum)
        return []

    def _on_query(self, query: messages.Query, now: float) -> list[Message]:
        """The requested values, if they are here and bandwidth is left in this step."""
        out: list[Message] = []
        for id in query.ids:
            if self.pace.left <= 0:
                break
            self._say(id, out)
        return out

    def _on_data(self, data: messages.Data, now: float) -> list[Message]:
        """Custody is refused: this node would not move the data on."""
        numbers = tuple(number for number, _ in data.handovers if number)
        return [Committed(self.id, data.sender, (), numbers)] if numbers else []

    def _on_offer(self, offer: messages.Offer, now: float) -> list[Message]:
        return [Committed(self.id, offer.sender, (), (offer.number,))]


#: The handler of each message. Messages about custody, arrivals and losses are for `Node`.
HANDLERS: dict[type, Callable[[StigmergyNode, Any, float], list[Message]]] = {
    messages.Beacon: StigmergyNode._on_beacon,
    messages.Data: StigmergyNode._on_data,
    Committed: StigmergyNode._ignore,
    messages.Offer: StigmergyNode._on_offer,
    messages.Accept: StigmergyNode._ignore,
    messages.Chunk: StigmergyNode._ignore,
    messages.Sack: StigmergyNode._ignore,
    messages.Receipt: StigmergyNode._ignore,
    messages.DeletionReport: StigmergyNode._ignore,
    messages.Put: StigmergyNode._on_put,
    messages.Query: StigmergyNode._on_query,
    messages.CopyStatuses: StigmergyNode._ignore,
    messages.SequenceMark: StigmergyNode._ignore,
}
