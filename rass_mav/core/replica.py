"""Replication for policies that copy instead of handing over: Buzz's virtual stigmergy.

An entry whose value was found corrupt keeps its place in the store: the node knows the key, asks a neighbour at random
for the value (as Buzz does when it reads an entry), and takes it back. So what is in the store stays in all stores, and
new entries find no room: this is why the paper sees the stigmergy fill up once and for all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import Message, Put, Query

if TYPE_CHECKING:
    from rass_mav.core.node import Node


def wins(lamport: int, writer: int, over_lamport: int, over_writer: int) -> bool:
    """Whether a write beats another: the later Lamport timestamp, between equals the higher robot id."""
    return (lamport, writer) > (over_lamport, over_writer)


#: Keys in one query (what fits a frame).
QUERY_IDS = 12
#: A lost value is asked for so many times; then its place is given up.
MAX_QUERIES = 50


class Replica:
    """A node's share of the stigmergy: versions of what the inventory holds, and the keys whose values are lost."""

    __slots__ = ("missing", "node", "versions")

    def __init__(self, node: Node) -> None:
        self.node = node
        self.versions: dict[DatumId, tuple[int, int]] = {}
        """(Lamport timestamp, robot id of the writer) of each entry held."""
        self.missing: dict[DatumId, int] = {}
        """Keys whose values were lost to corruption, and how often they were asked for. Bounded by the capacity."""

    def wrote(self, id: DatumId) -> None:
        """This node wrote an entry: it is new to everybody."""
        lamport, _ = self.versions.get(id, (0, 0))
        # 16 bits on the wire: at the end of the scale a write is no longer later than another.
        self.versions[id] = (min(lamport + 1, 0xFFFF), self.node.id)
        self.node.fresh[id] = None

    def message(self, datum: Datum) -> Put:
        """The entry as it is broadcast."""
        lamport, writer = self.versions.get(datum.id, (1, datum.id.origin))
        return Put(self.node.id, lamport, writer, datum)

    def forget(self, id: DatumId, fate: Fate) -> None:
        """The entry is not held any more. If it was corrupt its place is kept."""
        self.versions.pop(id, None)
        self.node.fresh.pop(id, None)
        if fate is Fate.CORRUPTED:
            self.missing[id] = 0
            self.node.inventory.reserved = len(self.missing)

    def _found(self, id: DatumId) -> None:
        if self.missing.pop(id, None) is not None:
            self.node.inventory.reserved = len(self.missing)

    def ask(self, out: list[Message]) -> None:
        """Ask a neighbour, chosen at random, for lost values."""
        node = self.node
        if not self.missing or not node.routing.neighbours:
            return
        neighbours = list(node.routing.neighbours)
        ids = list(self.missing)[:QUERY_IDS]
        out.append(Query(node.id, neighbours[node.rng.randrange(len(neighbours))], tuple(ids)))
        for id in ids:
            tries = self.missing.pop(id) + 1
            if tries < MAX_QUERIES:
                # To the end, so that the others have their turn.
                self.missing[id] = tries
        node.inventory.reserved = len(self.missing)

    def answer(self, query: Query) -> list[Message]:
        """The values asked for, as far as they are here and bandwidth is left in this step."""
        node = self.node
        out: list[Message] = []
        for id in query.ids:
            if node.percolation.budget <= 0:
                break
            datum = node.load(id) if id in node.inventory else None
            if datum is not None:
                node.percolation.spend()
                out.append(self.message(datum))
        return out

    def merge(self, put: Put) -> None:
        """A neighbour broadcast an entry: keep it if it wins and there is room, and tell it on."""
        node = self.node
        id = put.datum.id
        lost = id in self.missing
        self._found(id)
        held = id in node.inventory
        if held:
            lamport, writer = self.versions.get(id, (1, id.origin))
            if not wins(put.lamport, put.writer, lamport, writer):
                return
            growth = len(put.datum.payload) - node.inventory.info(id).size
            if growth > 0 and not (node.store.room_for(growth) and node.inventory.room_to_grow(growth)):
                node.refused += 1
                return
            node.inventory.add(put.datum.arrived())
        elif node.may_accept(len(put.datum.payload)):
            node.hold(put.datum.arrived())
        else:
            node.refused += 1
            return
        self.versions[id] = (put.lamport, put.writer)
        if not lost:
            node.fresh[id] = None
        if node.base:
            node.observer.delivered(put.datum)
