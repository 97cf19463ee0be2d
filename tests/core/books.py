"""What the indexes of `Holdings` must be, reckoned from the records alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from math import inf
from typing import Any

from rass_mav.core.custody.custody_store import MAX_REPLICAS
from rass_mav.core.custody.holdings import Holding, Holdings, Pending, ReplicaOffer, State
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.core.node import Node
from rass_mav.core.replicas.replicas import Replicas


def records(holdings: Holdings) -> list[Holding]:
    return [holding for id in holdings if (holding := holdings.get(id)) is not None]


def check(holdings: Holdings) -> None:
    """Each index holds what the records say, and nothing else; the orders that matter are right."""
    held = records(holdings)
    assert len(held) == len(holdings) == len({h.id for h in held})
    for state, index in (
        (State.CUSTODY, holdings.custody), (State.REPLICA, holdings.replica), (State.PASSED_ON, holdings.passed_on),
    ):  # fmt: skip
        assert index == {h.id: h for h in held if h.state is state}
    custody = [h for h in held if h.state is State.CUSTODY]
    assert list(holdings.by_terms.urgent()) == sorted(holdings.custody.values(), key=lambda h: -h.terms.priority)
    assert holdings.by_terms.differ == (len({h.terms.priority for h in custody}) > 1)
    assert holdings.by_terms.mortal == {h.id: h for h in held if h.ends < inf}
    assert holdings.custody_bytes == sum(h.size for h in custody)
    assert holdings.custody_bytes + holdings.replica_bytes == sum(h.size for h in held)
    lone = {h.id: h for h in custody if h.partner is None and h.size <= INLINE_BYTES and not h.share}
    # Of some of them no more replicas are wanted.
    assert all(lone[id] is h for id, h in holdings.unbacked.items())
    assert all((h.offer_at is not None) == (h.id in holdings.unbacked) for h in custody)
    pending = {h.pending.key: h.pending for h in custody if h.pending is not None}
    large: dict[int, dict[int, Pending]] = {}
    for handover in pending.values():
        if handover.sending:
            large.setdefault(handover.to, {})[handover.number] = handover
    assert holdings.large == large
    offers = {offer.key: offer for h in held if (offer := h.offer) is not None}
    exchange = holdings.exchange
    assert {q.key: q for q in (*exchange.of(Pending), *exchange.of(ReplicaOffer))} == {**pending, **offers}
    assert all(question.key == key for key, question in exchange.open.items())
    portions = holdings.portions
    check_shares(portions.custodians, [(h.received_from, h.size) for h in custody])
    check_shares(portions.origins, [(h.id.origin, h.size) for h in custody])
    for custodian, replicas in portions.passed_on.items():
        assert replicas
        assert all(holdings.passed_on[id].received_from == custodian for id in replicas)
    assert sum(map(len, portions.passed_on.values())) == len(holdings.passed_on)
    times = [h.asked for h in holdings.replica.values() if h.partner is not None]
    assert times == sorted(times)
    for h in held:
        if h.state is not State.CUSTODY:
            assert (h.pending, h.offer_at) == (None, None)
        if h.state is State.PASSED_ON:
            assert h.partner is None
            assert h.offer is None
        if h.holder is not None:
            assert h.state is State.REPLICA
            assert h.partner not in (None, h.holder)
        if h.partner is not None:
            assert holdings.partners[h.partner.id] is h.partner
    for id, partner in holdings.partners.items():
        mine = [h for h in held if h.partner is partner]
        backed = [h for h in mine if h.state is State.CUSTODY] + [h for h in held if h.holder is partner]
        assert id == partner.id
        assert mine or backed, "a partner of no datum"
        assert partner.backed == {h.id: h for h in backed}
        assert partner.replicas == {h.id: h for h in mine if h.state is State.REPLICA}


def check_shares(shares: Mapping[Any, list[int]], custody: list[tuple[Any, int]]) -> None:
    """Each has what it has."""
    items, sizes = Counter(key for key, _ in custody), Counter[Any]()
    for key, size in custody:
        sizes[key] += size
    assert shares == {key: [items[key], sizes[key]] for key in items}


def check_node(node: Node) -> None:
    """The same for a node; and that every replica that somebody counts on has a partner, and all bounds hold."""
    check(node.holdings)
    assert all(h.partner is not None for h in node.holdings.replica.values())
    assert node.custody_store.journal.disagreement() == ""
    assert node.custody_store.disagreement() == ""
    if isinstance(node.replicas, Replicas):
        assert replicas(node) <= MAX_REPLICAS
        # Overheard data are of nothing that is held here, and have a place that nothing else needs.
        capacity = node.holdings.capacity_items
        assert not any(id in node.holdings for id in node.overheard)
        assert capacity is None or not node.overheard or len(node.overheard) + len(node.holdings) <= capacity


def replicas(node: Node) -> int:
    """How many replicas a node keeps."""
    return len(node.holdings) - len(node.holdings.custody)


def holders(node: Node) -> dict[Any, int]:
    """Who keeps a replica of a datum in custody."""
    return {id: h.partner.id for id, h in node.holdings.custody.items() if h.partner is not None}
