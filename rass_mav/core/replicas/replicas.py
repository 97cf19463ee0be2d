"""Custody with replicas: replicas, so that a datum does not die with one drone or one flipped bit.

A datum has one custodian, the node that has to move it on. One other node, its holder, keeps a replica:

- After a hand-over the sender keeps its copy. It is the holder until the receiver, the new custodian, reports that it
  has passed the datum on. The replica is then dropped or, where replicas last, kept while there is space.
- A datum that rests and has no holder gets one: its custodian sends a replica to its safest neighbour (`offers`).

A custodian that finds its copy corrupt asks its holder to take back custody. A holder also does so, unasked, when its
custodian has been gone for long or was wiped. A holder that loses its replica reports this. A datum whose receipt does
not come for long is handed over once more (`unconfirmed`).

Nothing here can endanger custody. Replicas are not custody: no node deletes a copy in custody because a replica exists.
Messages about replicas may be lost, duplicated or late. The result is at worst one copy too many, or a datum without
its replica. A holder that hears nothing for `ASK_STEPS` asks, which makes up for a lost message.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from itertools import islice

from rass_mav.core.custody.custody_store import BaseStore, CustodyStore, NoReplicas
from rass_mav.core.custody.effects import Hand
from rass_mav.core.custody.holdings import Holding, Partner, ReplicaOffer, State
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import (
    BEACON_BASE,
    INLINE_BYTES,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Distance,
    Handover,
    PassedOn,
)
from rass_mav.core.news.table import Pair
from rass_mav.core.pace import Pace
from rass_mav.core.replicas.distant import DistantOffer, DistantReplicas
from rass_mav.core.replicas.offers import ReplicaOffers
from rass_mav.core.replicas.overheard import Overheard
from rass_mav.core.replicas.repairs import MAX_SEARCHES, Repairs, Search
from rass_mav.core.replicas.replica_messages import ReplicaMessages
from rass_mav.core.replicas.unconfirmed import Unconfirmed
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.table import RoutingTable

#: Steps (turns, where they are longer) without news about a datum, after which a holder asks its custodian.
ASK_STEPS = 20
#: Neighbour lifetimes without a beacon, after which a custodian or holder is given up. The routing table forgets it
#: after one. But each one given up costs a new copy, so it should be dead, and not just have missed three beacons or
#: flown a bit away. In a moving swarm most come back, or pass their data on, in the meantime.
GONE_LIFETIMES = 8.0
#: How many data a node asks for in a step, besides those that it has just found corrupt: three frames.
WORDS_A_STEP = 33
#: Replicas a node keeps at most, if its capacity allows more.
MAX_REPLICAS = 4096
#: How many passed-on data a node remembers, to answer holders that ask.
MAX_PASSED = 256


class Replicas(NoReplicas):
    """A drone's share of custody with replicas."""

    __slots__ = (
        "_custody_store",
        "_detours",
        "_distant",
        "_now",
        "_overheard",
        "_passed",
        "_routing",
        "_unconfirmed",
        "offers",
        "repairs",
    )  # fmt: skip

    messages: ReplicaMessages

    def __init__(
        self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, risk: RiskEstimator, rng: random.Random,
        now: float,
    ) -> None:  # fmt: skip
        super().__init__()
        self._custody_store = custody_store
        self._routing = routing
        self._now = now
        """The present step's time, seconds."""
        self.messages = ReplicaMessages(custody_store.settings.node_id, self._counts)
        self.repairs = Repairs(custody_store, self.messages, now + 1.5 * routing.longest_turn_s)
        """Corrupt data that another node was asked to take back."""
        self.offers = ReplicaOffers(custody_store, routing, pace, risk, self.messages, rng)
        """Which neighbours are offered replicas."""
        self._distant = DistantReplicas(custody_store, routing, pace, self.messages, rng)
        """The distant replicas that this node sends on."""
        self._unconfirmed = Unconfirmed(custody_store, routing, pace)
        """The copies that wait for receipts."""
        self._overheard = Overheard(custody_store, routing, rng)
        """What neighbours handed over to others."""
        self.overheard = self._overheard.data
        self._detours: dict[DatumId, int] = {}
        """Data that are back in custody because no receipt came, and the neighbours they go to."""
        self._passed: dict[DatumId, int] = {}
        """Recently passed-on data, and the nodes they went to."""

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        if len(self._passed) > MAX_PASSED or len(self._custody_store.exchange.of(Search)) > MAX_SEARCHES:
            return "too much is remembered"
        return self._overheard.disagreement()

    # -- changes of custody --------------------------------------------------------------------------------------------

    def make_way(self, size: int) -> None:
        """Drop replicas until a datum of `size` bytes of payload fits beside the rest."""
        self._make_way(size, distant=True, near=True)

    def _make_way(self, size: int, *, distant: bool, near: bool) -> bool:
        self._overheard.make_way(size)
        holdings = self._custody_store.holdings
        while holdings.crowded(size):
            replica = holdings.yielding(distant=distant, near=near)
            if replica is None:
                return False
            self._custody_store.drop(replica, Fate.OVERFLOW)
        return True

    def took(self, holding: Holding, custodian: int | None = None) -> None:
        """A datum is now in custody. `custodian`: the node that handed it over, and keeps its copy as a replica."""
        self.repairs.end(holding.id)
        self._overheard.forget(holding.id)
        self._passed.pop(holding.id, None)
        if custodian is not None and not holding.share:
            self._back(holding, custodian)
            self.offers.came(holding)

    def take_back(self, holding: Holding) -> None:
        """If this is a replica, take custody of it (again)."""
        if holding.state is not State.CUSTODY:
            holder, custodian = holding.holder, holding.partner
            self._custody_store.journal.came_back(holding.id)
            self._custody_store.holdings.change(holding, State.CUSTODY)
            if custodian is not None and self._rests:
                # This copy moves on, so another custodian cannot count on it.
                self.messages.say(custodian.id, holding.id, CopyStatus.NONE)
            self._custody_store.dirty = True
            self._custody_store.notes.forget(holding.id)
            self.took(holding)
            if holder is None:
                holding.custodian = None
            else:
                # It should know that it is the first of the chain now.
                self._pair(holding, holder.id)
                self.messages.say(holder.id, holding.id, CopyStatus.TAKEN)

    def rescue(self, holding: Holding) -> None:
        """A datum was reported lost to a base, but a copy is here."""
        if self._custody_store.load(holding) is not None:
            self.take_back(holding)

    def gave(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody: the copy here becomes its replica. Returns whether the copy stays. A base
        counts on no replica. But anybody can claim to be a base, so where replicas are kept until a receipt this copy
        stays too. Of a share no other copy stays."""
        custody_store, id = self._custody_store, holding.id
        holdings = custody_store.holdings
        neighbour = self._routing.neighbours.get(to)
        to_base = neighbour is not None and neighbour.beacon.flags & BEACON_BASE
        stays = id not in custody_store.arrived and (
            self._custody_store.settings.lasting if to_base else not holding.share
        )
        stays = stays and len(holdings) - len(holdings.custody) < MAX_REPLICAS
        if stays:
            # The datum goes back to the node that the holder keeps away from: nothing changes for the holder.
            chained = None if holding.custodian != to else holding.partner
            self._leave(holding, to if chained is None else chained.id)
            if to_base:
                holdings.change(holding, State.PASSED_ON)
            else:
                holdings.change(holding, State.REPLICA)
                self._pair(holding, to)
                if chained is not None and chained.id != to:
                    self._chain(holding, chained.id)
            self._unconfirmed.handed_on(holding, to, self._now)
        self._passed[id] = to
        if len(self._passed) > MAX_PASSED:
            del self._passed[next(iter(self._passed))]
        return stays

    def left(self, holding: Holding) -> None:
        """A datum is about to leave custody. Its holder is told that nobody counts on its replica any more."""
        self._leave(holding, None)

    def _leave(self, holding: Holding, to: int | None) -> None:
        """The same; `to`: the node that knows already."""
        self.offers.settle(holding.id)
        holder = self._custody_store.holdings.unpair(holding)
        if holder is not None and holder.id != to:
            # Large data wait at the holder for that.
            large = holding.size > INLINE_BYTES
            self.messages.passed_on(holder.id, holding.id, soon=large)

    def repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Returns whether others are asked for the datum; if not, it is lost here."""
        self.offers.settle(holding.id)
        holder = self._custody_store.holdings.unpair(holding)
        if holder is None and not self._routing.neighbours:
            return False
        self.repairs.begin(holding.id, None if holder is None else holder.id)
        return True

    def _back(self, holding: Holding, holder: int) -> None:
        """Another node keeps a replica of a datum in custody here; the previous holder is told."""
        if holding.partner is None or holding.partner.id != holder:
            self._leave(holding, holder)
            self._pair(holding, holder)
            holding.custodian = None

    # -- changes of replicas -------------------------------------------------------------------------------------------

    def keep(self, custodian: int, datum: Datum, distance: Distance | None) -> bool:
        """A custodian sends a replica, or another node a distant one. Returns whether there is a good copy here
        now."""
        if distance is not None and self._distant.is_near(distance):
            return False
        custody_store = self._custody_store
        holdings = custody_store.holdings
        id = datum.id
        holding = holdings.get(id)
        if holding is not None and (copy := custody_store.load(holding)) is not None:
            if copy.payload != datum.payload or copy.crc != datum.crc:
                return False
            if distance is not None and holding.state is not State.PASSED_ON:
                return True
            if holding.state is State.CUSTODY and self._rests:
                # Of two custodians of data that rest, each may count on the other, and on no third node.
                if holding.partner is None:
                    self._back(holding, custodian)
                return holding.partner is not None and holding.partner.id == custodian
            if holding.state is State.PASSED_ON:
                holdings.change(holding, State.REPLICA)
            if holding.state is State.REPLICA:
                self._pair(holding, custodian, distance)
                # The datum has moved on to the sender from the node that took it from here.
                self._passed.pop(id, None)
            return True
        size = len(datum.payload)
        full = id in custody_store.arrived or len(holdings) - len(holdings.custody) >= MAX_REPLICAS
        if full or not custody_store.store.accepting or not self._make_way(size, distant=distance is None, near=False):
            return False
        holding = holdings.add(datum.arrived(), State.REPLICA, custodian)
        self._unconfirmed.handed_on(holding, custodian, self._now)
        self.repairs.end(id)
        self._overheard.forget(id)
        self._passed.pop(id, None)
        custody_store.notes.forget(id)
        self._pair(holding, custodian, distance)
        custody_store.observer.gained(datum)
        return True

    def let_go(self, holding: Holding, *, missing: bool, confirmed: bool) -> None:
        """A replica is about to go. `missing`: tell the custodian that counts on it. `confirmed`: because its datum has
        arrived, by what bases report."""
        if confirmed:
            self._unconfirmed.confirmed(holding, self._now)
        self._release(holding)
        custodian = self._custody_store.holdings.unpair(holding)
        if custodian is not None and missing:
            self.messages.say(custodian.id, holding.id, CopyStatus.NONE)

    # -- overheard data ------------------------------------------------------------------------------------------------

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """A neighbour sends data to another node."""
        self._overheard.hear(sender, handovers, now)

    def recover(self, id: DatumId) -> Holding | None:
        """A datum was reported lost that is not held here: take custody of it, if it was overheard."""
        return self._overheard.recover(id)

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""
        self._overheard.apply(changed)

    def _retire(self, holding: Holding) -> None:
        """Nobody counts on a replica any more."""
        self._release(holding)
        self._custody_store.holdings.change(holding, State.PASSED_ON)

    def _release(self, holding: Holding) -> None:
        """The node that keeps a replica for a replica here is told that nobody counts on it any more."""
        if holding.holder is not None:
            self.messages.passed_on(holding.holder.id, holding.id)
            self._custody_store.holdings.back(holding, None)

    # -- partners ------------------------------------------------------------------------------------------------------

    def _pair(self, holding: Holding, with_whom: int, distance: Distance | None = None) -> None:
        """`distance`: a distant replica, for the replica of `with_whom`."""
        holdings = self._custody_store.holdings
        holdings.unpair(holding)
        holdings.pair(holding, self._partner(with_whom), self._now)
        self.messages.counts_on(with_whom, holding.id)
        if holding.state is State.REPLICA:
            self._distant.backs(holding, distance, self._now)

    def _chain(self, holding: Holding, holder: int) -> None:
        """Another node keeps a replica for a replica here."""
        self._custody_store.holdings.back(holding, self._partner(holder))
        self.messages.counts_on(holder, holding.id)

    def _partner(self, id: int) -> Partner:
        partner = self._custody_store.holdings.partners.get(id)
        if partner is not None:
            return partner
        neighbour = self._routing.neighbours.get(id)
        if neighbour is None:
            return Partner(id, None, self._now, self._routing.longest_s)
        return Partner(id, neighbour.beacon.life, self._now, neighbour.lifetime_s)

    def step(self, now: float) -> None:
        """Once a step: handle partners that are gone, replicas with no news for long, and repairs without an answer."""
        self._now = now
        self.messages.step()
        holdings = self._custody_store.holdings
        if holdings.partners:
            self._look_after_partners(now)
        turn_s = self._routing.longest_turn_s
        due = now - (ASK_STEPS - 0.5) * turn_s
        for holding in list(islice(holdings.asked.values(), WORDS_A_STEP)):
            if holding.asked > due:
                break
            holdings.ask(holding, now)
            assert holding.partner is not None
            self.messages.say(holding.partner.id, holding.id, CopyStatus.STILL)
        self.repairs.step(now, turn_s, WORDS_A_STEP)
        self._overheard.step(now, turn_s)
        self.offers.step(now)
        self._detours.clear()
        if self._custody_store.settings.lasting:
            self._send_again(now)

    @property
    def _rests(self) -> bool:
        """Whether data stay where they are, because no base can be reached. Others move on soon, and new replicas would
        take bandwidth from them."""
        return self._routing.route is None

    def _send_again(self, now: float) -> None:
        """Take back custody of data whose receipt has not come for long."""
        for holding in self._unconfirmed.step(now):
            if self._custody_store.load(holding) is not None:
                self.take_back(holding)
                target = self._unconfirmed.sends(holding, now)
                if target is not None:
                    self._detours[holding.id] = target

    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody for lack of a receipt since the last call, and the neighbours they go to
        now."""
        custody = self._custody_store.holdings.custody
        detours = [(custody[id], target) for id, target in self._detours.items() if id in custody]
        self._detours.clear()
        return detours

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {"sent_again_unconfirmed": self._unconfirmed.sent_again, "overheard": len(self.overheard)}

    def _look_after_partners(self, now: float) -> None:
        custody_store, routing = self._custody_store, self._routing
        neighbours = routing.neighbours
        # Neighbours wait longer for a node that sends seldom. It waits longer too: its own messages to a partner take
        # as long.
        own = routing.lifetime_s * (routing.turn_s / routing.step_s)
        for id, partner in list(custody_store.holdings.partners.items()):
            neighbour = neighbours.get(id)
            if neighbour is not None:
                partner.heard = neighbour.heard
                partner.lifetime_s = neighbour.lifetime_s
                life = neighbour.beacon.life
                if partner.life is None:
                    partner.life = life
                if partner.life == life:
                    continue
            elif partner.heard >= now - GONE_LIFETIMES * max(partner.lifetime_s, own):
                continue
            # Gone, or its store was wiped: it has none of our data any more, or none that can be counted on.
            moved_on = neighbour is None and self._custody_store.settings.lasting
            for holding in list(partner.replicas.values()):
                if (moved_on or holding.custodian != id) and routing.route is not None:
                    # It has probably passed the datum on, or was not the custodian: this copy waits for the receipt.
                    self._retire(holding)
                elif custody_store.load(holding) is not None:
                    self.take_back(holding)
            for holding in list(partner.backed.values()):
                self._unbacked(holding)

    # -- messages ------------------------------------------------------------------------------------------------------

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was accepted before that the datum has been passed on since."""
        self.messages.passed_on(asker, id)

    def taken(self, offer: ReplicaOffer, crc: int, now: float) -> None:
        """A neighbour keeps a replica that it was offered, of a datum with this checksum."""
        if isinstance(offer, DistantOffer):
            backed = self._distant.answered(offer, now, takes=True)
            if backed is not None and backed.crc == crc:
                self._chain(backed, offer.to)
        elif (holding := self._custody_store.holdings.custody[offer.id]).crc == crc:
            self._back(holding, offer.to)

    def refused(self, offers: list[ReplicaOffer], now: float) -> Iterator[Hand]:
        """A neighbour keeps none of the replicas that it was offered: others are tried."""
        for offer in offers:
            if isinstance(offer, DistantOffer):
                self._distant.answered(offer, now, takes=False)
        return self.offers.refused([offer for offer in offers if not isinstance(offer, DistantOffer)], now)

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on and no longer counts on their replicas here."""
        custody_store = self._custody_store
        for id in message.ids:
            holding = custody_store.holdings.get(id)
            if holding is None or holding.partner is None or holding.partner.id != message.sender:
                continue
            if holding.state is State.CUSTODY:
                # Another custodian, which has handed its copy on.
                if self._rests:
                    self._unbacked(holding)
                continue
            # The next large one may follow.
            custody_store.dirty |= holding.size > INLINE_BYTES
            if custody_store.settings.lasting:
                self._retire(holding)
            else:
                custody_store.drop(holding, Fate.PASSED_ON)

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Hand]:
        """A custodian asks for data back, a holder has lost its replicas or asks about data; and the answers.

        A datum that this leaves with a single copy gets a replica at once, even where data move one hop a step.
        """
        self._hear(message.sender, message.entries)
        return self.offers.spread_at_once(dict.fromkeys(entry.id for entry in message.entries), now)

    def _hear(self, sender: int, entries: Iterable[CopyStatusEntry]) -> None:
        for id, word in entries:
            if self._rests and word in (CopyStatus.AGAIN, CopyStatus.WANTED):
                self._has_none(id, sender)
            if word == CopyStatus.AGAIN:
                self._on_again(id, sender)
            elif word == CopyStatus.STILL:
                self._on_still(id, sender)
            elif word == CopyStatus.TAKEN:
                if self.repairs.found(id, sender):
                    self._custody_store.notes.forget(id)
                self._distant.taken(id, sender, self._now)
            elif word == CopyStatus.NONE:
                self._on_none(id, sender)
            elif word == CopyStatus.WANTED:
                self.repairs.on_wanted(id, sender)
                if self._overheard.good(id) is not None:
                    self.messages.say(sender, id, CopyStatus.HERE)
            elif word == CopyStatus.HERE:
                self.repairs.on_here(id, sender)
            elif word == CopyStatus.ENCLOSED:
                self._on_enclosed(id, sender)

    def _on_again(self, id: DatumId, custodian: int) -> None:
        """A custodian's copy is corrupt, and it asks this node to take the datum back."""
        taken = self._taken_back(id, custodian)
        self.messages.say(custodian, id, CopyStatus.TAKEN if taken else CopyStatus.NONE)
        if not taken:
            self.repairs.help(id)

    def _taken_back(self, id: DatumId, asker: int) -> bool:
        """False: there is no good copy here, and this node does not answer for the datum."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is not None and custody_store.load(holding) is not None:
            # Even if the replica is for another custodian: that one may have passed the datum on to the asker.
            self.take_back(holding)
            custody_store.holdings.vouch(holding, asker)
            return True
        if self._overheard.recover(id) is not None:
            return True
        # Two custodians with corrupt copies may ask each other at the same time. Then only the one with the higher node
        # id answers for the datum, or each would believe that the other has it. That it was passed on to a third node
        # says nothing: the asker may have it from there.
        return self.repairs.take_over(id, asker)

    def _on_still(self, id: DatumId, holder: int) -> None:
        """A holder asks about a datum of which it has a replica."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is not None and holding.state is State.CUSTODY:
            if holding.partner is None:
                self._back(holding, holder)
        elif holding is not None and holding.holder is not None and holding.holder.id == holder:
            return
        elif not self.repairs.is_under_way(id) and (holding is not None or id in self._passed):
            self.messages.passed_on(holder, id)
        else:
            self.messages.say(holder, id, CopyStatus.AGAIN)

    def _on_none(self, id: DatumId, sender: int) -> None:
        """A neighbour has no good copy: the holder, or another node that was asked for it."""
        if not self._has_none(id, sender):
            self.repairs.on_none(id, sender)

    def _has_none(self, id: DatumId, sender: int) -> bool:
        """A neighbour has no good copy. Returns whether it was counted on here."""
        holding = self._custody_store.holdings.get(id)
        if holding is None or sender != _id(_holder_of(holding)):
            return False
        self._unbacked(holding)
        return True

    def _on_enclosed(self, id: DatumId, holder: int) -> None:
        """A holder knows no node that could have a distant replica."""
        holding = self._custody_store.holdings.get(id)
        if holding is None or holder != _id(_holder_of(holding)):
            return
        custody = holding.state is State.CUSTODY
        if self.offers.avoid(holder, self._now) if custody else self._distant.avoid(holding, holder, self._now):
            self._unbacked(holding)
            self.messages.passed_on(holder, id)

    def _counts(self, id: DatumId) -> bool:
        """Whether this node counts on a neighbour's copy, or may do so soon."""
        holding = self._custody_store.holdings.get(id)
        if holding is None or holding.state is State.PASSED_ON:
            return False
        return holding.state is State.CUSTODY or holding.holder is not None or bool(holding.offers)

    def _unbacked(self, holding: Holding) -> None:
        """A copy here has no holder any more."""
        if holding.state is State.CUSTODY:
            self._custody_store.holdings.unpair(holding)
        else:
            self._custody_store.holdings.back(holding, None)
            self._distant.lost(holding, self._now)

    def spread(self, now: float) -> Iterator[Hand]:
        """Replicas of data that rest without a holder, within the bandwidth."""
        return self.offers.spread(now)

    def spread_far(self, now: float) -> Iterator[Hand]:
        """Distant replicas of data that rest, within the bandwidth that is left."""
        return self._distant.spread(now) if self._custody_store.settings.lasting else iter(())


def _holder_of(holding: Holding) -> Partner | None:
    """The node that keeps a replica for this copy."""
    return holding.partner if holding.state is State.CUSTODY else holding.holder


def _id(partner: Partner | None) -> int | None:
    return None if partner is None else partner.id


class AtBase(NoReplicas):
    """A base's answers about replicas: it keeps none, because its data have arrived."""

    __slots__ = ("_custody_store",)

    messages: ReplicaMessages

    def __init__(self, custody_store: BaseStore) -> None:
        super().__init__()
        self._custody_store = custody_store
        self.messages = ReplicaMessages(custody_store.settings.node_id, lambda id: False)

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """Data have arrived."""
        self._custody_store.overhear(handovers)

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Hand]:
        """Some node did not know that it handed over to a base, and asks about its replicas."""
        for id, word in message.entries:
            if word == CopyStatus.STILL and self._custody_store.has(id):
                self.messages.passed_on(message.sender, id, soon=True)
        return iter(())
