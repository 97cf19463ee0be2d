"""What a node holds: one record for each datum, in memory; the bytes are in the store.

A record holds all that the node knows of its copy: whether the datum is in its custody or a replica, its partner, the
pending hand-over, and the offers. The indexes follow from that, and only `Holdings` changes it, so they cannot
contradict the records. Other modules set times: when a hand-over was sent, when a replica may be offered next.

Custody comes first. Replicas use the space that custody leaves, and count as free. Before a datum comes into custody,
the caller drops replicas; `crowded` and `yielding` determine when and which.
"""

from __future__ import annotations

import enum
from collections import Counter, deque
from collections.abc import Iterator
from itertools import chain
from math import inf

from rass_mav.core.custody.journal import Entry
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import Datum, DatumId, Fate, is_share
from rass_mav.core.exchange import Exchange, Question
from rass_mav.core.messages import INLINE_BYTES
from rass_mav.core.seals import SEALED
from rass_mav.core.settings import Capacity, NodeSettings
from rass_mav.core.shares import Portions, is_last_part
from rass_mav.core.store import Store, StoredInfo


class State(enum.Enum):
    """What a copy is to the node that has it."""

    CUSTODY = "in custody"
    """The node has to move the datum on."""
    REPLICA = "replica"
    """The partner has custody, and counts on this copy."""
    PASSED_ON = "passed on"
    """A replica that no node counts on: the partner has passed custody on, or soon will, or a base took it."""


#: The possible changes of a copy's state, and their causes; None: there is no copy. docs/contribute/architecture.md
#: draws it.
CHANGES: dict[tuple[State | None, State | None], str] = {
    (
        None,
        State.CUSTODY,
    ): "created here, handed over to this node, found at the start, or overheard and lost elsewhere",
    (None, State.REPLICA): "a custodian sends a replica, or a holder a distant one",
    (State.CUSTODY, State.REPLICA): "handed over to a drone, which is the partner now",
    (State.CUSTODY, State.PASSED_ON): "handed over to a base, or while one can be reached",
    (State.REPLICA, State.PASSED_ON): "the partner has passed the datum on, or probably has, as a base can be reached",
    (State.PASSED_ON, State.REPLICA): "a custodian sends a replica of what is here, or a holder a distant one",
    (
        State.REPLICA,
        State.CUSTODY,
    ): "the partner is gone, or a custodian asks for it; or it is offered, reported lost, or long without a receipt",
    (
        State.PASSED_ON,
        State.CUSTODY,
    ): "a custodian asks for it; or it is offered, reported lost, or long without a receipt",
    (State.CUSTODY, None): "handed over and no replica kept, corrupt, expired, or no space",
    (
        State.REPLICA,
        None,
    ): "arrived, corrupt, expired, or no space; or, without `lasting-replicas`, passed on by the partner",
    (State.PASSED_ON, None): "arrived, corrupt, expired, or no space",
}


class Pending(Question):
    """A hand-over that has not been answered."""

    __slots__ = ("sending",)

    def __init__(self, number: int, id: DatumId, to: int, now: float, sending: Sending | None = None) -> None:
        super().__init__(number, id, to, now)
        self.sending = sending
        """The transfer, if the datum is sent in chunks."""


class ReplicaOffer(Question):
    """A replica that is on offer."""

    __slots__ = ()


class Partner:
    """Another node that this one keeps replicas for, or that keeps replicas for this one."""

    __slots__ = ("backed", "heard", "id", "large", "life", "lifetime_s", "replicas")

    def __init__(self, id: int, life: int | None, heard: float, lifetime_s: float) -> None:
        self.id = id
        self.life = life
        """From its beacon; None: not known yet."""
        self.heard = heard
        """When it was last known to be there, seconds."""
        self.lifetime_s = lifetime_s
        """A neighbour like this is gone when it is silent for longer. It grows with the turn in its beacons."""
        self.replicas: dict[DatumId, Holding] = {}
        """Data in its custody of which this node has a replica."""
        self.large = 0
        """How many of these do not fit one frame."""
        self.backed: dict[DatumId, Holding] = {}
        """Data here of which it has a replica for this node, in custody or replicas themselves."""


class Holding:
    """All that a node knows of a datum that it holds."""

    __slots__ = (
        "asked",
        "crc",
        "created",
        "custodian",
        "further",
        "given",
        "holder",
        "id",
        "kept",
        "moves_until",
        "offer",
        "offer_at",
        "partner",
        "pending",
        "received_from",
        "resent",
        "sealed",
        "share",
        "size",
        "sought_by",
        "stalled",
        "state",
        "taken_as",
        "terms",
    )  # fmt: skip

    def __init__(self, datum: Datum | StoredInfo, size: int, state: State, custodian: int | None = None) -> None:
        self.id = datum.id
        self.created = datum.created
        """Seconds."""
        self.crc = datum.crc
        self.size = size
        """Bytes of payload."""
        self.terms = datum.terms
        self.sealed = bool(datum.kind & SEALED)
        """Whether its origin has sealed it with its keys."""
        self.share = is_share(datum.kind)
        """Whether it is one of the data of a file of which some may be lost. It needs no replica."""
        self.state = state
        self.partner: Partner | None = None
        """In custody: the holder, which keeps a replica. Replica: the node that this copy is for, in most cases the
        custodian."""
        self.pending: Pending | None = None
        """The hand-over that is under way; in custody only."""
        self.offer: ReplicaOffer | None = None
        """The replica of it that is on offer."""
        self.offer_at: float | None = None
        """In custody without a holder: when a replica may be offered next, seconds. None: it needs no replica."""
        self.asked = 0.0
        """Replica: when the custodian last reported it or was asked for it, seconds."""
        self.kept = 0.0
        """When its holder last showed that it has its replica, seconds."""
        self.given: Entry | None = None
        """Replica: which node took custody last, or offered this copy, and how long to wait for a receipt."""
        self.received_from = custodian
        """The node that it is from; None: it was created here, or found at the start."""
        self.holder: Partner | None = None
        """Replica with a partner: another node that keeps a replica for this one, farther from the custodian."""
        self.custodian: int | None = None
        """Replica: the node with custody, as far as this one knows. In custody: the node that had it when this was a
        replica, if the partner is a holder that keeps away from that node."""
        self.further = 0
        """Replica: how many nodes farther away should have a copy."""
        self.resent = 0
        """How often it was sent again for lack of a receipt."""
        self.taken_as = 0
        """The number of the hand-over by which it came here; 0: by none, or that is not known."""
        self.sought_by: int | None = None
        """Replica: a node that looks for the datum, and for which the custodian was asked whether it has it."""
        self.stalled: int | None = None
        """The neighbour to which its last transfer in chunks made no progress."""
        self.moves_until = -inf
        """In custody: its receiver was heard handing it on, and until then the datum is probably under way, seconds."""

    @property
    def counted_on(self) -> Partner | None:
        """The node that keeps a replica for this copy."""
        return self.partner if self.state is State.CUSTODY else self.holder

    @property
    def ends(self) -> float:
        """When the datum expires by its own terms, seconds; infinite: never."""
        ttl_s = self.terms.ttl_s
        return inf if ttl_s is None else self.created + ttl_s


class ByTerms:
    """The copies of one node by their terms, and by their age."""

    __slots__ = ("_levels", "_next_end", "mortal", "oldest")

    def __init__(self) -> None:
        self._levels: dict[int, dict[DatumId, Holding]] = {}
        """Those in custody by priority, least recently used first; no level is empty."""
        self.mortal: dict[DatumId, Holding] = {}
        """Those that expire by their own terms, replicas too."""
        self._next_end = inf
        """None of them expires before this, seconds."""
        self.oldest = inf
        """No copy was created before this, seconds."""

    def enter(self, holding: Holding) -> None:
        """A copy is here now, in its state."""
        self.oldest = min(self.oldest, holding.created)
        id, (priority, ttl_s) = holding.id, holding.terms
        if ttl_s is not None:
            self.mortal[id] = holding
            self._next_end = min(self._next_end, holding.ends)
        if holding.state is State.CUSTODY:
            level = self._levels.get(priority)
            if level is None:
                level = self._levels[priority] = {}
            level[id] = holding

    def leave(self, holding: Holding) -> None:
        """A copy goes, or is about to change its state."""
        id, (priority, ttl_s) = holding.id, holding.terms
        if ttl_s is not None:
            del self.mortal[id]
        if holding.state is State.CUSTODY:
            level = self._levels[priority]
            del level[id]
            if not level:
                del self._levels[priority]

    @property
    def differ(self) -> bool:
        """Whether data in custody differ in priority."""
        return len(self._levels) > 1

    def urgent(self) -> Iterator[Holding]:
        """Data in custody, those of the highest priority first, and among these the least recently used."""
        return chain.from_iterable(self._levels[level].values() for level in sorted(self._levels, reverse=True))

    def ended(self, now: float) -> list[Holding]:
        """Copies of data that have expired by their own terms. The caller drops them."""
        if now <= self._next_end:
            return []
        self._next_end = min((h.ends for h in self.mortal.values() if h.ends >= now), default=inf)
        return [holding for holding in self.mortal.values() if holding.ends < now]


class Holdings:
    """The records of one node. Bounded by items and by bytes of payload; None: no bound of that kind."""

    __slots__ = (
        "_all",
        "_most_bytes",
        "_own_share",
        "_store",
        "_unverified",
        "by_terms",
        "capacity_items",
        "custody",
        "custody_bytes",
        "exchange",
        "large",
        "partners",
        "passed_on",
        "portions",
        "replica",
        "replica_bytes",
        "reserved",
        "shares",
        "unbacked",
        "unchained",
    )  # fmt: skip

    def __init__(
        self, store: Store, settings: NodeSettings, capacity: Capacity, exchange: Exchange, *, load: bool = True
    ) -> None:
        """`exchange`: gets the hand-overs and offers. `load`: take over what the store holds from an earlier life. All
        of it counts as custody: it is not recorded which copies were replicas, and one copy too many is allowed."""
        self._store = store
        self.exchange = exchange
        self.capacity_items = capacity.items
        self._most_bytes = capacity.bytes
        self._own_share = capacity.own_share
        self._all: dict[DatumId, Holding] = {}
        self.custody: dict[DatumId, Holding] = {}
        """Data in custody, least recently used first (the paper's LRU eviction)."""
        self.by_terms = ByTerms()
        """All copies, by priority and lifetime."""
        self.replica: dict[DatumId, Holding] = {}
        """Replicas that a partner counts on, those with no news from it for longest first."""
        self.passed_on: dict[DatumId, Holding] = {}
        """Replicas that no node counts on any more, the oldest first."""
        self.custody_bytes = 0
        """Bytes of payload in custody."""
        self.replica_bytes = 0
        """Bytes of payload of the replicas of both kinds."""
        self.portions = Portions(settings.node_id)
        """Whose data are here."""
        self._unverified: deque[DatumId] = deque()
        """Copies whose checksums are still to be verified in this rotation."""
        self.reserved = 0
        """Places reserved for items that should come back."""
        self.unbacked: dict[DatumId, Holding] = {}
        """Small data in custody without a holder, those without one for longest first."""
        self.unchained: dict[DatumId, float] = {}
        """Replicas that should have a holder of their own, and when one may be looked for, seconds."""
        self.shares: dict[DatumId, Holding] = {}
        """Shares in custody that were created here, least recently used first."""
        self.large: dict[int, dict[int, Pending]] = {}
        """Hand-overs in chunks, by neighbour and number, the oldest first."""
        self.partners: dict[int, Partner] = {}
        """By node id; each with at least one datum."""
        for info in store.held() if load else ():
            self._enter(Holding(info, info.size, State.CUSTODY))

    def __contains__(self, id: object) -> bool:
        """Whether there is a copy here, in custody or replica."""
        return id in self._all

    def __len__(self) -> int:
        """How many copies there are."""
        return len(self._all)

    def __iter__(self) -> Iterator[DatumId]:
        """All copies: those in custody, then the replicas."""
        return chain(self.custody, self.replica, self.passed_on)

    def get(self, id: DatumId) -> Holding | None:
        """The record of a datum; None: no copy is here."""
        return self._all.get(id)

    def alone(self) -> dict[int, int]:
        """By origin: data in custody of which no other node keeps a copy for this one. Looks at all of them."""
        return Counter(id.origin for id, holding in self.custody.items() if holding.partner is None)

    # -- capacity ------------------------------------------------------------------------------------------------------

    def _capacity_bytes(self) -> int | None:
        """Bytes of payload that can be held now: what the settings allow, and what the store's quota leaves beside all
        else that is there."""
        most, quota = self._most_bytes, self._store.quota_bytes
        if quota is None:
            return most
        left = max(0, quota - self._store.used_bytes + self.custody_bytes + self.replica_bytes)
        return left if most is None else min(most, left)

    def _others(self, capacity: int) -> int:
        """The part of a capacity that others' data may take; the rest is reserved for the node's own."""
        return capacity - int(self._own_share * capacity)

    def free(self) -> int:
        """Items of others that can be taken into custody, 0..65535 (65535: no bound). Replicas count as free."""
        capacity_bytes = self._capacity_bytes()
        if capacity_bytes is not None and self.custody_bytes >= self._others(capacity_bytes):
            return 0
        if self.capacity_items is None:
            return 0xFFFF
        return min(max(self._others(self.capacity_items) - len(self.custody) - self.reserved, 0), 0xFFFE)

    def room_for(self, size: int, *, own: bool, items: int = 1) -> bool:
        """Whether so many data, `size` bytes of payload in all, fit into custody. `own`: a measurement of this node."""
        if (limit := self._capacity_bytes()) is not None and self.custody_bytes + size > (
            limit if own else self._others(limit)
        ):
            return False
        if (limit := self.capacity_items) is None:
            return True
        return len(self.custody) + self.reserved + items <= (limit if own else self._others(limit))

    def is_fair(self, custodian: int, origin: int, size: int) -> bool:
        """Whether a neighbour may hand over a datum of an origin, of `size` bytes of payload, if it fits. When the
        space for others' data is nearly used up, what is left is for those that have less than an equal share."""
        used = (len(self.custody) + self.reserved, self.custody_bytes + size)
        for which, capacity in enumerate((self.capacity_items, self._capacity_bytes())):
            if capacity is not None:
                places = self._others(capacity)
                if is_last_part(used[which], places) and not self.portions.is_fair(custodian, origin, which, places):
                    return False
        return True

    def room_to_grow(self, growth: int) -> bool:
        """Whether a datum in custody may be replaced by one that is `growth` bytes longer."""
        capacity_bytes = self._capacity_bytes()
        return capacity_bytes is None or self.custody_bytes + growth <= capacity_bytes

    def crowded(self, size: int, others: int = 0) -> bool:
        """Whether a datum does not fit beside all copies here, replicas included, and `others`, which are kept
        elsewhere.

        `size`: bytes of payload, those of the others included.
        """
        if self.capacity_items is not None and len(self._all) + others + self.reserved >= self.capacity_items:
            return True
        capacity_bytes = self._capacity_bytes()
        if capacity_bytes is not None and self.custody_bytes + self.replica_bytes + size > capacity_bytes:
            return True
        return not self._store.room_for(size)

    def free_part(self, others: int, size: int) -> float:
        """The part of the capacity that is left beside all copies here and `others` of `size` bytes of payload, which
        are kept elsewhere; 0..1."""
        used = 0.0
        if self.capacity_items is not None:
            used = (len(self._all) + others) / max(self.capacity_items, 1)
        if (capacity_bytes := self._capacity_bytes()) is not None:
            used = max(used, (self.custody_bytes + self.replica_bytes + size) / max(capacity_bytes, 1))
        return max(0.0, 1.0 - used)

    def yielding(self, *, distant: bool, near: bool) -> Holding | None:
        """The replica to drop first: the oldest that no node counts on, from the node that more than half of these are
        from, if there is one; then, if these may go, a `distant` one, which is a third copy at least; then one that is
        `near` its custodian, the only one it counts on; of both the one with no news for longest."""
        if self.passed_on:
            return self.passed_on[self.portions.superfluous() or next(iter(self.passed_on))]
        if distant:
            for holding in self.replica.values():
                if holding.partner is not None and holding.custodian not in (None, holding.partner.id):
                    return holding
        if near:
            for holding in self.replica.values():
                return holding
        return None

    def older(self, than: float) -> list[Holding]:
        """Copies of data that were created before a moment, seconds. The caller drops them."""
        if than <= self.by_terms.oldest:
            return []
        self.by_terms.oldest = min((h.created for h in self._all.values() if h.created >= than), default=inf)
        return [self._all[id] for id in self if self._all[id].created < than]

    def damaged(self, limit: int | None) -> list[Holding]:
        """Copies whose bytes no longer match their checksum, among `limit` of them, in rotation; None: among all."""
        if limit is None or limit >= len(self._all):
            found = self._store.corrupt(self)
        else:
            if not self._unverified:
                self._unverified.extend(self)
            turn = [self._unverified.popleft() for _ in range(min(limit, len(self._unverified)))]
            found = self._store.corrupt(id for id in turn if id in self._all)
        return [self._all[id] for id in found] if found else []

    # -- changes -------------------------------------------------------------------------------------------------------

    def add(self, datum: Datum, state: State = State.CUSTODY, custodian: int | None = None) -> Holding:
        """Add a copy as the most recently used one. `custodian`: the node that it is from; None: it was created here.

        Raises `StoreFullError` over the store's quota.
        """
        self._store.put(datum)
        old = self._all.get(datum.id)
        if old is not None:
            self._leave(old)
        return self._enter(Holding(datum, len(datum.payload), state, custodian))

    def remove(self, holding: Holding, fate: Fate) -> None:
        """Drop a copy."""
        self._leave(holding)
        self._store.remove(holding.id, fate)

    def change(self, holding: Holding, state: State) -> None:
        """Change the state of a copy: one of `CHANGES`. It has no partner afterwards."""
        assert (holding.state, state) in CHANGES
        self._leave(holding)
        holding.state = state
        self._enter(holding)

    def pair(self, holding: Holding, partner: Partner, now: float) -> None:
        """From now on this is the datum's only partner. It needs no more replicas."""
        if holding.partner is not None:
            self.unpair(holding)
        if holding.holder is partner:
            self.unback(holding)
        self.partners[partner.id] = partner
        holding.partner = partner
        if holding.state is State.CUSTODY:
            self.withdraw(holding)
            self.keeps(holding, now)
            self._clothe(holding)
        else:
            partner.replicas[holding.id] = holding
            partner.large += holding.size > INLINE_BYTES
            self.ask(holding, now)

    def unpair(self, holding: Holding) -> Partner | None:
        """A datum has no partner any more. Returns the former one."""
        partner = self._part(holding)
        if partner is not None and holding.state is State.CUSTODY:
            self._mark_unbacked(holding)
        return partner

    def back(self, holding: Holding, holder: Partner, now: float) -> None:
        """From now on another node keeps a replica for a replica here."""
        self.unback(holding)
        assert holding.partner is not holder
        holding.holder = self.partners[holder.id] = holder
        self.keeps(holding, now)

    def unback(self, holding: Holding) -> None:
        """No node keeps a replica for a replica here any more."""
        holder, holding.holder = holding.holder, None
        if holder is not None:
            del holder.backed[holding.id]
            self._dismiss(holder)

    def keeps(self, holding: Holding, now: float) -> None:
        """The holder of a copy has just shown that it has its replica."""
        holder = holding.counted_on
        assert holder is not None
        holder.backed.pop(holding.id, None)
        holder.backed[holding.id] = holding
        holding.kept = now

    def ask(self, holding: Holding, now: float) -> None:
        """The custodian of a replica has just reported it, or is asked for it."""
        self.replica[holding.id] = self.replica.pop(holding.id)
        holding.asked = now

    def give(self, holding: Holding, pending: Pending) -> None:
        """Begin a hand-over, and cancel one that was under way. A datum that does not fit one frame is sent in
        chunks."""
        assert pending.sending is not None or holding.size <= INLINE_BYTES
        self.cancel(holding)
        holding.pending = self.exchange.ask(pending)
        if pending.sending is not None:
            self.large.setdefault(pending.to, {})[pending.sending.number] = pending

    def cancel(self, holding: Holding) -> None:
        """Forget the hand-over of a datum, if any: answers to it will be ignored."""
        pending, holding.pending = holding.pending, None
        if pending is not None:
            self.exchange.close(pending)
            if pending.sending is not None:
                of_neighbour = self.large[pending.to]
                del of_neighbour[pending.sending.number]
                if not of_neighbour:
                    del self.large[pending.to]

    def put_off(self, holding: Holding) -> None:
        """The hand-over of a datum in custody has failed: the others go first now, or those that no neighbour takes
        would use all the bandwidth."""
        self.cancel(holding)
        self.custody[holding.id] = self.custody.pop(holding.id)
        self.by_terms.leave(holding)
        self.by_terms.enter(holding)

    def vouch(self, holding: Holding, asker: int) -> None:
        """A node without a good copy learns that custody is here. A hand-over to that node ends: its answer may be on
        the way since before it lost its copy."""
        if holding.pending is not None and holding.pending.to == asker:
            self.cancel(holding)

    def offer(self, holding: Holding, offer: ReplicaOffer) -> None:
        """Offer a replica to a neighbour, and forget an offer before."""
        self.withdraw(holding)
        holding.offer = self.exchange.ask(offer)

    def withdraw(self, holding: Holding) -> None:
        """No replica of a datum is on offer any more: an answer will be ignored."""
        if holding.offer is not None:
            self.exchange.close(holding.offer)
            holding.offer = None

    def want_none(self, holding: Holding) -> None:
        """Offer no more replicas of a datum in custody, as long as the state of its copy does not change."""
        self.withdraw(holding)
        self._clothe(holding)

    # -- the indexes ---------------------------------------------------------------------------------------------------

    def _enter(self, holding: Holding) -> Holding:
        id = holding.id
        self._all[id] = holding
        self.by_terms.enter(holding)
        if holding.state is State.CUSTODY:
            self.custody[id] = holding
            self.custody_bytes += holding.size
            self.portions.add(holding.received_from, id.origin, holding.size)
            self._mark_unbacked(holding)
            if holding.share and holding.received_from is None:
                self.shares[id] = holding
        else:
            self.replica_bytes += holding.size
            if holding.state is State.REPLICA:
                self.replica[id] = holding
            else:
                self.passed_on[id] = holding
                self.portions.retire(holding.received_from, id)
        return holding

    def _leave(self, holding: Holding) -> None:
        id = holding.id
        if holding.holder is not None:
            self.unback(holding)
        if holding.partner is not None:
            self._part(holding)
        del self._all[id]
        self.by_terms.leave(holding)
        self.withdraw(holding)
        if holding.state is State.CUSTODY:
            del self.custody[id]
            self.custody_bytes -= holding.size
            self.portions.remove(holding.received_from, id.origin, holding.size)
            if holding.pending is not None:
                self.cancel(holding)
            self._clothe(holding)
            self.shares.pop(id, None)
        else:
            self.replica_bytes -= holding.size
            if holding.state is State.REPLICA:
                del self.replica[id]
            else:
                del self.passed_on[id]
                self.portions.unretire(holding.received_from, id)

    def _part(self, holding: Holding) -> Partner | None:
        partner, holding.partner = holding.partner, None
        if partner is not None:
            if holding.state is State.CUSTODY:
                del partner.backed[holding.id]
            else:
                del partner.replicas[holding.id]
                partner.large -= holding.size > INLINE_BYTES
            self._dismiss(partner)
        return partner

    def _dismiss(self, partner: Partner) -> None:
        if not partner.replicas and not partner.backed:
            self.partners.pop(partner.id, None)

    def _mark_unbacked(self, holding: Holding) -> None:
        """In custody without a holder."""
        if holding.size <= INLINE_BYTES and not holding.share:
            holding.offer_at = -inf
            self.unbacked[holding.id] = holding

    def _clothe(self, holding: Holding) -> None:
        """It needs no replica any more."""
        if holding.offer_at is not None:
            holding.offer_at = None
            del self.unbacked[holding.id]
