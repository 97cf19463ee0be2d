"""What must always hold in a mock swarm (docs/architecture.md), checked in full after a step."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rass_mav.core.datum import DatumId
from rass_mav.core.news.arrivals import WINDOW_BITS, has_arrived
from rass_mav.core.news.notes import MAX_NOTES
from rass_mav.swarm.errors import InvariantError

if TYPE_CHECKING:
    from rass_mav.swarm.virtual import VirtualSwarm


def check(world: VirtualSwarm) -> None:
    """All invariants, in full. Raises `InvariantError`."""
    ledger = world.ledger
    if ledger.created != len(ledger.arrived) + ledger.held + sum(ledger.losses().values()):
        raise InvariantError(
            f"step {world.t - 1}: created {ledger.created} != delivered {len(ledger.arrived)} + held {ledger.held} "
            f"+ lost {ledger.losses()}"
        )
    copies = Counter(id for agent in world.agents if not agent.node.base for id in agent.node.holdings)
    if copies != Counter(ledger.copies):
        raise InvariantError(f"step {world.t - 1}: the ledger's copies are not those in the inventories")
    if ledger.altered:
        raise InvariantError(f"step {world.t - 1}: {ledger.altered} data were delivered with other bytes than created")
    if world.loops:
        raise InvariantError(f"step {world.t - 1}: the next hops form a cycle")
    for node_id, agent in enumerate(world.agents):
        node = agent.node
        holdings = node.holdings
        stored = list(world.stores[node_id].ids())
        if not node.sink and (len(stored), set(stored)) != (len(holdings), set(holdings)):
            raise InvariantError(f"step {world.t - 1}: node {node_id}: its store is not what it holds")
        capacity = node.settings.capacity_items
        if capacity is not None and len(holdings) > capacity:
            raise InvariantError(f"step {world.t - 1}: node {node_id} holds {len(holdings)} > {capacity}")
        if len(node.routing.neighbours) > agent.settings.routing.max_neighbours:
            raise InvariantError(f"step {world.t - 1}: node {node_id}: its neighbour table is too long")
        if node.figures().get("loss_notes", 0) > MAX_NOTES:
            raise InvariantError(f"step {world.t - 1}: node {node_id}: it keeps too many loss notes")
    # One node a step: this takes long.
    _check_receipts(world, world.t % len(world.agents))


def _check_receipts(world: VirtualSwarm, node_id: int) -> None:
    """A node knows of no arrival that never was."""
    receipts = world.agents[node_id].node.receipts
    for (origin, epoch), known in receipts.known().items():
        closed, _, _, floor = known
        for sequence in range(max(floor, closed - WINDOW_BITS), closed + WINDOW_BITS + 1):
            id = DatumId(origin, epoch, sequence)
            if has_arrived(known, sequence) and id not in world.ledger.arrived:
                raise InvariantError(f"step {world.t - 1}: node {node_id} thinks that {id} has arrived")
