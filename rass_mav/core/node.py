"""The node: Alg. 1 of the paper with custody, over messages. Sans I/O: time and randomness come in, messages go out."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from typing import Any

from rass_mav.core.custody.keeper import Keeper
from rass_mav.core.custody.percolation import Percolation
from rass_mav.core.custody.transfers import Transfers
from rass_mav.core.datum import MAX_PAYLOAD, DatumId, make_datum
from rass_mav.core.messages import (
    BEACON_BASE,
    BEACON_WANTED,
    NO_ROUTE,
    UNBOUNDED_FREE,
    Accept,
    Beacon,
    Chunk,
    Committed,
    Corrupt,
    Data,
    LossNote,
    Message,
    Offer,
    PassedOn,
    Put,
    Query,
    Receipt,
    Sack,
    Word,
)
from rass_mav.core.news.notes import fate_of
from rass_mav.core.observer import Observer
from rass_mav.core.policy import POTENTIAL_BASE, Policy
from rass_mav.core.replica import Replica
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.costs import CostTable
from rass_mav.core.routes.serial import following, newer
from rass_mav.core.routes.table import HOLD_LIFETIMES, RoutingTable
from rass_mav.core.settings import NodeSettings
from rass_mav.core.spares.mirrors import Mirrors
from rass_mav.core.store import Store
from rass_mav.errors import DatumError, StoreFullError

#: How many announcement numbers a base claims on disk at a time.
ANNOUNCEMENTS_CLAIMED = 256


class Node(Keeper):
    """One RASS participant."""

    __slots__ = (
        "_beacon_number",
        "_claimed",
        "_slow_until",
        "_steps",
        "bandwidth_items",
        "base",
        "corrupt_received",
        "echoes",
        "fresh",
        "id",
        "percolation",
        "policy",
        "potential",
        "risk",
        "rivals",
        "rng",
        "routing",
        "sent_data",
        "turn_s",
    )

    def __init__(
        self,
        settings: NodeSettings,
        store: Store,
        policy: Policy,
        risk: RiskEstimator,
        rng: random.Random,
        *,
        now: float,
        observer: Observer | None = None,
        newborn: bool = False,
    ) -> None:
        """`now` in seconds, on the timeline of all later calls.

        `newborn`: nobody can remember this node from an earlier life, so it need not wait before it takes a route.
        """
        # Under a replicating policy a base is an ordinary peer.
        super().__init__(
            settings,
            store,
            rng,
            observer,
            sink=settings.base and not policy.replicates,
            receipts=settings.receipts and not policy.replicates,
        )
        self.id = settings.node_id
        self.base = settings.base
        self.policy = policy
        self.risk = risk
        self.rng = rng
        lifetime = (settings.neighbour_steps + 0.5) * settings.step_s
        slow = store.get_meta("turn") or 0
        make_table = RoutingTable if policy.costs is None else partial(CostTable, policy.costs)
        self.routing: RoutingTable = make_table(
            self.id,
            store.epoch,
            base=self.base,
            lifetime_s=lifetime,
            step_s=settings.step_s,
            turn_s=slow / 10,
            max_neighbours=settings.max_neighbours,
            max_hops=settings.max_hops,
            restarted=None if newborn else now,
            number=following(store.get_meta("announcement") or 0),
        )
        self.transfers = Transfers(self, lifetime)
        self.percolation = Percolation(self)
        self.replica = Replica(self) if policy.replicates else None
        self.mirrors = Mirrors(self, now) if settings.mirror else None
        self.fresh: dict[DatumId, None] = {}
        self.potential = 0
        """Own potential as last announced, wire units."""
        self.rivals: dict[int, float] = {}
        """Epochs of other nodes heard under this node's id, and when last."""
        self.echoes = 0
        """Own beacons that came back."""
        self.corrupt_received = 0
        """Data that came in with a checksum that does not fit."""
        self.sent_data = 0
        """Data, copies and chunks sent, retransmissions included."""
        self.turn_s = settings.step_s
        """Seconds between two calls of `step`, and so between two beacons: the step length, or more (`pace`)."""
        self.bandwidth_items = settings.bandwidth_items
        """Items sent in a turn at most, retransmissions included."""
        self._slow_until = now + HOLD_LIFETIMES * self.routing.longest_s
        self._beacon_number = rng.getrandbits(16)
        self._steps = 0
        self._claimed = self.routing.number
        if self.base:
            self._claim_announcement()

    def pace(self, turn_s: float, items: int, now: float, told_s: float | None = None) -> None:
        """From now on `step` is called every `turn_s` seconds, for the link bears no more; in each at most `items` data
        (and no more than the settings say) are sent. Neighbours hear of it in the beacon, and wait accordingly.

        `told_s`: what they hear, where not every beacon leaves on every link; None: `turn_s`.
        """
        step_s = self.settings.step_s
        routing = self.routing
        self.turn_s = max(step_s, turn_s)
        routing.turn_s = max(step_s, turn_s if told_s is None else told_s)
        self.bandwidth_items = min(self.settings.bandwidth_items, items)
        self.transfers.lifetime_s = routing.lifetime_s * (routing.turn_s / step_s)
        # After a restart this node has to wait until nobody counts on its old routes; so how long they may is kept.
        kept = self.store.get_meta("turn") or 0
        turn = self._turn
        if turn >= kept:
            self._slow_until = now + HOLD_LIFETIMES * routing.longest_s
        if turn > kept or (turn < kept and now >= self._slow_until):
            self.store.set_meta("turn", turn)

    @property
    def _turn(self) -> int:
        """The turn as the beacon says it."""
        turn_s = self.routing.turn_s
        return min(0xFFFF, int(turn_s * 10 + 0.5)) if turn_s > self.settings.step_s else 0

    # -- what comes in -------------------------------------------------------------------------------------------------

    def receive(self, message: Message, now: float) -> list[Message]:
        """A message from a neighbour. Returns the answers; they may be sent once the store has committed."""
        answers = _HANDLERS[type(message)](self, message, now)
        if self.mirrors is not None:
            self.mirrors.flush(answers)
        return answers

    def forward(self, now: float) -> list[Message]:
        """What came into custody since the last turn moves on at once, within the bandwidth of this step.

        For `NodeSettings.immediate`, after `receive` and `put`; empty if nothing came in.
        """
        out: list[Message] = []
        if self.stirred and not self.sink:
            self.stirred = False
            if self.inventory:
                self.percolation.forward(now, out)
            if self.mirrors is not None:
                self.mirrors.flush(out)
        return out

    def put(self, payload: bytes, now: float, kind: int = 0) -> DatumId:
        """Create a datum here. Raises `StoreFullError` (counted as overflow) or `DatumError` (too large or empty)."""
        limit = self.settings.inline_bytes if self.replica is not None else MAX_PAYLOAD
        if not 0 < len(payload) <= limit:
            raise DatumError(f"a datum holds 1 to {limit} bytes, got {len(payload)}")
        if not (self.room_for(len(payload), own=True) or self.make_room(len(payload), own=True)):
            self.store.count("overflow")
            self.observer.overflow()
            raise StoreFullError("no room for a new datum")
        id = DatumId(self.id, self.store.epoch, self.store.next_sequence())
        datum = make_datum(id, kind, now, payload)
        self.observer.created(datum)
        if self.sink:
            self.deliver(datum)
        else:
            self.hold(datum)
        if self.replica is not None:
            self.replica.wrote(id)
        return id

    def rewrite(self, id: DatumId, payload: bytes, now: float) -> None:
        """Under a replicating policy: write a held entry anew (last writer wins). KeyError if it is not held."""
        if self.replica is None or not 0 < len(payload) <= self.settings.inline_bytes:
            raise DatumError(f"only a replicating policy rewrites, 1 to {self.settings.inline_bytes} bytes")
        kind = self.inventory.info(id).kind
        self.inventory.add(make_datum(id, kind, now, payload))
        self.replica.wrote(id)

    def _on_beacon(self, beacon: Beacon, now: float) -> list[Message]:
        if beacon.sender == self.id:
            if beacon.epoch == self.store.epoch:
                self.echoes += 1
            else:
                if len(self.rivals) >= 16 and beacon.epoch not in self.rivals:
                    self.rivals.clear()
                self.rivals[beacon.epoch] = now
        else:
            self.routing.hear(beacon, now)
        return []

    def _on_data(self, data: Data, now: float) -> list[Message]:
        committed: list[tuple[int, int]] = []
        refused: list[int] = []
        for number, datum in data.handovers:
            if not datum.intact:
                self.corrupt_received += 1
                continue
            if data.spare:
                verdict = self.keep_spare(data.sender, number, datum)
            else:
                verdict = self.take_custody(data.sender, number, datum)
            if number == 0:
                continue
            if verdict:
                committed.append((number, datum.crc))
            else:
                refused.append(number)
        if committed or refused:
            return [Committed(self.id, data.sender, tuple(committed), tuple(refused))]
        return []

    def _on_committed(self, message: Committed, now: float) -> list[Message]:
        for number, crc in message.committed:
            id = self.custody.answered(number, message.sender)
            if id is None:
                if self.notes is not None:
                    self.notes.committed(number, message.sender)
            elif self.inventory.info(id).crc == crc:
                self.give_away(id, message.sender)
        for number in message.refused:
            id = self.custody.answered(number, message.sender)
            if id is not None:
                self.custody.cancel(id)
                self.transfers.cancel(id)
            elif self.notes is not None:
                self.notes.refused(number, message.sender)
        out: list[Message] = []
        if self.mirrors is not None:
            self.mirrors.offers.answered(message, now, out)
        return out

    def _on_passed_on(self, message: PassedOn, now: float) -> list[Message]:
        if self.mirrors is not None:
            self.mirrors.on_passed_on(message)
        return []

    def _on_corrupt(self, message: Corrupt, now: float) -> list[Message]:
        out: list[Message] = []
        if self.mirrors is not None:
            self.mirrors.on_corrupt(message, now, out)
        elif self.sink:
            # Somebody did not know that it gave to a base.
            arrived = tuple(id for id, word in message.entries if word == Word.STILL and id in self.archive)
            if arrived:
                out.append(PassedOn(self.id, message.sender, arrived))
        return out

    def _on_receipt(self, receipt: Receipt, now: float) -> list[Message]:
        if self.receipts is not None:
            changed = self.receipts.learn(receipt)
            if changed:
                self.heed(changed)
        return []

    def _on_put(self, put: Put, now: float) -> list[Message]:
        if self.replica is not None and put.datum.intact:
            self.replica.merge(put)
        return []

    def _on_query(self, query: Query, now: float) -> list[Message]:
        return [] if self.replica is None else self.replica.answer(query)

    def _on_loss_note(self, note: LossNote, now: float) -> list[Message]:
        if self.receipts is None or not (self.sink or self.notes is not None):
            # Not answered, so it is not lost.
            return []
        taken = {number: self.take_note(id, fate_of(reason)) for number, id, reason in note.entries}
        committed = tuple([(number, 0) for number, good in taken.items() if good])
        refused = tuple([number for number, good in taken.items() if not good])
        return [Committed(self.id, note.sender, committed, refused)]

    # -- Alg. 1 --------------------------------------------------------------------------------------------------------

    def step(self, now: float) -> list[Message]:
        """One turn of Alg. 1 but for `store_measurements`, which is `put`. Returns what to send, the beacon first."""
        settings = self.settings
        self._steps += 1
        self.scrub()
        self.percolation.begin_step()
        if settings.lifetime_s is not None:
            self.expire(now - settings.lifetime_s)
        routing, policy = self.routing, self.policy
        if self.base and settings.seq_period and self._steps % settings.seq_period == 0:
            routing.raise_number()
        if policy.costs is not None:
            routing.toll = policy.potential(routing.distance, self.risk.risk(now), 1)
        routing.update(now)
        out: list[Message] = [self._beacon(now)]
        turn = self.receipts is not None and self.receipts.due(self._steps)
        if turn and self.receipts is not None:
            receipt = self.receipts.turn(routing.neighbours.values())
            if receipt is not None:
                out.append(receipt)
        if self.sink:
            if self.base:
                self._claim_announcement()
            self.transfers.age(now)
            return out
        self.transfers.age(now)
        if self.replica is not None:
            self.replica.ask(out)
        self.stirred = False
        if self.mirrors is not None:
            self.mirrors.step(now)
        if self.inventory:
            self.percolation.evict(now, out)
        if self.mirrors is not None:
            self.mirrors.flush(out)
        if turn and self.notes is not None:
            note = self.notes.turn(self.id, routing.next_hop, self.custody.draw)
            if note is not None:
                out.append(note)
        return out

    def _claim_announcement(self) -> None:
        """Keep a number on disk that has not been announced yet: a restarted base goes on after it (RFC 1982)."""
        number = self.routing.number
        if not newer(self._claimed, number):
            # Not at each number: that would be a write each step.
            self._claimed = (number + ANNOUNCEMENTS_CLAIMED) & 0xFFFF
            self.store.set_meta("announcement", self._claimed)

    def _beacon(self, now: float) -> Beacon:
        routing = self.routing
        risk = self.risk.risk(now)
        inventory = self.inventory
        free = UNBOUNDED_FREE if self.sink else inventory.free()
        if free and not (
            self.store.accepting and self.store.room_for(self.settings.inline_bytes - inventory.spare_bytes)
        ):
            free = 0
        route = routing.route
        if self.base:
            self.potential = POTENTIAL_BASE if free else 0
        elif self.policy.costs is not None:
            self.potential = routing.metric
        else:
            self.potential = self.policy.potential(routing.distance, risk, free)
        routing.announced(now)
        wanted = routing.wanted
        flags = (BEACON_BASE if self.base else 0) | (BEACON_WANTED if wanted else 0)
        base, base_epoch, number, hops = route if route is not None else (0, 0, 0, NO_ROUTE)
        wanted_base, wanted_number = wanted or (0, 0)
        self._beacon_number = following(self._beacon_number)
        return Beacon(
            self.id,
            self.store.epoch,
            self._beacon_number,
            flags,
            base,
            base_epoch,
            number,
            hops,
            wanted_base,
            wanted_number,
            int(risk * 65535.0 + 0.5),
            free,
            self.policy.tag,
            self.potential,
            0 if self.receipts is None else self.receipts.digest,
            self._turn,
        )


_HANDLERS: dict[type, Callable[[Node, Any, float], list[Message]]] = {
    Beacon: Node._on_beacon,
    Data: Node._on_data,
    Committed: Node._on_committed,
    Receipt: Node._on_receipt,
    Offer: lambda node, message, now: node.transfers.on_offer(message, now),
    Accept: lambda node, message, now: node.transfers.on_accept(message, now),
    Chunk: lambda node, message, now: node.transfers.on_chunk(message, now),
    Sack: lambda node, message, now: node.transfers.on_sack(message, now),
    Put: Node._on_put,
    Query: Node._on_query,
    LossNote: Node._on_loss_note,
    PassedOn: Node._on_passed_on,
    Corrupt: Node._on_corrupt,
}
