"""Spares for data that rest: what is in custody without a backer is offered to the safest neighbour.

Only data that go whole in one frame are. An offer is answered like a hand-over, but it is not one: custody stays here.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf
from typing import TYPE_CHECKING

from .datum import DatumId
from .messages import BEACON_BASE, Committed, Data, Handover, Message
from .routing import Neighbour

if TYPE_CHECKING:
    from .node import Node

#: An offer that was not answered is made again after so many steps (turns, where they are longer).
OFFER_STEPS = 2
#: A neighbour that refused a spare is offered none for so many steps, or turns.
REFUSED_STEPS = 5


class SpareOffers:
    """What needs a backer in one node, and what has been offered to whom."""

    __slots__ = ("_node", "_number", "_offered", "_refused", "bare")

    def __init__(self, node: Node) -> None:
        self._node = node
        self.bare: dict[DatumId, float] = {}
        """Small data in custody without a backer: when a spare may be offered next, seconds."""
        self._offered: dict[int, tuple[DatumId, int]] = {}
        """Spares on offer by hand-over number, one for each bare datum at most: the datum, to whom."""
        self._number: dict[DatumId, int] = {}
        """Their numbers."""
        self._refused: dict[int, float] = {}
        """Neighbours that refused a spare: until when they are offered none."""

    def need(self, id: DatumId) -> None:
        """A datum in custody has no backer (any more)."""
        node = self._node
        if node.inventory.info(id).size <= node.settings.inline_bytes:
            self.bare[id] = -inf

    def settle(self, id: DatumId) -> None:
        """A datum needs no backer, for it has one, or has left custody: answers to an offer will be ignored."""
        self._cancel(id)
        self.bare.pop(id, None)

    def _cancel(self, id: DatumId) -> None:
        number = self._number.pop(id, None)
        if number is not None:
            del self._offered[number]

    def step(self, now: float) -> None:
        """Once a step: who refused long ago may be asked again."""
        if self._refused:
            self._refused = {id: until for id, until in self._refused.items() if until > now}

    def spread(self, now: float, out: list[Message], of: Iterable[DatumId] | None = None) -> None:
        """Send a spare of each datum that rests without a backer to the safest neighbour, within the bandwidth.

        `of`: of these data only, all without a backer.
        """
        bare = self.bare
        if not bare:
            return
        node = self._node
        percolation, custody = node.percolation, node.custody
        ids = [id for id in (bare if of is None else of) if bare[id] <= now and id not in custody.pending]
        target = self._safest(now) if ids else None
        if target is None:
            return
        handovers: list[Handover] = []
        for id in ids[: min(percolation.budget, target.beacon.free)]:
            datum = node.load(id)
            if datum is None:
                continue
            self._cancel(id)
            number = custody.draw()
            self._offered[number] = (id, target.id)
            self._number[id] = number
            self.bare[id] = now + (OFFER_STEPS - 0.5) * max(node.turn_s, target.turn_s)
            percolation.spend()
            handovers.append(Handover(number, datum))
        if handovers:
            out.append(Data(node.id, target.id, tuple(handovers), True))

    def _safest(self, now: float) -> Neighbour | None:
        """The neighbour with the lowest risk that may have room for a spare; among equals chance decides."""
        node = self._node
        safest: list[Neighbour] = []
        for neighbour in node.routing.neighbours.values():
            beacon = neighbour.beacon
            if (
                neighbour.heard < now - 1.5 * neighbour.turn_s
                or not beacon.free
                or beacon.flags & BEACON_BASE
                or self._refused.get(neighbour.id, now) > now
            ):
                continue
            if not safest or beacon.risk < safest[0].beacon.risk:
                safest = [neighbour]
            elif beacon.risk == safest[0].beacon.risk:
                safest.append(neighbour)
        if len(safest) > 1:
            return safest[node.rng.randrange(len(safest))]
        return safest[0] if safest else None

    def answered(self, message: Committed, now: float, out: list[Message]) -> None:
        """A neighbour took spares, or refused them: then another is tried. Other numbers than of offers are ignored."""
        node = self._node
        mirrors = node.mirrors
        assert mirrors is not None
        sender = message.sender
        again: list[DatumId] = []
        for number, crc in message.committed:
            id, neighbour = self._offered.get(number, (None, None))
            if id is not None and neighbour == sender and node.inventory.info(id).crc == crc:
                mirrors.backed_by(id, sender)
        for number in message.refused:
            id, neighbour = self._offered.get(number, (None, None))
            if id is not None and neighbour == sender:
                self._cancel(id)
                self.bare[id] = -inf
                self._refused[sender] = now + REFUSED_STEPS * node.routing.longest_turn_s
                again.append(id)
        if again:
            self.spread(now, out, again)

    def disagreement(self) -> str:
        """What these tables say differently, for checks; empty: nothing."""
        if not self._number.keys() <= self.bare.keys() or self._offered.keys() != set(self._number.values()):
            return "a spare is on offer of a datum that needs none"
        return ""
