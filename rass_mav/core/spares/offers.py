"""Spare copies on offer: what is in custody without a backer is offered to the safest neighbour.

Only data that go whole in one frame are. An offer is answered like a hand-over, but it is not one: custody stays here.

With `NodeSettings.copies_auto` a datum gets as many spares, on different neighbours, as its risk asks for. While it
lies here it is struck before the next step with probability r. If it is being handed over, it lies here only if the
receiver turns out to have gone, and `gone` is the share of neighbours to which that happens. A neighbour j does not
save it if it has gone, or is struck itself: f_j = gone + (1 - gone) r_j. So it gets one more spare, on the safest
neighbour that has none, as long as the product of

    r,  gone (while it is being handed over),  f_j of each neighbour that has a spare or is offered one

exceeds 1 - `TARGET`. Where nobody moves away and data move on at once, that is never.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf
from typing import TYPE_CHECKING

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BEACON_BASE, Committed, Data, Handover, Message
from rass_mav.core.routes.neighbours import Neighbour

if TYPE_CHECKING:
    from rass_mav.core.node import Node

#: An offer that was not answered is made again after so many steps (turns, where they are longer).
OFFER_STEPS = 2
#: A neighbour that refused a spare is offered none for so many steps, or turns.
REFUSED_STEPS = 5
#: How fast the share of neighbours that fall silent follows what happens.
GONE_GAIN = 0.05
#: The chance that a datum should have to survive the next step, with `copies_auto`.
TARGET = 0.999


class SpareOffers:
    """What needs spares in one node, and what has been offered to whom."""

    __slots__ = ("_fresh", "_node", "_numbers", "_offered", "_refused", "bare", "gone")

    def __init__(self, node: Node) -> None:
        self._node = node
        self.bare: dict[DatumId, float] = {}
        """Small data in custody without a backer: when a spare may be offered next, seconds."""
        self._fresh: dict[DatumId, None] = {}
        """Small data that came into custody in this step, and have a backer: the giver."""
        self._offered: dict[int, tuple[DatumId, int]] = {}
        """Spares on offer by hand-over number: the datum, to whom. One a datum and neighbour at most."""
        self._numbers: dict[DatumId, list[int]] = {}
        """Their numbers."""
        self.gone = 0.0
        """Share of the neighbours that fall silent from one step to the next, of late; 0..1."""
        self._refused: dict[int, float] = {}
        """Neighbours that refused a spare: until when they are offered none."""

    def need(self, id: DatumId) -> None:
        """A datum in custody has no backer (any more)."""
        if self._is_small(id):
            self.bare[id] = -inf

    def came(self, id: DatumId) -> None:
        """A datum was handed over to this node: whoever gave it keeps a spare."""
        if self._node.settings.copies_auto and self._is_small(id):
            self._fresh[id] = None

    def _is_small(self, id: DatumId) -> bool:
        node = self._node
        return node.inventory.info(id).size <= node.settings.inline_bytes

    def settle(self, id: DatumId) -> None:
        """A datum needs no backer, for it has one, or has left custody: answers to offers will be ignored."""
        self._cancel(id)
        self.bare.pop(id, None)
        self._fresh.pop(id, None)

    def _cancel(self, id: DatumId) -> None:
        for number in self._numbers.pop(id, ()):
            del self._offered[number]

    def step(self, now: float) -> None:
        """Once a step: who refused long ago may be asked again; how many neighbours have fallen silent?"""
        self._fresh.clear()
        if self._node.settings.copies_auto:
            self._count_gone(now)
        if self._refused:
            self._refused = {id: until for id, until in self._refused.items() if until > now}

    def _count_gone(self, now: float) -> None:
        turns = [(now - n.heard) / n.turn_s for n in self._node.routing.neighbours.values()]
        here = sum([age < 1.5 for age in turns])
        silent = sum([1.5 <= age < 2.5 for age in turns])
        if silent or here:
            self.gone += GONE_GAIN * (silent / (here + silent) - self.gone)

    def spread(self, now: float, out: list[Message], of: Iterable[DatumId] | None = None) -> None:
        """Send spares of data that rest without a backer to the safest neighbours, within the bandwidth.

        `of`: of these data only, all without a backer.
        """
        node, bare = self._node, self.bare
        pending, gone = node.custody.pending, self.gone
        auto = node.settings.copies_auto
        ids = [id for id in (bare if of is None else of) if bare[id] <= now and (auto or id not in pending)]
        if self._fresh and of is None:
            ids += self._fresh
            self._fresh.clear()
        if not ids or node.percolation.budget <= 0:
            return
        mirrors = node.mirrors
        assert mirrors is not None
        risk = node.risk.risk(now)
        safest = self._safest_first(now)
        room = {neighbour.id: neighbour.beacon.free for neighbour in safest}
        batches: dict[int, list[Handover]] = {}
        for id in ids:
            way, backer = pending.get(id), mirrors.backer.get(id)
            loss = risk if way is None else risk * gone
            if backer is not None:
                loss *= self._failing(node.routing.neighbours.get(backer), gone)
            # What rests alone gets one spare, however safe it is here.
            wanting = way is None and backer is None
            for neighbour in safest:
                to = neighbour.id
                if not wanting and (not auto or loss <= 1.0 - TARGET):
                    break
                if not room[to] or to == backer or (way is not None and to == way.neighbour):
                    continue
                # What the giver has too must not take what is kept for new data.
                kept = 0 if backer is None else node.percolation.kept
                datum = node.load(id) if node.percolation.budget > kept else None
                if datum is None:
                    break
                batches.setdefault(to, []).append(Handover(self._offer(id, to, now), datum))
                node.percolation.spend()
                room[to] -= 1
                loss *= self._failing(neighbour, gone)
                wanting = False
        for to, handovers in batches.items():
            out.append(Data(node.id, to, tuple(handovers), True))

    def _offer(self, id: DatumId, to: int, now: float) -> int:
        """A number for an offer that is being made; offers of earlier steps are forgotten."""
        node = self._node
        again_at = now + (OFFER_STEPS - 0.5) * max(node.turn_s, node.routing.longest_turn_s)
        if id in self._numbers and self.bare.get(id) != again_at:
            self._cancel(id)
        number = node.custody.draw()
        self._offered[number] = (id, to)
        self._numbers.setdefault(id, []).append(number)
        if id in self.bare:
            self.bare[id] = again_at
        return number

    @staticmethod
    def _failing(neighbour: Neighbour | None, gone: float) -> float:
        """The chance that a spare with this neighbour does not help, f of the module's text."""
        return 1.0 if neighbour is None else gone + (1.0 - gone) * neighbour.beacon.risk / 65535.0

    def _safest_first(self, now: float) -> list[Neighbour]:
        """The neighbours that may have room for a spare, lowest risk first; among equals chance decides."""
        node = self._node
        safest = [
            neighbour
            for neighbour in node.routing.neighbours.values()
            if neighbour.heard >= now - 1.5 * neighbour.turn_s
            and neighbour.beacon.free
            and not neighbour.beacon.flags & BEACON_BASE
            and self._refused.get(neighbour.id, now) <= now
        ]
        node.rng.shuffle(safest)
        safest.sort(key=_risk)
        return safest

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
                self._refused[sender] = now + REFUSED_STEPS * node.routing.longest_turn_s
                if id in self.bare:
                    self.bare[id] = -inf
                    again.append(id)
        if again:
            self.spread(now, out, again)

    def disagreement(self) -> str:
        """What these tables say differently, for checks; empty: nothing."""
        if not self._numbers.keys() <= set(self._node.inventory):
            return "a spare is on offer of a datum that is not in custody"
        if self._offered.keys() != {number for numbers in self._numbers.values() for number in numbers}:
            return "offers and their numbers are not the same"
        return ""


def _risk(neighbour: Neighbour) -> int:
    return neighbour.beacon.risk
