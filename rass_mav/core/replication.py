"""Replication for policies that copy instead of handing over: Buzz's virtual stigmergy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .datum import Datum, DatumId
from .messages import Put

if TYPE_CHECKING:
    from .node import Node


def wins(lamport: int, writer: int, over_lamport: int, over_writer: int) -> bool:
    """Whether a write beats another: the later Lamport timestamp, between equals the higher robot id."""
    return (lamport, writer) > (over_lamport, over_writer)


class Replica:
    """A node's share of the stigmergy: versions of what the inventory holds."""

    __slots__ = ("node", "versions")

    def __init__(self, node: Node) -> None:
        self.node = node
        self.versions: dict[DatumId, tuple[int, int]] = {}
        """(Lamport timestamp, robot id of the writer) of each entry held."""

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

    def forget(self, id: DatumId) -> None:
        """The entry is not held any more."""
        self.versions.pop(id, None)
        self.node.fresh.pop(id, None)

    def merge(self, put: Put) -> None:
        """A neighbour broadcast an entry: keep it if it wins and there is room, and tell it on."""
        node = self.node
        id = put.datum.id
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
        elif node.room_for(len(put.datum.payload)):
            node.hold(put.datum.arrived())
        else:
            node.refused += 1
            return
        self.versions[id] = (put.lamport, put.writer)
        node.fresh[id] = None
        if node.base:
            node.observer.delivered(put.datum)
