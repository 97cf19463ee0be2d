"""Custody with replicas: replicas, so that a datum does not die with one drone or one flipped bit.

A datum has one custodian, the node that has to move it on. One other node, its holder, keeps a replica:

- After a hand-over the sender keeps its copy. It is the holder until the receiver, the new custodian, reports that it
  has passed the datum on. The replica is then dropped or, where replicas last, kept while there is space.
- A datum that rests and has no holder gets one: its custodian sends a replica to its safest neighbour (`offers`).

A custodian that finds its copy corrupt asks its holder to take back custody. A holder also does so, unasked, when its
custodian has been gone for long or was wiped. A holder that loses its replica reports this. A datum whose receipt does
not come for long is handed over once more (`unconfirmed`).

Where replicas last until a receipt and a base can be reached, small data move on soon, and nobody reports on copies
(`CustodyStore.is_reported`): those left behind wait for the receipt.

Nothing here can endanger custody. Replicas are not custody: no node deletes a copy in custody because a replica exists.
Messages about replicas may be lost, duplicated or late. The result is at worst one copy too many, or a datum without
its replica. A holder that hears nothing for `ASK_STEPS` asks, which makes up for a lost message; and a custodian that
is not asked for long has no holder.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import islice, takewhile

from rass_mav.core.custody.base_store import BaseStore
from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.effects import Count, Drop, Effect, Retire, Take, Tell
from rass_mav.core.custody.holdings import Holding, Partner, ReplicaOffer, State
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import INLINE_BYTES, CopyStatus, CopyStatuses
from rass_mav.core.pace import Pace
from rass_mav.core.replicas.distant import DistantOffer, DistantReplicas
from rass_mav.core.replicas.offers import ReplicaOffers
from rass_mav.core.replicas.unconfirmed import Unconfirmed
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.table import RoutingTable

# Tuned: python -m tools.sensitivity replicas.replicas
#: Steps (turns, where they are longer) without news about a datum, after which a holder asks its custodian.
ASK_STEPS = 20
#: Bound: A holder that has not asked about a datum for so many times as long has no replica of it any more.
SILENT = 3
#: Neighbour lifetimes without a beacon, after which a custodian or holder is given up. The routing table forgets it
#: after one. But each one given up costs a new copy, so it should be dead, and not just have missed three beacons or
#: flown a bit away. In a moving swarm most come back, or pass their data on, in the meantime.
GONE_LIFETIMES = 8.0
#: Bound: How many data a node asks for in a step, besides those that it has just found corrupt: three frames.
WORDS_A_STEP = 33


class NoReplicas:
    """No replicas are kept, here or for this node."""

    __slots__ = ()

    def step(self, now: float) -> Iterator[Effect]:
        """Once a step."""
        return iter(())

    @property
    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody in this step for lack of a receipt, and the neighbours they go to now."""
        return []

    def spread(self, now: float) -> Iterator[Effect]:
        """Replicas of data that rest without a holder, within the bandwidth."""
        return iter(())

    def spread_far(self, now: float) -> Iterator[Effect]:
        """Once a turn: distant replicas, within the bandwidth that is left."""
        return iter(())

    def taken(self, offer: ReplicaOffer, crc: int, now: float) -> Iterator[Effect]:
        """A neighbour keeps a replica that it was offered, of a datum with this checksum."""
        return iter(())

    def refused(self, offers: list[ReplicaOffer], now: float) -> Iterator[Effect]:
        """A neighbour keeps none of the replicas that it was offered."""
        return iter(())

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Effect]:
        """A custodian or a holder reports something about data."""
        return iter(())

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {}


class Replicas(NoReplicas):
    """A drone's share of custody with replicas."""

    __slots__ = ("_custody_store", "_detours", "_distant", "_routing", "_unconfirmed", "offers")

    def __init__(
        self, custody_store: CustodyStore, routing: RoutingTable, pace: Pace, risk: RiskEstimator, rng: random.Random
    ) -> None:
        self._custody_store = custody_store
        self._routing = routing
        self.offers = ReplicaOffers(custody_store, routing, pace, risk, rng)
        """Which neighbours are offered replicas."""
        self._distant = DistantReplicas(custody_store, routing, pace, rng)
        """The distant replicas that this node sends on."""
        self._unconfirmed = Unconfirmed(custody_store, routing, pace)
        """The copies that wait for receipts."""
        self._detours: list[tuple[Holding, int]] = []

    def step(self, now: float) -> Iterator[Effect]:
        """Once a step: handle partners that are gone, replicas with no news for long, and repairs without an answer."""
        custody_store, holdings = self._custody_store, self._custody_store.holdings
        if holdings.partners:
            yield from self._look_after_partners(now)
        turn_s = self._routing.longest_turn_s
        due = now - (ASK_STEPS - 0.5) * turn_s
        for holding in list(islice(holdings.replica.values(), WORDS_A_STEP)):
            if holding.asked > due:
                break
            if not custody_store.is_reported(holding):
                # By now its partner has passed it on.
                yield Retire(holding)
                continue
            holdings.ask(holding, now)
            assert holding.partner is not None
            yield Tell(holding.partner.id, holding.id, CopyStatus.STILL)
        yield from custody_store.repairs.step(now, turn_s, WORDS_A_STEP)
        custody_store.overheard.step(now, turn_s, custody_store.settings.data.lifetime_s)
        self._detours = []
        if custody_store.settings.lasting:
            yield from self._send_again(now)

    @property
    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody in this step for lack of a receipt, and the neighbours they go to now."""
        return self._detours

    @property
    def _rests(self) -> bool:
        """Whether data stay where they are, because no base can be reached. Others move on soon, and new replicas would
        take bandwidth from them."""
        return self._routing.route is None

    def _send_again(self, now: float) -> Iterator[Effect]:
        """Take back custody of data whose receipt has not come for long."""
        for holding in self._unconfirmed.step():
            yield Take(holding.id)
            if holding.state is State.CUSTODY and (target := self._unconfirmed.sends(holding, now)) is not None:
                self._detours.append((holding, target))

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {
            "sent_again_unconfirmed": self._unconfirmed.sent_again,
            "overheard": len(self._custody_store.overheard.data),
        }

    def _look_after_partners(self, now: float) -> Iterator[Effect]:
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
                    self._look_after_backed(partner, now)
                    continue
            elif partner.heard >= now - GONE_LIFETIMES * max(partner.lifetime_s, own):
                continue
            # Gone, or its store was wiped: it has none of our data any more, or none that can be counted on.
            moved_on = neighbour is None and self._custody_store.settings.lasting
            for holding in list(partner.replicas.values()):
                if (moved_on or holding.custodian != id) and routing.route is not None:
                    # It has probably passed the datum on, or was not the custodian: this copy waits for the receipt.
                    yield Retire(holding)
                else:
                    yield Take(holding.id)
            for holding in list(partner.backed.values()):
                self._unbacked(holding)

    def _look_after_backed(self, partner: Partner, now: float) -> None:
        """A holder that does not ask about a datum any more has lost its replica, and its report of that was lost; or
        nobody reports, and the datum has been here for long."""
        due = now - SILENT * ASK_STEPS * self._routing.longest_turn_s
        for holding in list(takewhile(lambda holding: holding.kept <= due, partner.backed.values())):
            self._unbacked(holding)

    # -- messages ------------------------------------------------------------------------------------------------------

    def taken(self, offer: ReplicaOffer, crc: int, now: float) -> Iterator[Effect]:
        """A neighbour keeps a replica that it was offered, of a datum with this checksum."""
        if isinstance(offer, DistantOffer):
            backed = self._distant.answered(offer, now, takes=True)
            if backed is not None and backed.crc == crc:
                yield Count(backed, offer.to)
        elif (holding := self._custody_store.holdings.custody[offer.id]).crc == crc:
            self.offers.taken(offer.to)
            yield Count(holding, offer.to)

    def refused(self, offers: list[ReplicaOffer], now: float) -> Iterator[Effect]:
        """A neighbour keeps none of the replicas that it was offered: others are tried."""
        for offer in offers:
            if isinstance(offer, DistantOffer):
                self._distant.answered(offer, now, takes=False)
        return self.offers.refused([offer for offer in offers if not isinstance(offer, DistantOffer)], now)

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Effect]:
        """A custodian asks for data back, a holder has lost its replicas or asks about data; and the answers.

        A datum that this leaves with a single copy gets a replica at once, even where data move one hop a step.
        """
        sender, repairs = message.sender, self._custody_store.repairs
        for id, status in message.entries:
            if self._rests and status in (CopyStatus.AGAIN, CopyStatus.WANTED):
                self._has_none(id, sender)
            if status == CopyStatus.AGAIN:
                yield from self._on_again(id, sender)
            elif status == CopyStatus.STILL:
                yield from self._on_still(id, sender)
            elif status == CopyStatus.TAKEN:
                yield from self._on_taken(id, sender)
            elif status == CopyStatus.NONE:
                if not self._has_none(id, sender):
                    yield from repairs.on_none(id, sender)
            elif status == CopyStatus.WANTED:
                yield from self._on_wanted(id, sender)
            elif status == CopyStatus.HERE:
                yield from repairs.on_here(id, sender)
            elif status == CopyStatus.ENCLOSED:
                yield from self._on_enclosed(id, sender, now)
            elif status == CopyStatus.PASSED_ON:
                yield from self._on_passed_on(id, sender)
        yield from self.offers.spread_at_once([*dict.fromkeys(entry.id for entry in message.entries)], now)

    def _on_passed_on(self, id: DatumId, custodian: int) -> Iterator[Effect]:
        """A custodian has passed a datum on, and no longer counts on the replica here."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is None or _id(holding.partner) != custodian:
            return
        if holding.state is State.CUSTODY:
            # Another custodian, which has handed its copy on.
            if self._rests:
                self._unbacked(holding)
            return
        # The next large one may follow.
        custody_store.dirty |= holding.size > INLINE_BYTES
        # Whoever looks for it may find no other copy.
        stays = custody_store.settings.lasting or holding.sought_by is not None
        yield Retire(holding) if stays else Drop(holding, Fate.PASSED_ON)

    def _on_again(self, id: DatumId, custodian: int) -> Iterator[Effect]:
        """A custodian's copy is corrupt, and it asks this node to take the datum back."""
        holdings, repairs = self._custody_store.holdings, self._custody_store.repairs
        # Even if the replica is for another custodian: that one may have passed the datum on to the asker.
        yield Take(id)
        holding = holdings.custody.get(id)
        if holding is not None:
            holdings.vouch(holding, custodian)
        # Two custodians with corrupt copies may ask each other at the same time. Then only the one with the higher node
        # id answers for the datum, or each would believe that the other has it. That it was passed on to a third node
        # says nothing: the asker may have it from there.
        if holding is not None or repairs.take_over(id, custodian):
            yield Tell(custodian, id, CopyStatus.TAKEN)
        else:
            yield Tell(custodian, id, CopyStatus.NONE)
            yield from repairs.help(id)

    def _on_wanted(self, id: DatumId, asker: int) -> Iterator[Effect]:
        """A neighbour looks for a datum."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is not None and not custody_store.is_good(holding):
            yield Drop(holding, Fate.CORRUPTED)
            holding = None
        if holding is None:
            if custody_store.good_overheard(id) is not None:
                yield Tell(asker, id, CopyStatus.HERE)
        elif holding.state is State.CUSTODY:
            custody_store.holdings.vouch(holding, asker)
            yield Tell(asker, id, CopyStatus.TAKEN)
        elif (custodian := self._custodian_of(holding, asker)) is not None and holding.sought_by != asker:
            # It may have passed the datum on, even to the asker. What it says now is true.
            holding.sought_by = asker
            yield Tell(custodian, id, CopyStatus.WANTED)
        else:
            yield Tell(asker, id, CopyStatus.HERE)

    def _custodian_of(self, holding: Holding, asker: int) -> int | None:
        """The custodian in range that a replica here belongs to; None: there is none, or it is the one that asks."""
        partner = holding.partner
        if holding.state is not State.REPLICA or partner is None or asker in (partner.id, holding.custodian):
            return None
        return partner.id if partner.id in self._routing.neighbours else None

    def _on_taken(self, id: DatumId, sender: int) -> Iterator[Effect]:
        """A node has custody of a datum: it need not be looked for here, nor where others asked this node for it."""
        custody_store = self._custody_store
        if custody_store.repairs.found(id, sender):
            custody_store.notes.forget(id)
        holding = custody_store.holdings.replica.get(id)
        if holding is None or _id(holding.partner) != sender:
            return
        if holding.sought_by is not None:
            yield Tell(holding.sought_by, id, CopyStatus.TAKEN)
            holding.sought_by = None
        # This is the first of the chain.
        custody_store.begin_chain(holding)

    def _on_still(self, id: DatumId, holder: int) -> Iterator[Effect]:
        """A holder asks about a datum of which it has a replica."""
        custody_store = self._custody_store
        holding = custody_store.holdings.get(id)
        if holding is not None and _id(holding.counted_on) == holder:
            custody_store.holdings.keeps(holding, custody_store.now)
        elif holding is not None and holding.state is State.CUSTODY:
            if holding.partner is None:
                yield Count(holding, holder)
        elif not custody_store.repairs.is_under_way(id) and custody_store.has_passed_on(id):
            yield Tell(holder, id, CopyStatus.PASSED_ON)
        elif id not in custody_store.arrived:
            # If it has arrived only by hearsay, the holder keeps its replica, and asks again later.
            yield Tell(holder, id, CopyStatus.AGAIN)

    def _has_none(self, id: DatumId, sender: int) -> bool:
        """A neighbour has no good copy. Returns whether it was counted on here."""
        holding = self._custody_store.holdings.get(id)
        if holding is None or sender != _id(holding.counted_on):
            return False
        self._unbacked(holding)
        return True

    def _on_enclosed(self, id: DatumId, holder: int, now: float) -> Iterator[Effect]:
        """A holder knows no node that could have a distant replica."""
        holding = self._custody_store.holdings.get(id)
        if holding is None or holder != _id(holding.counted_on):
            return
        custody = holding.state is State.CUSTODY
        if self.offers.avoid(holder, now) if custody else self._distant.avoid(holding, holder, now):
            self._unbacked(holding)
            yield Tell(holder, id, CopyStatus.PASSED_ON)

    def _unbacked(self, holding: Holding) -> None:
        """A copy here has no holder any more."""
        if holding.state is State.CUSTODY:
            self._custody_store.holdings.unpair(holding)
        else:
            self._custody_store.holdings.unback(holding)
            self._distant.lost(holding, self._custody_store.now)

    def spread(self, now: float) -> Iterator[Effect]:
        """Replicas of data that rest without a holder, within the bandwidth."""
        return self.offers.spread(now)

    def spread_far(self, now: float) -> Iterator[Effect]:
        """Distant replicas of data that rest, within the bandwidth that is left."""
        return self._distant.spread(now) if self._custody_store.settings.lasting else iter(())


def _id(partner: Partner | None) -> int | None:
    return None if partner is None else partner.id


class AtBase(NoReplicas):
    """A base's answers about replicas: it keeps none, because its data have arrived."""

    __slots__ = ("_base_store",)

    def __init__(self, base_store: BaseStore) -> None:
        self._base_store = base_store

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Effect]:
        """Some node did not know that it handed over to a base, and asks about its replicas."""
        for id, status in message.entries:
            if status == CopyStatus.STILL and self._base_store.has(id):
                yield Tell(message.sender, id, CopyStatus.PASSED_ON)
