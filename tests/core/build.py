"""Short ways to what the tests of core need again and again."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from rass_mav.core.custody import repairs, sender
from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import (
    NO_ROUTE,
    Beacon,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    Handover,
    Message,
    Receipt,
    Route,
)
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.statements import blocks, entry_of, make_receipt, note_crc
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer
from rass_mav.core.policy import Policy
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.settings import (
    CustodySettings,
    LifetimeSettings,
    Mechanism,
    NodeSettings,
    RoutingSettings,
    StoreSettings,
)
from rass_mav.core.stigmergy import StigmergyNode
from rass_mav.policy.settings import PolicySettings
from tests.some import some

from .durable import DurableStore

#: More items than any test holds.
MANY = 50_000


@contextmanager
def tries(most: int) -> Iterator[None]:
    """Nodes give up after other counts than in flight."""
    with patch.object(sender, "MAX_TRIES", most), patch.object(repairs, "MAX_TRIES", most):
        yield


def node_settings(
    node_id: int,
    *,
    base: bool = False,
    step_s: float = 1.0,
    immediate: bool = False,
    acknowledged: bool = True,
    mirror: bool = False,
    receipts: bool = True,
    mirror_until_receipt: bool = True,
    distant: bool = False,
    overhear: bool = False,
    measured: bool = True,
    contacts: bool = False,
    queue_toll: bool = False,
    receipt_steps: int = 6,
    seq_period: int = 30,
    neighbour_steps: int = 3,
    max_neighbours: int = 128,
    capacity_items: int | None = 50,
    capacity_bytes: int | None = None,
    own_share: float = 0.0,
    drop_oldest: bool = False,
    bandwidth_items: int = 10,
    scrub_items: int | None = None,
    lifetime_s: float | None = None,
    without: tuple[Mechanism, ...] | None = None,
) -> NodeSettings:
    """A node with little: a test names the mechanisms that it is about, or with `without` those that it lacks. A drone
    has those of its replicas only with `mirror`."""
    chosen: dict[Mechanism, bool] = {
        "receipts": receipts, "lasting-replicas": mirror_until_receipt,
        "distant-replicas": distant, "overhearing": overhear, "measured-retries": measured, "contacts": contacts,
        "queue-toll": queue_toll,
    }  # fmt: skip
    return NodeSettings(
        node_id=node_id,
        base=base,
        step_s=step_s,
        forward="immediate" if immediate else "step",
        routing=RoutingSettings(
            seq_period=seq_period, neighbour_steps=neighbour_steps, max_neighbours=max_neighbours
        ),
        custody=CustodySettings(
            mode="acknowledged" if acknowledged else "none", replicas=acknowledged and (mirror or base),
            receipt_steps=receipt_steps,
        ),
        store=StoreSettings(
            capacity_items=MANY if capacity_items is None else capacity_items, capacity_bytes=capacity_bytes,
            own_share=own_share, overflow="drop-oldest" if drop_oldest else "refuse",
            bandwidth_items=bandwidth_items, scrub_items=scrub_items,
        ),
        data=LifetimeSettings(lifetime_s=lifetime_s),
        without=tuple(name for name, is_here in chosen.items() if not is_here) if without is None else without,
    )  # fmt: skip


def make_node(
    node_id: int,
    *,
    store: DurableStore | None = None,
    policy: Policy | str = "rass",
    risk: float = 0.0,
    now: float = 0.0,
    seed: int = 0,
    observer: Observer | None = None,
    newborn: bool | None = None,
    base: bool = False,
    **settings: Any,
) -> Node:
    """A node whose sensor says `risk` and goes on saying it. `settings`: those of `node_settings`."""
    estimator = RiskEstimator(stale_s=1e9)
    estimator.observe(risk, now)
    store = store or DurableStore(epoch=1000 + node_id)
    node = Node(
        node_settings(node_id, base=base, **settings),
        store,
        PolicySettings(name=policy).make() if isinstance(policy, str) else policy,
        estimator,
        random.Random(seed * 7919 + node_id),
        now=now,
        observer=observer,
        newborn=store.fresh if newborn is None else newborn,
    )
    if base and not store.busy:
        # It announces nothing before its first number is on disk.
        store.commit()
    return node


def make_stigmergy_node(node_id: int, *, store: DurableStore | None = None, **settings: Any) -> StigmergyNode:
    """A participant in a virtual stigmergy, in no danger."""
    estimator = RiskEstimator(stale_s=1e9)
    estimator.observe(0.0, 0.0)
    return StigmergyNode(
        node_settings(node_id, **settings),
        store or DurableStore(epoch=1000 + node_id),
        PolicySettings(name="stigmergy").make(),
        estimator,
        random.Random(node_id),
        now=0.0,
        newborn=True,
    )


def passed_on(sender: int, target: int, *ids: DatumId) -> CopyStatuses:
    """A custodian has passed these data on."""
    return CopyStatuses(sender, target, tuple([CopyStatusEntry(id, CopyStatus.PASSED_ON) for id in ids]))


def beacon(
    sender: int,
    number: int = 0,
    route: Route | None = None,
    *,
    life: int = 1,
    flags: int = 0,
    wanted: tuple[int, int] = (0, 0),
    free: int = 50,
    policy: int = 0,
    potential: int = 1,
    risk: int = 0,
) -> Beacon:
    base, base_life, announced, hops = route or (0, 0, 0, NO_ROUTE)
    route_fields = base, base_life, announced, hops, *wanted
    return Beacon(sender, life, number, flags, *route_fields, risk, free, policy, potential, 0)


def datum(origin: int = 9, sequence: int = 0, payload: bytes = b"reading", *, created: float = 0.0) -> Datum:
    return make_datum(DatumId(origin, 77, sequence), 0, created, payload)


def data(sender: int, target: int, *handovers: tuple[int, Datum]) -> Data:
    return Data(sender, target, tuple(Handover(*h) for h in handovers))


def statement(*ids: DatumId, base: int = 0, life: int = 9, serial: int = 0, lost: bool = False) -> Receipt:
    """A base's word that data have arrived, or that it was told they are lost."""
    entries = []
    for origin, epoch in dict.fromkeys(id[:2] for id in ids):
        ranges = Ranges()
        for id in ids:
            if id[:2] == (origin, epoch):
                ranges.add(id.sequence, id.sequence + 1)
        for block in blocks(ranges):
            entry = some(entry_of(origin, epoch, ranges, block, lost=lost))
            entries.append(entry)
    return make_receipt(base, life, serial, entries)


def loss(number: int, id: DatumId, reason: int) -> DeletionEntry:
    """A sound entry of a deletion report."""
    return DeletionEntry(number, id, reason, note_crc(id, reason))


def of(kind: type, messages: list[Message]) -> list[Any]:
    """The messages of one type."""
    return [m for m in messages if type(m) is kind]


def talk(nodes: dict[int, Node], messages: list[Message], now: float) -> list[Message]:
    """Deliver messages, and the answers to them, until all is silent. A perfect network; returns all that was said."""
    said: list[Message] = []
    queue = list(messages)
    while queue:
        message = queue.pop(0)
        said.append(message)
        sender = getattr(message, "sender", None)
        target = getattr(message, "target", None)
        for node in nodes.values():
            if node.id == sender or (target is not None and target not in (node.id, 0xFFFF)):
                continue
            queue += node.receive(message, now)
    return said
