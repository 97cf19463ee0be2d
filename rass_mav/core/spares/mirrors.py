"""Mirrored custody: spare copies, so that a datum does not die with one drone or one flipped bit.

A datum has one custodian, the node that has to move it on. One other node, its backer, keeps a spare copy:

- After a hand-over the giver keeps its copy. It is the backer until the receiver, the new custodian, reports that it
  has passed the datum on. The spare is then dropped or, where replicas last, kept while there is space.
- A datum that rests and has no backer gets one: its custodian sends a spare copy to its safest neighbour (`offers`).

A custodian that finds its copy corrupt asks its backer to take back custody. A backer also does so, unasked, when its
custodian has been gone for long or was wiped. A backer that loses its spare reports this. A datum whose receipt does
not come for long is handed over once more (`unconfirmed`).

Nothing here can endanger custody. Spares are not custody: no node deletes a copy in custody because a spare exists.
Messages about spares may be lost, duplicated or late. The result is at worst one copy too many, or a datum without its
spare. A backer that hears nothing for `ASK_STEPS` asks, which makes up for a lost message.
"""

from __future__ import annotations

import random
from collections.abc import Iterable
from itertools import islice

from rass_mav.core.custody.holdings import Holding, Partner, State
from rass_mav.core.custody.keeper import Keeper
from rass_mav.core.custody.nospares import NoSpares
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import (
    BEACON_BASE,
    Committed,
    Digest,
    Distance,
    Handover,
    Message,
    PassedOn,
    Word,
    WordEntry,
    Words,
)
from rass_mav.core.news.table import Pair
from rass_mav.core.pace import Pace
from rass_mav.core.risk import RiskEstimator
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.spares.distant import DistantSpares
from rass_mav.core.spares.offers import SpareOffers
from rass_mav.core.spares.overheard import Overheard
from rass_mav.core.spares.repairs import Repairs
from rass_mav.core.spares.speech import Speech
from rass_mav.core.spares.unconfirmed import Unconfirmed

#: Steps (turns, where they are longer) without news about a datum, after which a backer asks its custodian.
ASK_STEPS = 20
#: Neighbour lifetimes without a beacon, after which a custodian or backer is given up. The routing table forgets it
#: after one. But each one given up costs a new copy, so it should be dead, and not just have missed three beacons or
#: flown a bit away. In a moving swarm most come back, or pass their data on, in the meantime.
GONE_LIFETIMES = 8.0
#: How many data a node asks for in a step, besides those that it has just found corrupt: three frames.
WORDS_A_STEP = 33
#: Spares a node keeps at most, if its capacity allows more.
MAX_SPARES = 4096
#: How many passed-on data a node remembers, to answer backers that ask.
MAX_PASSED = 256


class Mirrors(NoSpares):
    """A drone's share of mirrored custody."""

    __slots__ = (
        "_again_at", "_detours", "_distant", "_keeper", "_now", "_offers", "_overheard", "_passed", "_repairs",
        "_routing", "_speech", "_unconfirmed",
    )  # fmt: skip

    def __init__(
        self, keeper: Keeper, routing: RoutingTable, pace: Pace, risk: RiskEstimator, rng: random.Random, now: float,
    ) -> None:  # fmt: skip
        self._keeper = keeper
        self._routing = routing
        self._now = now
        """The present step's time, seconds."""
        self._speech = Speech(keeper.settings.node_id, self._counts)
        self._repairs = Repairs(keeper, self._speech)
        """Corrupt data that another node was asked to take back."""
        self._offers = SpareOffers(keeper, routing, pace, risk, self._speech, rng)
        """Which neighbours are offered spares."""
        self._distant = DistantSpares(keeper, routing, pace, self._speech, rng)
        """The distant spares that this node sends on."""
        self._unconfirmed = Unconfirmed(keeper, routing, pace)
        """The copies that wait for receipts."""
        self._overheard = Overheard(keeper, routing, rng)
        """What neighbours handed over to others."""
        self._detours: dict[DatumId, int] = {}
        """Data that are back in custody because no receipt came, and the neighbours they go to."""
        self._again_at = now
        """When nodes that have not answered are asked again, seconds."""
        self._passed: dict[DatumId, int] = {}
        """Recently passed-on data, and the nodes they went to."""

    # -- changes of custody --------------------------------------------------------------------------------------------

    def make_way(self, size: int) -> None:
        """Drop spares until a datum of `size` bytes of payload fits beside the rest."""
        self._make_way(size, distant=True, near=True)

    def _make_way(self, size: int, *, distant: bool, near: bool) -> bool:
        self._overheard.make_way(size)
        holdings = self._keeper.holdings
        while holdings.crowded(size):
            spare = holdings.yielding(distant=distant, near=near)
            if spare is None:
                return False
            self._keeper.drop(spare, Fate.OVERFLOW)
        return True

    def took(self, holding: Holding, giver: int | None = None) -> None:
        """A datum is now in custody. `giver`: the node that handed it over, and keeps its copy as a spare."""
        self._repairs.end(holding.id)
        self._overheard.forget(holding.id)
        self._passed.pop(holding.id, None)
        if giver is not None and not holding.told.share:
            self._back(holding, giver)
            self._offers.came(holding)

    def take_back(self, holding: Holding) -> None:
        """If this is a spare, take custody of it (again)."""
        if holding.state is not State.CUSTODY:
            backer, custodian = holding.backer, holding.partner
            self._keeper.takers.came_back(holding.id)
            self._keeper.holdings.change(holding, State.CUSTODY)
            if custodian is not None and self._rests:
                # This copy moves on, so another custodian cannot count on it.
                self._speech.say(custodian.id, holding.id, Word.NONE)
            self._keeper.stirred = True
            self._keeper.notes.forget(holding.id)
            self.took(holding)
            if backer is None:
                holding.custodian = None
            else:
                # It should know that it is the first of the chain now.
                self._pair(holding, backer.id)
                self._speech.say(backer.id, holding.id, Word.TAKEN)

    def rescue(self, holding: Holding) -> None:
        """A datum was reported lost to a base, but a copy is here."""
        if self._keeper.load(holding) is not None:
            self.take_back(holding)

    def gave(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody: the copy here becomes its spare. Returns whether the copy stays. A base counts
        on no spare. But anybody can claim to be a base, so where spares are kept until a receipt this copy stays
        too. Of a share no other copy stays."""
        keeper, id = self._keeper, holding.id
        holdings = keeper.holdings
        neighbour = self._routing.neighbours.get(to)
        to_base = neighbour is not None and neighbour.beacon.flags & BEACON_BASE
        stays = id not in keeper.arrived and (self._keeper.settings.lasting if to_base else not holding.told.share)
        stays = stays and len(holdings) - len(holdings.custody) < MAX_SPARES
        if stays:
            # The datum goes back to the node that the backer keeps away from: nothing changes for the backer.
            chained = None if holding.custodian != to else holding.partner
            self._leave(holding, to if chained is None else chained.id)
            if to_base:
                holdings.change(holding, State.PASSED_ON)
            else:
                holdings.change(holding, State.SPARE)
                self._pair(holding, to)
                if chained is not None and chained.id != to:
                    self._chain(holding, chained.id)
            self._unconfirmed.handed_on(holding, to, self._now)
        self._passed[id] = to
        if len(self._passed) > MAX_PASSED:
            del self._passed[next(iter(self._passed))]
        return stays

    def left(self, holding: Holding) -> None:
        """A datum is about to leave custody. Its backer is told that nobody counts on its spare any more."""
        self._leave(holding, None)

    def _leave(self, holding: Holding, to: int | None) -> None:
        """The same; `to`: the node that knows already."""
        self._offers.settle(holding.id)
        backer = self._keeper.holdings.unpair(holding)
        if backer is not None and backer.id != to:
            # Large data wait at the backer for that.
            large = holding.size > self._keeper.settings.inline_bytes
            self._speech.passed_on(backer.id, holding.id, soon=large)

    def repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Returns whether others are asked for the datum; if not, it is lost here."""
        self._offers.settle(holding.id)
        backer = self._keeper.holdings.unpair(holding)
        if backer is None and not self._routing.neighbours:
            return False
        self._repairs.begin(holding.id, None if backer is None else backer.id)
        return True

    def _back(self, holding: Holding, backer: int) -> None:
        """Another node keeps a spare of a datum in custody here; the previous backer is told."""
        if holding.partner is None or holding.partner.id != backer:
            self._leave(holding, backer)
            self._pair(holding, backer)
            holding.custodian = None

    # -- changes of spares ---------------------------------------------------------------------------------------------

    def keep(self, giver: int, datum: Datum, distance: Distance | None) -> bool:
        """A custodian sends a spare copy, or another node a distant one. Returns whether there is a good copy here
        now."""
        if distance is not None and self._distant.is_near(distance):
            return False
        keeper = self._keeper
        holdings = keeper.holdings
        id = datum.id
        holding = holdings.get(id)
        if holding is not None and (copy := keeper.load(holding)) is not None:
            if copy.payload != datum.payload or copy.crc != datum.crc:
                return False
            if distance is not None and holding.state is not State.PASSED_ON:
                return True
            if holding.state is State.CUSTODY and self._rests:
                # Of two custodians of data that rest, each may count on the other, and on no third node.
                if holding.partner is None:
                    self._back(holding, giver)
                return holding.partner is not None and holding.partner.id == giver
            if holding.state is State.PASSED_ON:
                holdings.change(holding, State.SPARE)
            if holding.state is State.SPARE:
                self._pair(holding, giver, distance)
                # The datum has moved on to the giver from the node that took it from here.
                self._passed.pop(id, None)
            return True
        size = len(datum.payload)
        full = id in keeper.arrived or len(holdings) - len(holdings.custody) >= MAX_SPARES
        if full or not keeper.store.accepting or not self._make_way(size, distant=distance is None, near=False):
            return False
        holding = holdings.add(datum.arrived(), State.SPARE, giver)
        self._unconfirmed.handed_on(holding, giver, self._now)
        self._repairs.end(id)
        self._overheard.forget(id)
        self._passed.pop(id, None)
        keeper.notes.forget(id)
        self._pair(holding, giver, distance)
        keeper.observer.gained(datum)
        return True

    def let_go(self, holding: Holding, *, missing: bool, confirmed: bool) -> None:
        """A spare is about to go. `missing`: tell the custodian that counts on it. `confirmed`: because its datum has
        arrived, by what bases report."""
        if confirmed:
            self._unconfirmed.confirmed(holding, self._now)
        self._release(holding)
        custodian = self._keeper.holdings.unpair(holding)
        if custodian is not None and missing:
            self._speech.say(custodian.id, holding.id, Word.NONE)

    # -- overheard data ------------------------------------------------------------------------------------------------

    @property
    def overheard(self) -> dict[DatumId, Datum]:
        """Data that others handed over to each other, and that are kept here in memory; the oldest first."""
        return self._overheard.data

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """A neighbour sends data to another node."""
        self._overheard.hear(sender, handovers, now)

    def recover(self, id: DatumId) -> Holding | None:
        """A datum was reported lost that is not held here: take custody of it, if it was overheard."""
        return self._overheard.recover(id)

    def heed(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""
        self._overheard.heed(changed)

    def heed_digest(self, digest: Digest) -> None:
        """A base reports what has arrived lately."""
        self._overheard.heed_digest(digest)

    def _retire(self, holding: Holding) -> None:
        """Nobody counts on a spare any more."""
        self._release(holding)
        self._keeper.holdings.change(holding, State.PASSED_ON)

    def _release(self, holding: Holding) -> None:
        """The node that keeps a spare for a spare here is told that nobody counts on it any more."""
        if holding.backer is not None:
            self._speech.passed_on(holding.backer.id, holding.id)
            self._keeper.holdings.back(holding, None)

    # -- partners ------------------------------------------------------------------------------------------------------

    def _pair(self, holding: Holding, with_whom: int, distance: Distance | None = None) -> None:
        """`distance`: a distant spare, for the spare of `with_whom`."""
        holdings = self._keeper.holdings
        holdings.unpair(holding)
        holdings.pair(holding, self._partner(with_whom), self._now)
        self._speech.counts_on(with_whom, holding.id)
        if holding.state is State.SPARE:
            self._distant.backs(holding, distance, self._now)

    def _chain(self, holding: Holding, backer: int) -> None:
        """Another node keeps a spare for a spare here."""
        self._keeper.holdings.back(holding, self._partner(backer))
        self._speech.counts_on(backer, holding.id)

    def _partner(self, id: int) -> Partner:
        partner = self._keeper.holdings.partners.get(id)
        if partner is not None:
            return partner
        neighbour = self._routing.neighbours.get(id)
        if neighbour is None:
            return Partner(id, None, self._now, self._routing.longest_s)
        return Partner(id, neighbour.beacon.life, self._now, neighbour.lifetime_s)

    def step(self, now: float) -> None:
        """Once a step: handle partners that are gone, spares with no news for long, and repairs without an answer."""
        self._now = now
        self._speech.step()
        holdings = self._keeper.holdings
        if holdings.partners:
            self._look_after_partners(now)
        turn_s = self._routing.longest_turn_s
        due = now - (ASK_STEPS - 0.5) * turn_s
        for holding in list(islice(holdings.asked.values(), WORDS_A_STEP)):
            if holding.asked > due:
                break
            holdings.ask(holding, now)
            assert holding.partner is not None
            self._speech.say(holding.partner.id, holding.id, Word.STILL)
        if now >= self._again_at:
            self._again_at = now + turn_s - 0.5 * self._keeper.settings.step_s
            self._repairs.step(WORDS_A_STEP)
        self._overheard.step(now, turn_s)
        self._offers.step(now)
        self._detours.clear()
        if self._keeper.settings.lasting:
            self._send_again(now)

    @property
    def _rests(self) -> bool:
        """Whether data stay where they are, because no base can be reached. Others move on soon, and new spares would
        take bandwidth from them."""
        return self._routing.route is None

    def _send_again(self, now: float) -> None:
        """Take back custody of data whose receipt has not come for long."""
        for holding in self._unconfirmed.step(now):
            if self._keeper.load(holding) is not None:
                self.take_back(holding)
                target = self._unconfirmed.sends(holding, now)
                if target is not None:
                    self._detours[holding.id] = target

    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody for lack of a receipt since the last call, and the neighbours they go to
        now."""
        custody = self._keeper.holdings.custody
        detours = [(custody[id], target) for id, target in self._detours.items() if id in custody]
        self._detours.clear()
        return detours

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {"sent_again_unconfirmed": self._unconfirmed.sent_again, "overheard": len(self.overheard)}

    def _look_after_partners(self, now: float) -> None:
        keeper, routing = self._keeper, self._routing
        neighbours = routing.neighbours
        # Neighbours wait longer for a node that sends seldom. It waits longer too: its own messages to a partner take
        # as long.
        own = routing.lifetime_s * (routing.turn_s / routing.step_s)
        for id, partner in list(keeper.holdings.partners.items()):
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
            moved_on = neighbour is None and self._keeper.settings.lasting
            for holding in list(partner.spares.values()):
                if (moved_on or holding.custodian != id) and routing.route is not None:
                    # It has probably passed the datum on, or was not the custodian: this copy waits for the receipt.
                    self._retire(holding)
                elif keeper.load(holding) is not None:
                    self.take_back(holding)
            for holding in list(partner.backed.values()):
                self._unbacked(holding)

    # -- messages ------------------------------------------------------------------------------------------------------

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was accepted before that the datum has been passed on since."""
        self._speech.passed_on(asker, id)

    def answered(self, message: Committed, now: float, out: list[Message]) -> None:
        """A neighbour took spares, or refused them: then another is tried. Other numbers are ignored."""
        keeper = self._keeper
        for number, crc in message.committed:
            holding = keeper.holdings.offered(number, message.sender)
            if holding is not None and holding.crc == crc:
                self._back(holding, message.sender)
            backed = self._distant.answered(number, message.sender, now, kept=True)
            if backed is not None and backed.crc == crc:
                self._chain(backed, message.sender)
        for number in message.refused:
            self._distant.answered(number, message.sender, now, kept=False)
        if message.refused:
            self._offers.on_refused(message.refused, message.sender, now, out)

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on and no longer counts on their spares here."""
        keeper = self._keeper
        for id in message.ids:
            holding = keeper.holdings.get(id)
            if holding is None or holding.partner is None or holding.partner.id != message.sender:
                continue
            if holding.state is State.CUSTODY:
                # Another custodian, which has handed its copy on.
                if self._rests:
                    self._unbacked(holding)
                continue
            # The next large one may follow.
            keeper.stirred |= holding.size > keeper.settings.inline_bytes
            if holding.matched:
                keeper.drop(holding, Fate.DELIVERED)
            elif keeper.settings.lasting:
                self._retire(holding)
            else:
                keeper.drop(holding, Fate.PASSED_ON)

    def on_words(self, message: Words, now: float, out: list[Message]) -> None:
        """A custodian asks for data back, a backer has lost its spares or asks about data; and the answers.

        A datum that this leaves with a single copy gets a spare at once, even where data move one hop a step.
        """
        self._hear(message.sender, message.entries)
        self._offers.spread_at_once(dict.fromkeys(entry.id for entry in message.entries), now, out)

    def _hear(self, sender: int, entries: Iterable[WordEntry]) -> None:
        for id, word in entries:
            if self._rests and word in (Word.AGAIN, Word.WANTED):
                self._has_none(id, sender)
            if word == Word.AGAIN:
                self._on_again(id, sender)
            elif word == Word.STILL:
                self._on_still(id, sender)
            elif word == Word.TAKEN:
                if self._repairs.found(id, sender):
                    self._keeper.notes.forget(id)
                self._distant.taken(id, sender, self._now)
            elif word == Word.NONE:
                self._on_none(id, sender)
            elif word == Word.WANTED:
                self._repairs.on_wanted(id, sender)
                if self._overheard.good(id) is not None:
                    self._speech.say(sender, id, Word.HERE)
            elif word == Word.HERE:
                self._repairs.on_here(id, sender)
            elif word == Word.ENCLOSED:
                self._on_enclosed(id, sender)

    def _on_again(self, id: DatumId, custodian: int) -> None:
        """A custodian's copy is corrupt, and it asks this node to take the datum back."""
        taken = self._taken_back(id, custodian)
        self._speech.say(custodian, id, Word.TAKEN if taken else Word.NONE)
        if not taken:
            self._repairs.help(id)

    def _taken_back(self, id: DatumId, asker: int) -> bool:
        """False: there is no good copy here, and this node does not answer for the datum."""
        keeper = self._keeper
        holding = keeper.holdings.get(id)
        if holding is not None and keeper.load(holding) is not None:
            # Even if the spare is for another custodian: that one may have passed the datum on to the asker.
            self.take_back(holding)
            keeper.holdings.vouch(holding, asker)
            return True
        if self._overheard.recover(id) is not None:
            return True
        # Two custodians with corrupt copies may ask each other at the same time. Then only the one with the higher node
        # id answers for the datum, or each would believe that the other has it. That it was passed on to a third node
        # says nothing: the asker may have it from there.
        return self._repairs.take_over(id, asker)

    def _on_still(self, id: DatumId, backer: int) -> None:
        """A backer asks about a datum of which it has a spare."""
        keeper = self._keeper
        holding = keeper.holdings.get(id)
        if holding is not None and holding.state is State.CUSTODY:
            if holding.partner is None:
                self._back(holding, backer)
        elif holding is not None and holding.backer is not None and holding.backer.id == backer:
            return
        elif not self._repairs.is_under_way(id) and (holding is not None or id in self._passed):
            self._speech.passed_on(backer, id)
        else:
            self._speech.say(backer, id, Word.AGAIN)

    def _on_none(self, id: DatumId, sender: int) -> None:
        """A neighbour has no good copy: the backer, or another node that was asked for it."""
        if not self._has_none(id, sender):
            self._repairs.on_none(id, sender)

    def _has_none(self, id: DatumId, sender: int) -> bool:
        """A neighbour has no good copy. Returns whether it was counted on here."""
        holding = self._keeper.holdings.get(id)
        if holding is None or sender != _id(_backer_of(holding)):
            return False
        self._unbacked(holding)
        return True

    def _on_enclosed(self, id: DatumId, backer: int) -> None:
        """A backer knows no node that could have a distant spare."""
        holding = self._keeper.holdings.get(id)
        if holding is None or backer != _id(_backer_of(holding)):
            return
        custody = holding.state is State.CUSTODY
        if self._offers.avoid(backer, self._now) if custody else self._distant.avoid(holding, backer, self._now):
            self._unbacked(holding)
            self._speech.passed_on(backer, id)

    def _counts(self, id: DatumId) -> bool:
        """Whether this node counts on a neighbour's copy, or may do so soon."""
        holding = self._keeper.holdings.get(id)
        if holding is None or holding.state is State.PASSED_ON:
            return False
        return holding.state is State.CUSTODY or holding.backer is not None or self._distant.is_offered(id)

    def _unbacked(self, holding: Holding) -> None:
        """A copy here has no backer any more."""
        if holding.state is State.CUSTODY:
            self._keeper.holdings.unpair(holding)
        else:
            self._keeper.holdings.back(holding, None)
            self._distant.lost(holding, self._now)

    def spread(self, now: float, out: list[Message]) -> None:
        """Send spares of data that rest without a backer, within the bandwidth."""
        self._offers.spread(now, out)

    def spread_far(self, now: float, out: list[Message]) -> None:
        """Send distant spares of data that rest, within the bandwidth that is left."""
        if self._keeper.settings.lasting:
            self._distant.spread(now, out)

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""
        self._speech.flush(out)


def _backer_of(holding: Holding) -> Partner | None:
    """The node that keeps a spare for this copy."""
    return holding.partner if holding.state is State.CUSTODY else holding.backer


def _id(partner: Partner | None) -> int | None:
    return None if partner is None else partner.id
