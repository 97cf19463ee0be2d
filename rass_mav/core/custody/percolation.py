"""`evict_data` of Alg. 1: what leaves a node in a step, within its bandwidth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import Data, Handover, Message
from rass_mav.core.policy import View

if TYPE_CHECKING:
    from rass_mav.core.node import Node

#: Where data move on at once, one item in so many is kept for spares of new data, which nobody else has yet.
KEPT_FOR_SPARES = 10


class Percolation:
    """Retransmissions first, then what the policy plans."""

    __slots__ = ("_batches", "_budget", "_node", "kept")

    def __init__(self, node: Node) -> None:
        self._node = node
        self._batches: dict[int, list[Handover]] = {}
        self._budget = 0
        self.kept = 0
        """Items of this step that hand-overs leave for spares."""

    @property
    def budget(self) -> int:
        """Items that may still be sent in this step."""
        return self._budget

    def begin_step(self) -> None:
        """The bandwidth of a new step."""
        node = self._node
        self._budget = node.bandwidth_items
        if node.settings.mirror and node.settings.immediate:
            self.kept = node.bandwidth_items // KEPT_FOR_SPARES

    def spend(self) -> None:
        """An item is being sent."""
        self._budget -= 1
        self._node.sent_data += 1

    def evict(self, now: float, out: list[Message]) -> None:
        """Send what has to leave; `out` receives the messages."""
        if self._node.custody.pending:
            self._retry(now, out)
        self.forward(now, out)

    def forward(self, now: float, out: list[Message]) -> None:
        """The same without the retransmissions: what the policy plans, then spares of what rests."""
        node = self._node
        batches = self._batches
        if self._budget > 0 and node.routing.neighbours:
            if self._budget > self.kept:
                self._percolate(now, out)
            if node.mirrors is not None:
                node.mirrors.offers.spread(now, out)
        if batches:
            for target, handovers in batches.items():
                out.append(Data(node.id, target, tuple(handovers)))
            batches.clear()

    def _percolate(self, now: float, out: list[Message]) -> None:
        node = self._node
        settings = node.settings
        neighbours = node.routing.neighbours
        # A neighbour whose last beacon is missing may have moved away: only if nobody else is fit is it tried.
        view = View(
            [n for n in neighbours.values() if n.heard >= now - 1.5 * n.turn_s],
            neighbours.get(node.routing.next_hop) if node.routing.next_hop is not None else None,
            node.routing.distance,
            node.potential,
            node.risk.risk(now),
            self._budget - self.kept,
            self._for_neighbour,
            node.fresh,
            node.rng,
        )
        plan = node.policy.plan(view)
        if not plan and len(view.neighbours) < len(neighbours):
            view.neighbours = neighbours.values()
            plan = node.policy.plan(view)
        for id, target, move in plan:
            large = node.inventory.info(id).size > settings.inline_bytes
            if large and not node.transfers.free(target):
                continue
            datum = node.load(id)
            if datum is None:
                continue
            if not move:
                if node.replica is not None:
                    self.spend()
                    out.append(node.replica.message(datum))
            elif large:
                node.transfers.begin(datum, target, now, out)
            else:
                self.spend()
                number = 0
                if settings.acknowledged:
                    number = node.custody.give(id, target, now).number
                else:
                    node.drop(id, Fate.PASSED_ON)
                self._batches.setdefault(target, []).append(Handover(number, datum))

    def _for_neighbour(self, neighbour: int) -> Iterator[DatumId]:
        """Held data that can be handed to a neighbour now, least recently used first.

        Large data wait while a transfer to it is under way, without holding up the small ones behind them.
        """
        node = self._node
        inventory = node.inventory
        pending = node.custody.pending
        if node.transfers.free(neighbour):
            return (id for id in inventory if id not in pending) if pending else iter(inventory)
        inline = node.settings.inline_bytes
        return (id for id in inventory if id not in pending and inventory.info(id).size <= inline)

    def _retry(self, now: float, out: list[Message]) -> None:
        """Send unanswered hand-overs again; give up on neighbours that are gone or stay silent."""
        node = self._node
        settings = node.settings
        due = now - (settings.retry_steps - 0.5) * node.turn_s
        # It has probably moved away, so another is tried before the routing table gives it up. Where beacons get lost,
        # two must be missing: it may have the datum already, and another one would make a second copy.
        neighbours = node.routing.neighbours
        for pending in list(node.custody.pending.values()):
            neighbour = neighbours.get(pending.neighbour)
            if (
                neighbour is None
                or neighbour.heard < now - (1.5 if neighbour.clean else 2.5) * neighbour.turn_s
                or pending.tries >= settings.max_tries
            ):
                node.custody.cancel(pending.id)
                node.transfers.cancel(pending.id)
                continue
            if pending.sent > due or self._budget <= 0 or node.transfers.retry(pending, now, out):
                continue
            datum = node.load(pending.id)
            if datum is not None:
                pending.tries += 1
                pending.sent = now
                self.spend()
                self._batches.setdefault(pending.neighbour, []).append(Handover(pending.number, datum))
