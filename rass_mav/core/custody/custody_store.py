"""What a node holds and is responsible for: accepting data, verifying them, releasing them.

Each change of a copy's state is made here, and the nodes that count on the copy are informed: its custodian, its
holder, its origin. Other parts decide what should change, and none of them is known here.
"""

from __future__ import annotations

import random
from collections.abc import Container, Iterable
from math import inf

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.custody.effects import Search
from rass_mav.core.custody.handovers import HandoverNumbers
from rass_mav.core.custody.holdings import Holding, Holdings, Partner, State
from rass_mav.core.custody.journal import Journal
from rass_mav.core.custody.overheard import Overheard
from rass_mav.core.custody.repairs import MAX_SEARCHES, Repairs
from rass_mav.core.custody.replica_messages import ReplicaMessages
from rass_mav.core.datum import BEYOND_REPAIR, RECORDED, STORE_FAULTS, Datum, DatumId, Fate
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import BEACON_BASE, BROADCAST, DISTANT_BYTES, INLINE_BYTES, CopyStatus, Distance, Handover
from rass_mav.core.news.deletion_reports import NoDeletionReports, Note, fate_of
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.observer import Observer
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store

#: Replicas a node keeps at most, if its capacity allows more.
MAX_REPLICAS = 4096
# Tuned: python -m tools.sensitivity custody.custody_store
#: How many replicas a chain has after that of the first holder. With one, a blast on the islands finds all copies of
#: 1.6 % of the data that are at least 5 steps old, with two of 0.2 to 0.3 %, with three of 0.1 %
#: (docs/evaluation/comparison.md).
FURTHER = 3
#: Turns after which a base has stated what it has, and the receipts are here. A corrupt copy of what its receiver was
#: heard handing on is not looked for before.
STATED_TURNS = 30
#: Turns for which a datum rests before its holder begins a chain.
REST_TURNS = 2
#: Fact: Among honest nodes the ages of one datum differ by at most this, seconds.
_AGES_DIFFER_S = 1.0


class CustodyStore:
    """The storing half of a drone.

    A datum has one custodian, the node that has to move it on. Another node, its holder, keeps a replica: after a
    hand-over the sender keeps its copy until the receiver reports that it has passed the datum on or, where replicas
    last, while there is space. Replicas are not custody: no node deletes a copy in custody because a replica exists.
    """

    __slots__ = (
        "_routing",
        "alarms",
        "arrived",
        "corrupt_received",
        "dirty",
        "exchange",
        "holdings",
        "journal",
        "messages",
        "notes",
        "now",
        "numbers",
        "observer",
        "overheard",
        "receipts",
        "refused",
        "repairs",
        "settings",
        "store",
    )  # fmt: skip

    def __init__(
        self, settings: NodeSettings, own_share: float, store: Store, exchange: Exchange, numbers: HandoverNumbers,
        receipts: NoReceipts, notes: NoDeletionReports, observer: Observer, alarms: Alarms, routing: RoutingTable,
        rng: random.Random, now: float,
    ) -> None:  # fmt: skip
        """`exchange`: the questions of this node. `receipts`: what bases report as arrived. `notes`: deletion reports
        that wait to be handed over."""
        self._routing = routing
        self.now = now
        """The time of the present step, seconds."""
        self.alarms = alarms
        self.settings = settings
        self.store = store
        self.exchange = exchange
        self.numbers = numbers
        self.receipts = receipts
        self.notes = notes
        self.observer = observer
        judges = notes.active and settings.acknowledged and settings.has("delivery-scores")
        self.journal = Journal(receipts, judges=judges)
        """Which neighbours took data from here, and whether these were delivered."""
        self.arrived: Container[DatumId] = receipts
        """What has reached a base, as far as this node knows."""
        self.holdings = self._take_up(own_share)
        self.messages = ReplicaMessages(settings.node_id)
        """What custodians and holders are to learn."""
        self.repairs = Repairs(settings.node_id, exchange, now + 1.5 * routing.longest_turn_s)
        """Corrupt data that another node was asked to take back."""
        self.overheard = Overheard(self.holdings, rng)
        """Data that others handed over to each other, and that are kept here in memory."""
        self.refused = 0
        """Hand-overs refused for lack of space."""
        self.corrupt_received = 0
        """Data that came in with a checksum that does not match."""
        self.dirty = False
        """Whether a datum came into custody that `Node.forward` has not looked at."""

    def _take_up(self, own_share: float) -> Holdings:
        return Holdings(self.store, self.settings, self.settings.capacity(own_share), self.exchange)

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        if len(self.exchange.of(Search)) > MAX_SEARCHES:
            return "too much is remembered"
        return self.overheard.disagreement()

    @property
    def reports(self) -> bool:
        """Whether custodians and holders tell each other what becomes of their copies. Where copies last until a
        receipt and a base can be reached, they do not: data move on soon, and what they leave behind waits for it."""
        return self._routing.route is None or not self.settings.lasting

    def is_reported(self, holding: Holding) -> bool:
        """The same for one datum: of large data, the next waits at the holder for the report."""
        return self.reports or holding.size > INLINE_BYTES

    # -- accepting data ------------------------------------------------------------------------------------------------

    def take_custody(self, custodian: int, number: int, datum: Datum) -> bool:
        """Accept a datum that arrived complete and intact. False: no space, the sender keeps it."""
        id = datum.id
        if self.has_id_conflict(id):
            self.refused += 1
            return False
        if self.has_custody(custodian, number, id, datum.crc, datum):
            self.rejuvenate(id, datum.created, at_least=datum.at_least)
            return True
        size = len(datum.payload)
        fits = self.is_fair(custodian, id.origin, size) and (self.may_accept(size) or self.make_room(size, own=False))
        if not fits or self.is_occupied(id):
            self.refused += 1
            if number == 0:
                self.observer.declined(id)
            return False
        if (other := self.holdings.get(id)) is not None:
            self.drop(other, Fate.PASSED_ON)
        self.keep(datum.arrived(), custodian)
        self._accept(custodian, number, datum)
        return True

    def _accept(self, custodian: int, number: int, datum: Datum) -> None:
        """Custody of a datum came here by this hand-over."""
        if number:
            self.numbers.accept(custodian, number, datum.id, self.numbers.content_hashes.of(datum))
            if (holding := self.holdings.get(datum.id)) is not None:
                holding.taken_as = number

    def keep_replica(self, custodian: int, number: int, datum: Datum, distance: Distance | None = None) -> bool:
        """Keep a replica for a neighbour that has custody, or a distant one. False: it cannot be kept, or not relied
        on."""
        is_kept = not self.has_id_conflict(datum.id) and self._keep_replica(custodian, datum, distance)
        self.refused += not is_kept
        return is_kept

    def has_id_conflict(self, id: DatumId) -> bool:
        """Whether another node created a datum under a number that this node has not assigned yet; this raises an
        alarm."""
        origin, epoch, sequence = id
        if origin != self.settings.node_id or epoch != self.store.epoch or sequence < self.store.assigned:
            return False
        self.alarms.ring(Alarm.ID_CONFLICT, str(id))
        return True

    def is_occupied(self, id: DatumId) -> bool:
        """Whether the place of a datum on offer is taken by another content under its id.

        What has left custody, and waits for its receipt, makes way for the other one. If one of the two is forged, that
        receipt may never come, and only the base can keep both.
        """
        holding = self.holdings.get(id)
        return holding is not None and holding.state is not State.PASSED_ON

    def has_custody(self, custodian: int, number: int, id: DatumId, crc: int, datum: Datum | None = None) -> bool:
        """Whether a datum on offer need not be stored: it is here, or this offer was accepted. A receipt does not
        count: the sender takes a datum that has arrived to the base all the same.

        False while something is held under `id`: that is another datum, so the offer is refused. `datum`: itself, where
        it is known: a forger can find a second one for a CRC.
        """
        holding = self.holdings.get(id)
        accepted = number != 0 and (
            self.numbers.accepted(custodian, number, id, crc) is not None
            if datum is None
            else self.numbers.has_accepted(custodian, number, id, self.numbers.content_hashes.of(datum))
        )
        if holding is not None:
            # The sender will delete its copy because of our answer, so ours must be good now; a bad one is dropped.
            loaded = self.load(holding)
            if loaded is None or loaded.crc != crc or (datum is not None and datum.payload != loaded.payload):
                return False
            if not accepted:
                self._comes_round(holding, loaded, custodian, number)
                return True
        elif not accepted:
            return False
        here = holding is not None and holding.state is State.CUSTODY
        if not here and self.settings.replicas and (self.reports or datum is None):
            # The sender keeps a replica for this node, which has passed the datum on.
            self.messages.say(custodian, id, CopyStatus.PASSED_ON)
        return True

    def confirmed(self, custodian: int, number: int, id: DatumId, crc: int) -> int:
        """The content hash of the datum for which `has_custody` is true."""
        stored = self.store.get(id)
        if stored is not None and stored.crc == crc:
            return self.numbers.content_hashes.of(stored)
        return self.numbers.accepted(custodian, number, id, crc) or crc

    def _comes_round(self, holding: Holding, datum: Datum, custodian: int, number: int) -> None:
        """A datum is offered that is here already: from now on the sender may rely on this copy."""
        # Whatever we offered of it, no answer may delete it any more.
        self.holdings.cancel(holding)
        self._accept(custodian, number, datum)
        self.take_back(holding)
        self._took(holding, custodian)

    def rejuvenate(self, id: DatumId, created: float, *, at_least: bool) -> None:
        """This node accepted custody of a datum that is here already. No checksum covers its age, and the sender
        drops its copy. If some node overstated the age of the copy here, it must not expire sooner than the sender's
        would have."""
        holding = self.holdings.get(id)
        if holding is None or created <= holding.created + _AGES_DIFFER_S:
            return
        if self.settings.data.lifetime_s is None and holding.ends == inf:
            return
        datum = self.store.get(id)
        if datum is not None:
            self.store.put(datum._replace(created=created, at_least=at_least))
            holding.created = created

    def room_for(self, size: int, *, own: bool, items: int = 1) -> bool:
        """Whether so many more data, `size` bytes of payload in all, can be stored, if necessary in place of replicas.

        `own`: a measurement of this node.
        """
        holdings = self.holdings
        return holdings.room_for(size, own=own, items=items) and self.store.room_for(size - holdings.replica_bytes)

    def may_accept(self, size: int, items: int = 1) -> bool:
        """Whether this node can take custody of so many data, `size` bytes of payload in all."""
        return self.store.accepting and self.room_for(size, own=False, items=items)

    def is_fair(self, custodian: int, origin: int, size: int) -> bool:
        """Whether a neighbour may hand over a datum of an origin, of `size` bytes of payload, if it fits.

        Where receipts are off, as in the paper, the first comer is served.
        """
        return not self.notes.active or self.holdings.is_fair(custodian, origin, size)

    def make_room(self, size: int, *, own: bool) -> bool:
        """With `store.overflow: drop-oldest`: drop the least recently used data until `size` bytes of payload fit."""
        if self.settings.store.overflow != "drop-oldest" or not self.store.accepting:
            return False
        custody = self.holdings.custody
        while not self.room_for(size, own=own):
            if not custody:
                return False
            self.drop(next(iter(custody.values())), Fate.OVERFLOW)
        return True

    def keep(self, datum: Datum, custodian: int | None = None) -> None:
        """Store a datum in custody here. `custodian`: the node that handed it over; None: it was created here."""
        self._make_way(len(datum.payload))
        self.journal.came_back(datum.id)
        holding = self.holdings.add(datum, custodian=custodian)
        self.notes.forget(datum.id)
        self.dirty = True
        self._took(holding, custodian)
        self.observer.gained(datum)

    def _make_way(self, size: int, *, distant: bool = True, near: bool = True) -> bool:
        """Drop replicas until a datum of `size` bytes of payload fits beside the rest; which, see
        `Holdings.yielding`."""
        self.overheard.make_way(size)
        while self.holdings.crowded(size):
            replica = self.holdings.yielding(distant=distant, near=near)
            if replica is None:
                return False
            self.drop(replica, Fate.OVERFLOW)
        return True

    def _took(self, holding: Holding, custodian: int | None = None) -> None:
        """A datum is now in custody. `custodian`: the node that handed it over, and keeps its copy as a replica."""
        self.repairs.end(holding.id)
        self.overheard.forget(holding.id)
        holding.moves_until = -inf
        if custodian is not None and self.settings.replicas and not holding.share:
            self.back(holding, custodian)

    def take_back(self, holding: Holding) -> None:
        """If this is a replica, take custody of it (again): a node offers it, or believes that it is lost."""
        if holding.state is State.CUSTODY:
            return
        holder, custodian = holding.holder, holding.partner
        self.journal.came_back(holding.id)
        self.holdings.change(holding, State.CUSTODY)
        if custodian is not None and self._routing.route is None:
            # This copy moves on, so another custodian cannot count on it.
            self.messages.say(custodian.id, holding.id, CopyStatus.NONE)
        self.dirty = True
        self.notes.forget(holding.id)
        self._took(holding)
        if holder is None:
            holding.custodian = None
        else:
            # It should know that it is the first of the chain now.
            self._pair(holding, holder.id)
            self.messages.say(holder.id, holding.id, CopyStatus.TAKEN)

    def rescue(self, id: DatumId) -> Holding | None:
        """Another node believes that a datum is lost: take custody of it, if there is a good copy here, which may be an
        overheard one."""
        holding = self.holdings.get(id)
        if holding is not None and self.load(holding) is not None:
            self.take_back(holding)
            return holding
        datum = self.good_overheard(id)
        if datum is None:
            return None
        self.overheard.forget(id)
        self.keep(datum.arrived())
        return self.holdings.get(id)

    # -- overheard data ------------------------------------------------------------------------------------------------

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """A neighbour sends data to another node."""
        if sender in self._routing.neighbours:
            self.overheard.hear(sender, handovers, now, self._may_keep)

    def _may_keep(self, datum: Datum) -> bool:
        return datum.id not in self.arrived and not self.has_id_conflict(datum.id) and datum.intact

    def good_overheard(self, id: DatumId) -> Datum | None:
        """An overheard datum of which custody can be taken; None: there is none, or no space for it."""
        datum = self.overheard.get(id, self.now)
        return datum if datum is not None and self.may_accept(len(datum.payload)) else None

    # -- releasing data ------------------------------------------------------------------------------------------------

    def give_away(self, holding: Holding, to: int) -> None:
        """A neighbour has taken custody of a datum."""
        if holding.id in self.receipts:
            # No base will confirm it once more, whatever the neighbour does.
            self.drop(holding, Fate.PASSED_ON)
            return
        given = self.journal.gave(
            holding.id, holding.received_from, to, holding.resent, judged=not self._may_arrive(holding)
        )
        if self._becomes_replica(holding, to):
            holding.given = given
        else:
            self.drop(holding, Fate.PASSED_ON)

    def _becomes_replica(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody: the copy here becomes its replica. Returns whether the copy stays."""
        if not self.stays(holding, to):
            return False
        # The datum goes back to the node that the holder keeps away from: nothing changes for the holder.
        chained = None if holding.custodian != to else holding.partner
        self._leave(holding, to if chained is None else chained.id)
        if self._is_base(to) or not self.is_reported(holding):
            self.holdings.change(holding, State.PASSED_ON)
        else:
            self.holdings.change(holding, State.REPLICA)
            self._pair(holding, to)
            if chained is not None and chained.id != to:
                self.chain(holding, chained.id)
        return True

    def _is_base(self, node: int) -> bool:
        neighbour = self._routing.neighbours.get(node)
        return neighbour is not None and bool(neighbour.beacon.flags & BEACON_BASE)

    def stays(self, holding: Holding, to: int) -> bool:
        """Whether the copy here stays when a neighbour takes custody. A base counts on no replica. But any node can
        claim to be a base, so where replicas are kept until a receipt this copy stays too. Of a share, and of what is
        known to have arrived, no other copy stays."""
        if not self.settings.replicas or holding.id in self.receipts:
            return False
        stays = self.settings.lasting if self._is_base(to) else not holding.share
        return stays and len(self.holdings) - len(self.holdings.custody) < MAX_REPLICAS

    def has_passed_on(self, id: DatumId) -> bool:
        """Whether this node knows that a datum is in custody elsewhere, or has arrived."""
        return id in self.holdings or id in self.journal or id in self.receipts

    def is_proof(self, holding: Holding) -> bool:
        """Whether the arrival of a datum in custody would show that the neighbour that takes it delivers: no base is
        known to have it, and it is no junk, as far as is known."""
        is_due = holding.received_from is None or self.receipts.arrives_after(holding.id)
        return is_due and self._may_arrive(holding) and holding.id not in self.receipts

    def _may_arrive(self, holding: Holding) -> bool:
        """Whether a receipt may name a datum: where there are keys, a base confirms none without a seal."""
        return holding.sealed or not self.numbers.content_hashes.proven

    def drop(self, holding: Holding, fate: Fate) -> None:
        """Drop a datum in custody, or a replica, and inform the nodes that count on the copy."""
        id, noted = holding.id, fate
        if holding.state is not State.CUSTODY:
            self._release(holding)
            custodian = self.holdings.unpair(holding)
            if custodian is not None and self.is_reported(holding) and fate in (Fate.CORRUPTED, Fate.OVERFLOW):
                self.messages.say(custodian.id, id, CopyStatus.NONE)
            # Not a loss that is recorded here: another node has custody.
            noted = Fate.PASSED_ON
        else:
            if fate in RECORDED:
                self.numbers.forget(id)
                if fate is Fate.CORRUPTED and id in self.receipts:
                    # A base has it: another copy would only take airtime.
                    noted = Fate.PASSED_ON
                elif fate is Fate.CORRUPTED and self._begin_repair(holding):
                    # Another node has been asked to take the datum back: only the copy is lost.
                    noted = Fate.PASSED_ON
                    self.notes.suspect(id, fate)
                else:
                    self.store.count(fate.value)
            self._leave(holding, None)
        self.holdings.remove(holding, noted)
        self.observer.dropped(id, fate)
        if noted in BEYOND_REPAIR:
            self.notes.make(id, noted)

    def _leave(self, holding: Holding, to: int | None) -> None:
        """A datum is about to leave custody. Its holder is informed that its replica no longer counts; `to`: the node
        that knows already."""
        holder = self.holdings.unpair(holding)
        if holder is not None and holder.id != to and self.is_reported(holding):
            self.messages.say(holder.id, holding.id, CopyStatus.PASSED_ON)

    def _begin_repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Returns whether others are asked for the datum; if not, it is lost here."""
        if not self.settings.replicas:
            return False
        holder = self.holdings.unpair(holding)
        if holder is None and not self._routing.neighbours:
            return False
        wait_s = max(0.0, holding.moves_until - self.now)
        search, given_up = self.repairs.begin(holding.id, None if holder is None else holder.id, wait_s)
        if not wait_s:
            self.ask(search)
        if given_up is not None:
            self.give_up(given_up)
        return True

    def ask(self, search: Search) -> None:
        """Ask a neighbour, or all, for a good copy of a datum."""
        self.exchange.ask(search)
        status = CopyStatus.WANTED if search.to == BROADCAST else CopyStatus.AGAIN
        self.messages.say(search.to, search.id, status)

    def give_up(self, id: DatumId) -> None:
        """A corrupt datum whose copy here is already gone is not to be had from others either: it is lost."""
        self.store.count(Fate.CORRUPTED.value)
        self.notes.give_up(id, Fate.CORRUPTED)

    # -- replicas ------------------------------------------------------------------------------------------------------

    def _keep_replica(self, custodian: int, datum: Datum, distance: Distance | None) -> bool:
        """Returns whether there is a good copy here now that the sender can count on."""
        if not self.settings.replicas or (distance is not None and self._is_near(distance)):
            return False
        holdings, id = self.holdings, datum.id
        holding = holdings.get(id)
        if holding is not None and (copy := self.load(holding)) is not None:
            if copy.payload != datum.payload or copy.crc != datum.crc:
                return False
            if distance is not None and holding.state is not State.PASSED_ON:
                return True
            if holding.state is State.CUSTODY and self._routing.route is None:
                # Of two custodians of data that rest, each may count on the other, and on no third node.
                if holding.partner is None:
                    self.back(holding, custodian)
                return holding.partner is not None and holding.partner.id == custodian
            if holding.state is State.PASSED_ON:
                holdings.change(holding, State.REPLICA)
            if holding.state is State.REPLICA:
                self._pair(holding, custodian, distance)
            return True
        full = id in self.arrived or len(holdings) - len(holdings.custody) >= MAX_REPLICAS
        if full or not self.store.accepting:
            return False
        if not self._make_way(len(datum.payload), distant=distance is None, near=False):
            return False
        holding = holdings.add(datum.arrived(), State.REPLICA, custodian)
        holding.given = self.journal.waits(custodian, 0)
        self.repairs.end(id)
        self.overheard.forget(id)
        self.notes.forget(id)
        self._pair(holding, custodian, distance)
        self.observer.gained(datum)
        return True

    def _is_near(self, distance: Distance) -> bool:
        """Whether this node hears one that a distant replica should keep away from, or is that node."""
        nodes = (distance.near, distance.custodian)
        return self.settings.node_id in nodes or any(node in self._routing.neighbours for node in nodes)

    def retire(self, holding: Holding) -> None:
        """No custodian counts on a replica any more."""
        self._release(holding)
        self.holdings.change(holding, State.PASSED_ON)

    def _release(self, holding: Holding) -> None:
        """The node that keeps a replica for a replica here is informed that it no longer counts."""
        if holding.holder is not None:
            if self.is_reported(holding):
                self.messages.say(holding.holder.id, holding.id, CopyStatus.PASSED_ON)
            self.holdings.unback(holding)

    # -- partners ------------------------------------------------------------------------------------------------------

    def count_on(self, holding: Holding, holder: int) -> None:
        """Another node keeps a replica of a copy here."""
        if holding.state is State.CUSTODY:
            self.back(holding, holder)
        else:
            self.chain(holding, holder)

    def back(self, holding: Holding, holder: int) -> None:
        """Another node keeps a replica of a datum in custody here; the previous holder is told."""
        if holding.partner is None or holding.partner.id != holder:
            self._leave(holding, holder)
            self._pair(holding, holder)
            holding.custodian = None

    def chain(self, holding: Holding, holder: int) -> None:
        """Another node keeps a replica for a replica here."""
        self.holdings.back(holding, self._partner(holder), self.now)
        self.messages.counts_on(holder, holding.id)

    def _pair(self, holding: Holding, with_whom: int, distance: Distance | None = None) -> None:
        """`distance`: a distant replica, for the replica of `with_whom`."""
        self.holdings.unpair(holding)
        self.holdings.pair(holding, self._partner(with_whom), self.now)
        self.messages.counts_on(with_whom, holding.id)
        if holding.state is State.REPLICA:
            self.begin_chain(holding, distance)

    def begin_chain(self, holding: Holding, distance: Distance | None = None) -> None:
        """This node has become the holder of a custodian, or with `distance` that of a holder."""
        assert holding.partner is not None
        holding.custodian = holding.partner.id if distance is None else distance.custodian
        if self.settings.has("distant-replicas") and holding.size <= INLINE_BYTES - DISTANT_BYTES:
            holding.further = FURTHER if distance is None else min(distance.further, FURTHER - 1)
            rest = REST_TURNS - 0.5 if distance is None else 0.0
            if holding.further and holding.holder is None:
                self.holdings.unchained[holding.id] = self.now + rest * self._routing.longest_turn_s

    def _partner(self, id: int) -> Partner:
        partner = self.holdings.partners.get(id)
        if partner is not None:
            return partner
        neighbour = self._routing.neighbours.get(id)
        if neighbour is None:
            return Partner(id, None, self.now, self._routing.longest_s)
        return Partner(id, neighbour.beacon.life, self.now, neighbour.lifetime_s)

    # -- receipts and deletion reports ---------------------------------------------------------------------------------

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs: it ends replicas and searches, but not custody."""
        receipts, holdings = self.receipts, self.holdings
        self.journal.apply(changed)
        for replicas in (holdings.replica, holdings.passed_on):
            for id in [id for id in replicas if id[:2] in changed]:
                if id in receipts:
                    self.drop(replicas[id], Fate.DELIVERED)
                elif receipts.is_reported_lost(id):
                    # The node that had custody believed it was the last copy.
                    self.rescue(id)
        for search in self.exchange.of(Search):
            if search.id[:2] in changed and search.id in receipts:
                self.repairs.end(search.id)
                self.notes.forget(search.id)
        for id in [id for id in self.overheard.data if id[:2] in changed]:
            if id in receipts:
                self.overheard.forget(id)
            elif receipts.is_reported_lost(id):
                self.rescue(id)

    @property
    def takes_notes(self) -> bool:
        """Whether deletion reports are accepted. If not, they are not answered, so they are not lost."""
        return self.notes.active

    def take_note(self, id: DatumId, note: Note) -> bool:
        """A neighbour hands over the note that a datum is lost. False: there is no space for it."""
        if self.has_id_conflict(id):
            # A note about a datum that was never created is not relayed. If it were refused, it would be offered
            # indefinitely.
            return True
        if fate_of(note.reason) not in STORE_FAULTS and self.rescue(id) is not None:
            return True
        return self.notes.take(id, note)

    # -- checking data -------------------------------------------------------------------------------------------------

    def load(self, holding: Holding) -> Datum | None:
        """A datum in custody, or a replica, ready to send. None: its bytes are corrupt, and it has been dropped."""
        datum = self.store.get(holding.id)
        if datum is not None and datum.intact:
            return datum
        self.drop(holding, Fate.CORRUPTED)
        return None

    def is_good(self, holding: Holding) -> bool:
        """Whether the bytes of a copy here are intact."""
        datum = self.store.get(holding.id)
        return datum is not None and datum.intact

    def scrub(self) -> None:
        """Verify the checksums of `scrub_items` of the copies held, replicas too, in rotation."""
        for holding in self.holdings.damaged(self.settings.store.scrub_items):
            self.drop(holding, Fate.CORRUPTED)

    def expire(self, now: float) -> None:
        """Drop data whose lifetime has ended: that of their own terms, or that of the settings."""
        lifetime_s = self.settings.data.lifetime_s
        if lifetime_s is not None:
            for holding in self.holdings.older(now - lifetime_s):
                self.drop(holding, Fate.EXPIRED)
        for holding in self.holdings.by_terms.ended(now):
            # After a restart the terms are what the disk says: a corrupt datum has not expired, it is repaired.
            if self.load(holding) is not None:
                self.drop(holding, Fate.EXPIRED)
