"""Mirrored custody: spare copies, so that a datum does not die with one drone or one flipped bit.

A datum has one custodian, the node that has to move it on. Beside it one other node, its backer, keeps a spare copy:

- After a hand-over the giver keeps its copy. It is the backer until the receiver, the new custodian, says that it has
  passed the datum on in its turn. Then the spare is let go of, or (`mirror_until: receipt`) kept while there is room.
- A datum that rests and has no backer gets one: its custodian sends a spare copy to its safest neighbour (`spares`).

A custodian that finds its copy corrupt asks its backer to take the datum back into custody. A backer whose custodian is
gone for long, or was wiped, does so by itself. A backer that loses its spare says so.

Nothing here can endanger custody. Spares are not custody: nobody deletes a copy in custody because a spare exists, and
whatever is said about spares may be lost, doubled or late. What such an accident can do is to make a copy too many, or
to leave a datum without its spare. A backer that hears nothing for `ASK_STEPS` asks, so a lost word is made good.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import BEACON_BASE, Corrupt, CorruptEntry, Message, PassedOn, Word
from rass_mav.core.spares.offers import SpareOffers
from rass_mav.core.spares.repairs import Repairs

if TYPE_CHECKING:
    from rass_mav.core.node import Node

#: A backer that has heard nothing of a datum for so many steps (turns, where they are longer) asks its custodian.
ASK_STEPS = 10
#: A custodian or backer is given up after so many lifetimes of a neighbour without a beacon. The routing table forgets
#: it after one; but a copy is made anew for each one given up, so it should be dead, and not just have missed three
#: beacons or flown a bit away. In a moving swarm most come back, or pass their data on, in the meantime.
GONE_LIFETIMES = 8.0
#: How many data a node asks for in a step, apart from those that it has just found corrupt: three frames.
WORDS_A_STEP = 33
#: Spares a node keeps at most, if its capacity allows more.
MAX_SPARES = 4096
#: How many data that were passed on a node remembers, to answer backers that ask.
MAX_PASSED = 256


class Partner:
    """Another node that this one keeps spares for, or that keeps spares for this one."""

    __slots__ = ("backed", "epoch", "heard", "lifetime_s", "spares")

    def __init__(self, epoch: int | None, heard: float, lifetime_s: float) -> None:
        self.epoch = epoch
        """Epoch of its store, from its beacon; None: not known yet."""
        self.heard = heard
        """When it was last known to be there, seconds."""
        self.lifetime_s = lifetime_s
        """A neighbour like this is gone when it is silent for longer: it grows with the turn that its beacons tell."""
        self.spares: dict[DatumId, None] = {}
        """Data in its custody that this node has a spare of."""
        self.backed: dict[DatumId, None] = {}
        """Data in own custody that it has a spare of."""


class Mirrors:
    """A node's share of mirrored custody: its active spares, the backers of what is in its custody."""

    __slots__ = (
        "_again_at",
        "_asked",
        "_node",
        "_now",
        "_passed",
        "_passed_on",
        "_words",
        "backer",
        "custodian",
        "offers",
        "partners",
        "repairs",
    )

    def __init__(self, node: Node, now: float) -> None:
        self._node = node
        self._now = now
        """The present step's time, seconds."""
        self.custodian: dict[DatumId, int] = {}
        """Who has custody of each active spare: the keys are the active spares."""
        self.backer: dict[DatumId, int] = {}
        """Who keeps a spare of a datum in own custody. Bounded by custody."""
        self.partners: dict[int, Partner] = {}
        """By node id. Each has at least one datum of the two maps above."""
        self.repairs = Repairs(node, self)
        """Data found corrupt that somebody was asked to take back."""
        self.offers = SpareOffers(node)
        """What is in custody without a backer."""
        self._again_at = now
        """When those that have not answered are asked again, seconds."""
        self._asked: OrderedDict[DatumId, float] = OrderedDict()
        """When each active spare was last told of or asked for, the longest ago first."""
        self._passed: OrderedDict[DatumId, int] = OrderedDict()
        """Data passed on of late, and to whom."""
        self._passed_on: dict[int, dict[DatumId, None]] = {}
        self._words: dict[int, dict[DatumId, Word]] = {}
        for id in node.inventory:
            self.offers.need(id)

    def disagreement(self) -> str:
        """What these maps and the inventory say differently, for checks; empty: nothing, and all bounds hold."""
        inventory = self._node.inventory
        inline = self._node.settings.inline_bytes
        spares = [id for id in inventory.everything() if inventory.is_active(id)]
        if not set(spares) == self.custodian.keys() == self._asked.keys():
            return "the active spares are not those that have a custodian"
        bare = {id for id in inventory if id not in self.backer and inventory.info(id).size <= inline}
        if not self.backer.keys() <= set(inventory) or bare != self.offers.bare.keys():
            return "not every small datum in custody has a backer or waits for one"
        relations = {(id, p, "spare") for p, partner in self.partners.items() for id in partner.spares}
        relations |= {(id, p, "backed") for p, partner in self.partners.items() for id in partner.backed}
        expected = {(id, p, "spare") for id, p in self.custodian.items()}
        if relations != expected | {(id, p, "backed") for id, p in self.backer.items()}:
            return "the partners are not those of the data"
        if wrong := self.offers.disagreement():
            return wrong
        if inventory.spares > MAX_SPARES or len(self._passed) > MAX_PASSED:
            return "a table is too long"
        return ""

    # -- what happens to own custody -----------------------------------------------------------------------------------

    def took(self, id: DatumId, giver: int | None = None) -> None:
        """A datum is in custody now. `giver`: who handed it over, and keeps its copy as a spare."""
        self.repairs.end(id)
        self._passed.pop(id, None)
        if giver is not None:
            self.backed_by(id, giver)
            self.offers.came(id)
        elif id not in self.backer:
            self.offers.need(id)

    def gave(self, id: DatumId, to: int) -> None:
        """A neighbour has taken custody: the copy here becomes its spare, unless it is a base."""
        node = self._node
        neighbour = node.routing.neighbours.get(to)
        if (neighbour is not None and neighbour.beacon.flags & BEACON_BASE) or node.inventory.spares >= MAX_SPARES:
            node.drop(id, Fate.PASSED_ON)
        else:
            node.custody.cancel(id)
            node.transfers.cancel(id)
            self.left(id, to)
            node.inventory.demote(id)
            self._entrust(id, to)
        self._passed[id] = to
        if len(self._passed) > MAX_PASSED:
            self._passed.popitem(last=False)

    def left(self, id: DatumId, to: int | None = None) -> None:
        """A datum leaves custody. Its backer is told that it need not be counted on, unless it is `to` itself."""
        self.offers.settle(id)
        backer = self._unback(id)
        if backer is not None and backer != to:
            self._passed_on.setdefault(backer, {})[id] = None

    def repair(self, id: DatumId) -> bool:
        """The copy in custody is corrupt. Whether others are asked for the datum; if not, it is lost here."""
        self.offers.settle(id)
        return self.repairs.begin(id, self._unback(id))

    def backed_by(self, id: DatumId, backer: int) -> None:
        """Another node keeps a spare of a datum in own custody; who did so before is told."""
        old = self.backer.get(id)
        if old == backer:
            return
        self.left(id, backer)
        self.backer[id] = backer
        self._partner(backer).backed[id] = None

    def _unback(self, id: DatumId) -> int | None:
        backer = self.backer.pop(id, None)
        if backer is not None:
            del self.partners[backer].backed[id]
            self._forget_idle(backer)
        return backer

    # -- what happens to spares ----------------------------------------------------------------------------------------

    def keep(self, giver: int, datum: Datum) -> bool:
        """A custodian sends a spare copy. Whether there is a good copy here now."""
        node = self._node
        inventory = node.inventory
        id = datum.id
        if id in node.archive:
            return True
        if inventory.holds(id):
            held = node.load(id)
            if held is not None:
                if held.crc != datum.crc:
                    return False
                if id not in inventory:
                    if self._release(id) is None:
                        inventory.activate(id)
                    self._entrust(id, giver)
                return True
        size = len(datum.payload)
        if not node.store.accepting or inventory.spares >= MAX_SPARES or not self._make_way(size, active=False):
            return False
        inventory.add_spare(datum.arrived())
        self.repairs.end(id)
        self._passed.pop(id, None)
        if node.notes is not None:
            node.notes.forget(id)
        self._entrust(id, giver)
        node.observer.gained(datum)
        return True

    def make_way(self, size: int) -> None:
        """Let go of spares until a datum of `size` bytes of payload fits beside the rest."""
        self._make_way(size, active=True)

    def _make_way(self, size: int, *, active: bool) -> bool:
        inventory = self._node.inventory
        while inventory.crowded(size):
            id = inventory.yielding(active=active)
            if id is None:
                return False
            self.drop(id, Fate.OVERFLOW)
        return True

    def drop(self, id: DatumId, fate: Fate) -> None:
        """Let go of a spare. Who counts on it is told, unless the datum itself has come to its end."""
        node = self._node
        custodian = self._release(id)
        if custodian is not None and fate in (Fate.CORRUPTED, Fate.OVERFLOW):
            self.say(custodian, id, Word.NONE)
        # No loss to be noted here: custody lies elsewhere.
        node.inventory.remove(id, Fate.PASSED_ON)
        node.observer.dropped(id, fate)

    def take_back(self, id: DatumId) -> None:
        """A spare comes into custody (again)."""
        node = self._node
        self._release(id)
        node.inventory.promote(id)
        node.stirred = True
        if node.notes is not None:
            node.notes.forget(id)
        self.took(id)

    def rescue(self, id: DatumId) -> None:
        """Somebody holds a datum for lost of which a good copy is here."""
        if id not in self._node.inventory:
            self.take_back(id)

    def _entrust(self, id: DatumId, custodian: int) -> None:
        self.custodian[id] = custodian
        self._partner(custodian).spares[id] = None
        self._asked[id] = self._now

    def _release(self, id: DatumId) -> int | None:
        """A spare is not active any more. Returns whose it was; None: it was not active."""
        custodian = self.custodian.pop(id, None)
        if custodian is not None:
            del self._asked[id]
            del self.partners[custodian].spares[id]
            self._forget_idle(custodian)
        return custodian

    # -- partners ------------------------------------------------------------------------------------------------------

    def _partner(self, id: int) -> Partner:
        partner = self.partners.get(id)
        if partner is None:
            neighbour = self._node.routing.neighbours.get(id)
            if neighbour is None:
                partner = Partner(None, self._now, self._node.routing.longest_s)
            else:
                partner = Partner(neighbour.beacon.epoch, self._now, neighbour.lifetime_s)
            self.partners[id] = partner
        return partner

    def _forget_idle(self, id: int) -> None:
        partner = self.partners[id]
        if not partner.spares and not partner.backed:
            del self.partners[id]

    def step(self, now: float) -> None:
        """Once a step: partners that are gone, spares of which nothing was heard for long, repairs not answered."""
        node = self._node
        settings = node.settings
        self._now = now
        if self.partners:
            self._look_after_partners(now)
        asked = self._asked
        turn_s = node.routing.longest_turn_s
        due = now - (ASK_STEPS - 0.5) * turn_s
        for id, at in list(islice(asked.items(), WORDS_A_STEP)):
            if at > due:
                break
            asked[id] = now
            asked.move_to_end(id)
            self.say(self.custodian[id], id, Word.STILL)
        if now >= self._again_at:
            self._again_at = now + turn_s - 0.5 * settings.step_s
            self.repairs.step(WORDS_A_STEP)
        self.offers.step(now)

    def _look_after_partners(self, now: float) -> None:
        node = self._node
        neighbours = node.routing.neighbours
        # Who speaks seldom is told to wait, and waits too: its own words to a partner take as long.
        own = node.routing.lifetime_s * (node.routing.turn_s / node.routing.step_s)
        for id, partner in list(self.partners.items()):
            neighbour = neighbours.get(id)
            if neighbour is not None:
                partner.heard = neighbour.heard
                partner.lifetime_s = neighbour.lifetime_s
                epoch = neighbour.beacon.epoch
                if partner.epoch is None:
                    partner.epoch = epoch
                if partner.epoch == epoch:
                    continue
            elif partner.heard >= now - GONE_LIFETIMES * max(partner.lifetime_s, own):
                continue
            # Gone, or its store was wiped: it has nothing of ours any more, or nothing that can be counted on.
            for datum in list(partner.spares):
                if node.load(datum) is not None:
                    self.take_back(datum)
            for datum in list(partner.backed):
                self._unback(datum)
                self.offers.need(datum)

    # -- what is said --------------------------------------------------------------------------------------------------

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was taken before that it has been passed on since."""
        self._passed_on.setdefault(asker, {})[id] = None

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on: their spares here are not counted on any more."""
        node = self._node
        for id in message.ids:
            if self.custodian.get(id) != message.sender:
                continue
            self._release(id)
            if node.settings.mirror_until_receipt:
                node.inventory.pass_by(id)
            else:
                node.inventory.remove(id, Fate.PASSED_ON)
                node.observer.dropped(id, Fate.PASSED_ON)

    def on_corrupt(self, message: Corrupt, now: float, out: list[Message]) -> None:
        """A custodian asks for data back, a backer has lost its spares or asks after data; and the answers.

        What is left with a single copy by this gets a spare at once, also where data move one hop a step.
        """
        sender = message.sender
        ids = [entry.id for entry in message.entries]
        self._hear_words(sender, message.entries)
        self.offers.spread(now, out, [id for id in ids if id in self.offers.bare])

    def _hear_words(self, sender: int, entries: Iterable[CorruptEntry]) -> None:
        for id, word in entries:
            if word == Word.AGAIN:
                taken = self._taken_back(id, sender)
                self.say(sender, id, Word.TAKEN if taken else Word.NONE)
                if not taken:
                    self.repairs.help(id)
            elif word == Word.STILL:
                self._answer_still(id, sender)
            elif word == Word.TAKEN:
                if self.repairs.end(id) and self._node.notes is not None:
                    self._node.notes.forget(id)
            elif word == Word.NONE:
                if self.backer.get(id) == sender:
                    self._unback(id)
                    self.offers.need(id)
                else:
                    self.repairs.on_none(id, sender)
            elif word == Word.WANTED:
                self.repairs.on_wanted(id, sender)
            elif word == Word.HERE:
                self.repairs.on_here(id, sender)

    def _taken_back(self, id: DatumId, asker: int) -> bool:
        """A custodian's copy is corrupt: take the datum back. False: there is no good copy here, and none was given."""
        node = self._node
        if node.inventory.holds(id) and node.load(id) is not None:
            # Also if the spare is another custodian's: that one may have passed the datum on to the asker.
            if id not in node.inventory:
                self.take_back(id)
            return True
        # Whoever it was given to has it, but for the asker, which has just lost it.
        return self.repairs.is_under_way(id) or id in node.archive or self._passed.get(id, asker) != asker

    def _answer_still(self, id: DatumId, backer: int) -> None:
        """A backer asks after a datum of which it has a spare."""
        node = self._node
        if id in node.inventory:
            if id not in self.backer:
                self.backed_by(id, backer)
        elif not self.repairs.is_under_way(id) and (
            node.inventory.holds(id) or id in self._passed or id in node.archive
        ):
            self._passed_on.setdefault(backer, {})[id] = None
        else:
            self.say(backer, id, Word.AGAIN)

    def say(self, target: int, id: DatumId, word: Word) -> None:
        """Say it with the next `flush`; to BROADCAST: to all neighbours."""
        self._words.setdefault(target, {})[id] = word

    def flush(self, out: list[Message]) -> None:
        """What is to be said since the last time."""
        node_id = self._node.id
        if self._passed_on:
            out += [PassedOn(node_id, target, tuple(ids)) for target, ids in self._passed_on.items()]
            self._passed_on = {}
        if self._words:
            for target, words in self._words.items():
                out.append(Corrupt(node_id, target, tuple([CorruptEntry(*entry) for entry in words.items()])))
            self._words = {}
