"""What a node holds and answers for: taking data in, verifying them, letting go of them."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.custody.handovers import HandoverNumbers
from rass_mav.core.custody.holdings import Holding, Holdings, State
from rass_mav.core.custody.nospares import NoSpares
from rass_mav.core.datum import WOUNDS, Datum, DatumId, Fate
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.notes import NoLossNotes, Note, fate_of
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.observer import Observer
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store

#: What is dropped for one of these reasons is gone, as far as this node knows.
_BEYOND_REPAIR = (Fate.CORRUPTED, Fate.EXPIRED, Fate.OVERFLOW)
#: Ages of one datum may differ by so much among honest nodes, seconds.
_AGES_DIFFER_S = 1.0


class Keeper:
    """The keeping half of a drone."""

    __slots__ = (
        "alarms", "arrived", "corrupt_received", "holdings", "notes", "numbers", "observer", "receipts", "refused",
        "settings", "spares", "stirred", "store",
    )  # fmt: skip

    def __init__(
        self, settings: NodeSettings, store: Store, numbers: HandoverNumbers, receipts: NoReceipts, notes: NoLossNotes,
        observer: Observer, alarms: Alarms,
    ) -> None:  # fmt: skip
        """`receipts`: what bases say has arrived. `notes`: word of lost data, on its way to a base."""
        self.alarms = alarms
        self.settings = settings
        self.store = store
        self.numbers = numbers
        self.receipts = receipts
        self.notes = notes
        self.observer = observer
        self.spares = NoSpares()
        """Spare copies; whoever keeps them for this node sets itself here."""
        self.arrived: Container[DatumId] = receipts
        """What has reached a base, as far as this node has heard. It ends spare copies, and nothing else."""
        self.holdings = self._take_up()
        self.refused = 0
        """Hand-overs refused for want of room."""
        self.corrupt_received = 0
        """Data that came in with a checksum that does not fit."""
        self.stirred = False
        """Whether something came into custody that `Node.forward` has not looked at."""

    def _take_up(self) -> Holdings:
        return Holdings(self.store, self.settings)

    # -- taking in -----------------------------------------------------------------------------------------------------

    def take_custody(self, giver: int, number: int, datum: Datum) -> bool:
        """Accept a datum that arrived whole and intact. False: no room, the giver keeps it."""
        id = datum.id
        if self.is_squatted(id):
            self.refused += 1
            return False
        if self.has_custody(giver, number, id, datum.crc):
            self.rejuvenate(id, datum.created, at_least=datum.at_least)
            return True
        size = len(datum.payload)
        if id in self.holdings or not (self.may_accept(size) or self.make_room(size, own=False)):
            self.refused += 1
            if number == 0:
                self.observer.declined(id)
            return False
        self.keep(datum.arrived(), giver)
        if number:
            self.numbers.accept(giver, number, id, datum.crc)
        return True

    def keep_spare(self, giver: int, number: int, datum: Datum) -> bool:
        """Keep a spare copy for a neighbour that has custody. False: it cannot be kept, or not relied on."""
        kept = not self.is_squatted(datum.id) and self.spares.keep(giver, datum)
        self.refused += not kept
        return kept

    def is_squatted(self, id: DatumId) -> bool:
        """Whether somebody made up a datum under a number that this node has yet to give; then it rings."""
        origin, epoch, sequence = id
        if origin != self.settings.node_id or epoch != self.store.epoch or sequence < self.store.given:
            return False
        self.alarms.ring(Alarm.SQUATTED, str(id))
        return True

    def has_custody(self, giver: int, number: int, id: DatumId, crc: int) -> bool:
        """Whether a datum on offer needs no taking: it is here, or this offer was taken. A receipt does not count: with
        what it says that has arrived, the giver goes to the base.

        False while something is held under `id`: that is another datum, so the offer is refused.
        """
        holding = self.holdings.get(id)
        accepted = number != 0 and self.numbers.has_accepted(giver, number, id, crc)
        if holding is not None:
            # The giver will delete its copy on our word, so ours must be good at this moment; a bad one is dropped.
            if self.load(holding) is None or holding.crc != crc:
                return False
            if not accepted:
                self._comes_round(holding, giver, number)
                return True
        elif not accepted:
            return False
        if holding is None or holding.state is not State.CUSTODY:
            self.spares.not_here(id, giver)
        return True

    def _comes_round(self, holding: Holding, giver: int, number: int) -> None:
        """A datum is offered that is here already: this copy is what the giver may rely on from now on."""
        # Whatever we offered of it, nobody's answer may delete it any more.
        self.holdings.cancel(holding)
        if number:
            self.numbers.accept(giver, number, holding.id, holding.crc)
        self.spares.take_back(holding)
        self.spares.took(holding, giver)

    def rejuvenate(self, id: DatumId, created: float, *, at_least: bool) -> None:
        """Custody of a datum was taken that is here already. No checksum covers its age, and the giver lets go of its
        copy: what somebody made out to be older must not expire here sooner than it would have there."""
        holding = self.holdings.get(id)
        if self.settings.lifetime_s is None or holding is None or created <= holding.created + _AGES_DIFFER_S:
            return
        datum = self.store.get(id)
        if datum is not None:
            self.store.put(datum._replace(created=created, at_least=at_least))
            holding.created = created

    def room_for(self, size: int, *, own: bool) -> bool:
        """Whether another datum of `size` bytes of payload can be stored, if need be in place of spares.

        `own`: a measurement of this node."""
        holdings = self.holdings
        return holdings.room_for(size, own=own) and self.store.room_for(size - holdings.spare_bytes)

    def may_accept(self, size: int) -> bool:
        """Whether custody of a datum of `size` bytes of payload can be taken over."""
        return self.store.accepting and self.room_for(size, own=False)

    def make_room(self, size: int, *, own: bool) -> bool:
        """With `drop_oldest`: let go of the least recently used data until `size` bytes of payload fit."""
        if not self.settings.drop_oldest or not self.store.accepting:
            return False
        custody = self.holdings.custody
        while not self.room_for(size, own=own):
            if not custody:
                return False
            self.drop(next(iter(custody.values())), Fate.OVERFLOW)
        return True

    def keep(self, datum: Datum, giver: int | None = None) -> None:
        """Store a datum in own custody. `giver`: who handed it over; None: it was made here."""
        self.spares.make_way(len(datum.payload))
        holding = self.holdings.add(datum)
        self.notes.forget(datum.id)
        self.stirred = True
        self.spares.took(holding, giver)
        self.observer.gained(datum)

    # -- letting go ----------------------------------------------------------------------------------------------------

    def give_away(self, holding: Holding, to: int) -> None:
        """A neighbour has taken custody of a datum."""
        if not self.spares.gave(holding, to):
            self.drop(holding, Fate.PASSED_ON)

    def drop(self, holding: Holding, fate: Fate) -> None:
        """Let go of a datum in custody, or of a spare."""
        id, noted = holding.id, fate
        if holding.state is not State.CUSTODY:
            self.spares.let_go(holding, missing=fate in (Fate.CORRUPTED, Fate.OVERFLOW))
            # No loss to be noted here: custody lies elsewhere.
            noted = Fate.PASSED_ON
        else:
            if fate in (Fate.CORRUPTED, Fate.EXPIRED):
                self.numbers.forget(id)
                if fate is Fate.CORRUPTED and self.spares.repair(holding):
                    # Another node has been asked to take the datum back: only the copy is lost.
                    noted = Fate.PASSED_ON
                    self.notes.suspect(id, fate)
                else:
                    self.store.count(fate.value)
            self.spares.left(holding)
        self.holdings.remove(holding, noted)
        self.observer.dropped(id, fate)
        if noted in _BEYOND_REPAIR:
            self.notes.make(id, noted)

    def beyond_repair(self, id: DatumId, fate: Fate) -> None:
        """A datum whose copy here is gone already cannot be had from its backer either: it is lost."""
        self.store.count(fate.value)
        self.notes.give_up(id, fate)

    # -- receipts and loss notes ---------------------------------------------------------------------------------------

    def heed(self, changed: set[Pair]) -> None:
        """Receipts told something new of these (origin, epoch) pairs: it is the end of spares, but not of custody."""
        receipts, holdings = self.receipts, self.holdings
        for spares in (holdings.spare, holdings.passed_on):
            for id in [id for id in spares if id[:2] in changed]:
                if id in receipts:
                    self.drop(spares[id], Fate.DELIVERED)
                elif receipts.told_lost(id):
                    # Whoever had custody thought it the last copy.
                    self.spares.rescue(spares[id])

    @property
    def takes_notes(self) -> bool:
        """Whether loss notes are taken; if not they are not answered, so they are not lost."""
        return self.notes.told

    def take_note(self, id: DatumId, note: Note) -> bool:
        """A neighbour hands on the note that a datum is lost. False: there is no room for it."""
        if self.is_squatted(id):
            # A note of what was never made goes no further: if it were refused, it would be offered for ever.
            return True
        holding = None if fate_of(note.reason) in WOUNDS else self.holdings.get(id)
        if holding is not None and self.load(holding) is not None:
            # It is not: a good copy is here.
            self.spares.take_back(holding)
            return True
        return self.notes.take(id, note)

    # -- care of what is held ------------------------------------------------------------------------------------------

    def load(self, holding: Holding) -> Datum | None:
        """A datum in custody, or a spare, as it may be sent. None: its bytes are corrupt, and it has been dropped."""
        datum = self.store.get(holding.id)
        if datum is not None and datum.intact:
            return datum
        self.drop(holding, Fate.CORRUPTED)
        return None

    def scrub(self) -> None:
        """Verify checksums of what is held, spares too, `scrub_items` of them, going round."""
        for holding in self.holdings.damaged(self.settings.scrub_items):
            self.drop(holding, Fate.CORRUPTED)

    def expire(self, before: float) -> None:
        """Let go of what was created before a moment, seconds."""
        for holding in self.holdings.older(before):
            self.drop(holding, Fate.EXPIRED)


class Sink(Keeper):
    """The keeping half of a base: what comes here has arrived for good."""

    __slots__ = ("_alarms", "archive")

    def __init__(
        self, settings: NodeSettings, store: Store, numbers: HandoverNumbers, receipts: NoReceipts, archive: Archive,
        observer: Observer, alarms: Alarms,
    ) -> None:  # fmt: skip
        super().__init__(settings, store, numbers, receipts, NoLossNotes(store), observer, alarms)
        self.archive = archive
        """What has become of all data."""
        self.arrived = archive
        self._alarms = alarms

    def _take_up(self) -> Holdings:
        # What has arrived is the archive's.
        return Holdings(self.store, replace(self.settings, capacity_items=None, capacity_bytes=None), load=False)

    def room_for(self, size: int, *, own: bool) -> bool:
        """Whether the store takes another datum of `size` bytes of payload."""
        return self.store.room_for(size)

    def make_room(self, size: int, *, own: bool) -> bool:
        """Nothing that has arrived makes room."""
        return False

    def has_custody(self, giver: int, number: int, id: DatumId, crc: int) -> bool:
        """Whether this very datum has arrived. The giver may delete the last copy on this, so the store is asked."""
        stored = self.store.get(id)
        return stored is not None and stored.crc == crc and stored.intact

    def take_custody(self, giver: int, number: int, datum: Datum) -> bool:
        """A datum arrives. False: no room, the giver keeps it. Of two contents under one id both are kept."""
        stored = self.store.get(datum.id)
        if stored is None or not stored.intact:
            return super().take_custody(giver, number, datum)
        if stored.crc == datum.crc:
            return True
        if not (self.may_accept(len(datum.payload)) and self.store.keep_apart(datum)):
            self.refused += 1
            return False
        self._alarms.ring(Alarm.TWO_CONTENTS, str(datum.id))
        self.observer.kept_apart(datum)
        return True

    def keep(self, datum: Datum, giver: int | None = None) -> None:
        """A datum has arrived."""
        self.store.put(datum)
        if self.archive.is_lost(datum.id):
            self.store.found(datum.id)
        if self.archive.add(datum.id):
            self.receipts.arrived(datum.id)
        self.observer.delivered(datum)

    def keep_spare(self, giver: int, number: int, datum: Datum) -> bool:
        """A spare copy has arrived like any other."""
        return self.take_custody(giver, number, datum)

    def heed(self, changed: set[Pair]) -> None:
        """Nothing is held here that receipts are about."""

    @property
    def takes_notes(self) -> bool:
        """Whether bases speak of arrivals and losses at all."""
        return self.receipts.told

    def take_note(self, id: DatumId, note: Note) -> bool:
        """A neighbour says that a datum is lost, or a store damaged. False: there is no room for the note."""
        archive, fate = self.archive, fate_of(note.reason)
        if self.is_squatted(id) or (id in archive.wounds if fate in WOUNDS else archive.is_lost(id) or self.has(id)):
            return True
        if not archive.lose(id, fate):
            return False
        self.store.lose(id, fate)
        if fate in WOUNDS:
            self._alarms.ring(Alarm.UNKNOWN if fate is Fate.UNKNOWN else Alarm.DAMAGED, str(id))
        else:
            self.receipts.lost(id)
        return True

    def has(self, id: DatumId) -> bool:
        """Whether a good copy has arrived: not what the index in memory says, but what the store has."""
        stored = self.store.get(id)
        return stored is not None and stored.intact
