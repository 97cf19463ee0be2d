"""What must always hold in a mock swarm (docs/contribute/architecture.md), checked in full after a step."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.news.deletion_reports import MAX_NOTES
from rass_mav.core.news.receipts import Receipts
from rass_mav.lab.ledger import InvariantError

if TYPE_CHECKING:
    from rass_mav.lab.disk.power import Power
    from rass_mav.lab.swarm.virtual import VirtualSwarm

#: How many of the consecutive numbers are looked up: the last ones.
LOOKED_AT = 32


def check(world: VirtualSwarm) -> None:
    """All invariants, in full. Raises `InvariantError`."""
    ledger = world.ledger
    if ledger.created != len(ledger.arrived) + ledger.held + sum(ledger.losses().values()):
        raise InvariantError(
            f"step {world.t - 1}: created {ledger.created} != delivered {len(ledger.arrived)} + held {ledger.held} "
            f"+ lost {ledger.losses()}"
        )
    copies = Counter(id for agent in world.agents if not agent.node.base for id in agent.node.holdings)
    if world.power is not None:
        copies = _check_disks(world, world.power)
    # With attackers present, some copies are of data that no node created: the ledger leaves them out.
    if world.hostile is None and copies != Counter(ledger.copies):
        raise InvariantError(f"step {world.t - 1}: the ledger's copies are not those in the inventories")
    flips = world.power is not None and world.power.settings.flip_rate > 0.0
    # Flipped bits may make a node forget its last number, and then two data have the same.
    if ledger.altered and not flips:
        raise InvariantError(f"step {world.t - 1}: {ledger.altered} data were delivered with other bytes than created")
    if world.loops:
        raise InvariantError(f"step {world.t - 1}: the next hops form a cycle")
    for node_id, agent in enumerate(world.agents):
        if world.power is not None and node_id in world.off:
            continue
        node = agent.node
        holdings = node.holdings
        stored = list(world.stores[node_id].ids())
        if not node.sink and (len(stored), set(stored)) != (len(holdings), set(holdings)):
            raise InvariantError(f"step {world.t - 1}: node {node_id}: its store does not match its records")
        capacity = holdings.capacity_items
        # More may be salvaged from a damaged store than it held: data that were passed on come back.
        if capacity is not None and len(holdings) > capacity and not flips:
            raise InvariantError(f"step {world.t - 1}: node {node_id} holds {len(holdings)} > {capacity}")
        if len(node.routing.neighbours) > agent.settings.routing.max_neighbours:
            raise InvariantError(f"step {world.t - 1}: node {node_id}: its neighbour table is too long")
        if isinstance(node.receipts, Receipts) and (wrong := node.receipts.disagreement()):
            raise InvariantError(f"step {world.t - 1}: node {node_id}: {wrong}")
        if node.figures().get("loss_notes", 0) > MAX_NOTES:
            raise InvariantError(f"step {world.t - 1}: node {node_id}: it keeps too many deletion reports")
    # One node a step: this takes long.
    looked_at = world.t % len(world.agents)
    if world.power is None or looked_at not in world.off:
        _check_receipts(world, looked_at)


def _check_disks(world: VirtualSwarm, power: Power) -> Counter[DatumId]:
    """Every datum whose commit is done is on a disk, or at a base, or an attacker that may take it has taken it.

    Returns the copies on drones' disks.
    """
    losses = world.ledger.losses()
    lost = losses[Fate.VANISHED.value] + losses[Fate.UNFOUNDED.value]
    if lost and world.agents[0].settings.custody.mode == "acknowledged":
        raise InvariantError(f"step {world.t - 1}: {lost} data that a disk had are lost, and no attacker took them")
    copies: Counter[DatumId] = Counter()
    for node_id, computer in enumerate(power.computers):
        recorded = computer.diary.stored
        if not world.agents[node_id].node.base:
            copies.update(recorded)
        if node_id in world.off or power.settings.flip_rate:
            continue
        stored = set(computer.store.ids())
        if not {id for id in stored if computer.store.durable(id)} <= recorded <= stored.union(computer.diary.leaving):
            raise InvariantError(f"step {world.t - 1}: node {node_id}: its disk does not have what it should")
    return copies


def _check_receipts(world: VirtualSwarm, node_id: int) -> None:
    """A node knows of no arrival that never happened."""
    receipts = world.agents[node_id].node.receipts
    for (origin, epoch), known in receipts.arrivals().items():
        for first, end in known:
            for sequence in range(max(first, end - LOOKED_AT), end):
                id = DatumId(origin, epoch, sequence)
                # A datum that is being written to a base's disk has not arrived yet, and the base states nothing about
                # it.
                if id not in world.ledger.arrived and world.stores[node_id].durable(id):
                    raise InvariantError(f"step {world.t - 1}: node {node_id} believes that {id} has arrived")
