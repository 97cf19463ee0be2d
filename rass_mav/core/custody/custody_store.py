"""What a node holds and is responsible for: accepting data, verifying them, releasing them."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from math import inf

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.custody.effects import Hand
from rass_mav.core.custody.handovers import HandoverNumbers
from rass_mav.core.custody.holdings import Holding, Holdings, ReplicaOffer, State
from rass_mav.core.custody.journal import Journal
from rass_mav.core.datum import BEYOND_REPAIR, RECORDED, STORE_FAULTS, Datum, DatumId, Fate
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import CopyStatuses, Distance, Handover, Message, PassedOn
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.deletion_reports import NoDeletionReports, Note, fate_of
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.observer import Observer
from rass_mav.core.seals import NoSeals
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store

#: Reports of one drone about others' data that a base keeps until it knows that these were created.
MAX_CLAIMS = 64
#: Among honest nodes the ages of one datum differ by at most this, seconds.
_AGES_DIFFER_S = 1.0


class NoReplicaMessages:
    """There is nothing to say about replicas."""

    __slots__ = ()

    def flush(self, out: list[Message]) -> None:
        """Append the messages collected since the last call."""


class NoReplicas:
    """No replicas are kept, here or for this node."""

    __slots__ = ("messages", "overheard")

    def __init__(self) -> None:
        self.messages = NoReplicaMessages()
        """Those about replicas that wait to be sent."""
        self.overheard: dict[DatumId, Datum] = {}
        """Data that others handed over to each other, and that are kept here in memory; the oldest first."""

    # -- changes of custody --------------------------------------------------------------------------------------------

    def make_way(self, size: int) -> None:
        """A datum of `size` bytes of payload comes into custody: drop replicas until it fits beside the rest."""

    def took(self, holding: Holding, custodian: int | None = None) -> None:
        """A datum is now in custody. `custodian`: the node that handed it over, and keeps its copy as a replica."""

    def take_back(self, holding: Holding) -> None:
        """If this is a replica, take custody of it: a node offers it, or believes that it is lost."""

    def rescue(self, holding: Holding) -> None:
        """A datum was reported lost to a base, but a copy is here."""

    def gave(self, holding: Holding, to: int) -> bool:
        """A neighbour has taken custody. Returns whether the copy here stays, as its replica."""
        return False

    def not_here(self, id: DatumId, asker: int) -> None:
        """Tell a node that hands over a datum which was accepted before that the datum has been passed on since."""

    def left(self, holding: Holding) -> None:
        """A datum is about to leave custody: its holder is told that nobody counts on its replica any more."""

    def repair(self, holding: Holding) -> bool:
        """The copy in custody is corrupt. Returns whether others are asked for the datum; if not, it is lost here."""
        return False

    def let_go(self, holding: Holding, *, missing: bool, confirmed: bool) -> None:
        """A replica is about to go. `missing`: tell the custodian that counts on it. `confirmed`: because its datum has
        arrived, by what bases report."""

    # -- overheard data ------------------------------------------------------------------------------------------------

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
        """A neighbour sends data to another node."""

    def recover(self, id: DatumId) -> Holding | None:
        """A datum was reported lost that is not held here: take custody of it, if it was overheard."""
        return None

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs."""

    # -- messages ------------------------------------------------------------------------------------------------------

    def keep(self, custodian: int, datum: Datum, distance: Distance | None) -> bool:
        """A custodian sends a replica, or another node a distant one. Returns whether it can rely on this node."""
        return False

    def taken(self, offer: ReplicaOffer, crc: int, now: float) -> None:
        """A neighbour keeps a replica that it was offered, of a datum with this checksum."""

    def refused(self, offers: list[ReplicaOffer], now: float) -> Iterator[Hand]:
        """A neighbour keeps none of the replicas that it was offered."""
        return iter(())

    def on_passed_on(self, message: PassedOn) -> None:
        """A custodian has passed data on."""

    def on_copy_statuses(self, message: CopyStatuses, now: float) -> Iterator[Hand]:
        """A custodian or a holder reports something about data."""
        return iter(())

    def step(self, now: float) -> None:
        """Once a step."""

    def detours(self) -> list[tuple[Holding, int]]:
        """Data that came back into custody for lack of a receipt since the last call, and the neighbours they go to
        now."""
        return []

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {}

    def spread(self, now: float) -> Iterator[Hand]:
        """Replicas of data that rest without a holder, within the bandwidth."""
        return iter(())

    def spread_far(self, now: float) -> Iterator[Hand]:
        """Once a turn: distant replicas, within the bandwidth that is left."""
        return iter(())


class CustodyStore:
    """The storing half of a drone."""

    __slots__ = (
        "alarms",
        "arrived",
        "corrupt_received",
        "dirty",
        "exchange",
        "holdings",
        "journal",
        "notes",
        "numbers",
        "observer",
        "receipts",
        "refused",
        "replicas",
        "settings",
        "store",
    )  # fmt: skip

    def __init__(
        self, settings: NodeSettings, own_share: float, store: Store, exchange: Exchange, numbers: HandoverNumbers,
        receipts: NoReceipts, notes: NoDeletionReports, observer: Observer, alarms: Alarms,
    ) -> None:  # fmt: skip
        """`exchange`: the questions of this node. `receipts`: what bases report as arrived. `notes`: deletion reports
        that wait to be handed over."""
        self.alarms = alarms
        self.settings = settings
        self.store = store
        self.exchange = exchange
        self.numbers = numbers
        self.receipts = receipts
        self.notes = notes
        self.observer = observer
        self.replicas = NoReplicas()
        """Replicas; the object that keeps them for this node sets itself here."""
        judges = notes.active and settings.acknowledged and settings.has("delivery-scores")
        self.journal = Journal(receipts.arrives, judges=judges)
        """Who took data from here, and whether they were delivered."""
        self.arrived: Container[DatumId] = receipts
        """What has reached a base, as far as this node has heard. It ends replicas, and nothing else."""
        self.holdings = self._take_up(own_share)
        self.refused = 0
        """Hand-overs refused for lack of space."""
        self.corrupt_received = 0
        """Data that came in with a checksum that does not match."""
        self.dirty = False
        """Whether a datum came into custody that `Node.forward` has not looked at."""

    def _take_up(self, own_share: float) -> Holdings:
        return Holdings(self.store, self.settings, self.settings.capacity(own_share), self.exchange)

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
        if number:
            self.numbers.accept(custodian, number, id, self.numbers.content_hashes.of(datum))
        return True

    def keep_replica(self, custodian: int, number: int, datum: Datum, distance: Distance | None = None) -> bool:
        """Keep a replica for a neighbour that has custody, or a distant one. False: it cannot be kept, or not relied
        on."""
        is_kept = not self.has_id_conflict(datum.id) and self.replicas.keep(custodian, datum, distance)
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
        it is known: anybody can find a second one for a CRC.
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
        if holding is None or holding.state is not State.CUSTODY:
            self.replicas.not_here(id, custodian)
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
        if number:
            self.numbers.accept(custodian, number, holding.id, self.numbers.content_hashes.of(datum))
        self.replicas.take_back(holding)
        self.replicas.took(holding, custodian)

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

        Where receipts are off, as in the paper, whoever comes first is served.
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
        self.replicas.make_way(len(datum.payload))
        self.journal.came_back(datum.id)
        holding = self.holdings.add(datum, custodian=custodian)
        self.notes.forget(datum.id)
        self.dirty = True
        self.replicas.took(holding, custodian)
        self.observer.gained(datum)

    # -- releasing data ------------------------------------------------------------------------------------------------

    def give_away(self, holding: Holding, to: int) -> None:
        """A neighbour has taken custody of a datum."""
        if holding.id not in self.arrived:
            # Otherwise no base will confirm it once more, whatever the neighbour does.
            self.journal.gave(holding.id, holding.received_from, to)
        if not self.replicas.gave(holding, to):
            self.drop(holding, Fate.PASSED_ON)

    def is_proof(self, holding: Holding) -> bool:
        """Whether the arrival of a datum in custody would show that the neighbour that takes it delivers: no base is
        known to have it, and it is no junk, as far as is known."""
        is_open = holding.received_from is None or self.receipts.arrives(holding.id[:2])
        return is_open and holding.id not in self.arrived

    def drop(self, holding: Holding, fate: Fate) -> None:
        """Drop a datum in custody, or a replica."""
        id, noted = holding.id, fate
        if holding.state is not State.CUSTODY:
            missing = fate in (Fate.CORRUPTED, Fate.OVERFLOW)
            self.replicas.let_go(holding, missing=missing, confirmed=fate is Fate.DELIVERED)
            # Not a loss that is recorded here: another node has custody.
            noted = Fate.PASSED_ON
        else:
            if fate in RECORDED:
                self.numbers.forget(id)
                if fate is Fate.CORRUPTED and self.replicas.repair(holding):
                    # Another node has been asked to take the datum back: only the copy is lost.
                    noted = Fate.PASSED_ON
                    self.notes.suspect(id, fate)
                else:
                    self.store.count(fate.value)
            self.replicas.left(holding)
        self.holdings.remove(holding, noted)
        self.observer.dropped(id, fate)
        if noted in BEYOND_REPAIR:
            self.notes.make(id, noted)

    def beyond_repair(self, id: DatumId, fate: Fate) -> None:
        """A datum whose copy here is already gone is not to be had from its holder either: it is lost."""
        self.store.count(fate.value)
        self.notes.give_up(id, fate)

    # -- receipts and deletion reports ---------------------------------------------------------------------------------

    def apply(self, changed: set[Pair]) -> None:
        """Receipts brought news about these (origin, epoch) pairs: it ends replicas, but not custody."""
        receipts, holdings = self.receipts, self.holdings
        self.journal.apply(changed, receipts)
        for replicas in (holdings.replica, holdings.passed_on):
            for id in [id for id in replicas if id[:2] in changed]:
                if id in receipts:
                    self.drop(replicas[id], Fate.DELIVERED)
                elif receipts.is_reported_lost(id):
                    # The node that had custody believed it was the last copy.
                    self.replicas.rescue(replicas[id])
        self.replicas.apply(changed)

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
        if fate_of(note.reason) not in STORE_FAULTS and self._has_good_copy(id):
            return True
        return self.notes.take(id, note)

    def _has_good_copy(self, id: DatumId) -> bool:
        """Whether a datum that was reported lost is here. Then it is in custody now."""
        holding = self.holdings.get(id)
        if holding is None or self.load(holding) is None:
            return self.replicas.recover(id) is not None
        self.replicas.take_back(holding)
        return True

    # -- checking data -------------------------------------------------------------------------------------------------

    def load(self, holding: Holding) -> Datum | None:
        """A datum in custody, or a replica, ready to send. None: its bytes are corrupt, and it has been dropped."""
        datum = self.store.get(holding.id)
        if datum is not None and datum.intact:
            return datum
        self.drop(holding, Fate.CORRUPTED)
        return None

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


class BaseStore(CustodyStore):
    """The storing half of a base: data that reach it have arrived for good."""

    __slots__ = ("_alarms", "_claims", "_seals", "archive")

    def __init__(
        self, settings: NodeSettings, own_share: float, store: Store, exchange: Exchange, numbers: HandoverNumbers,
        receipts: NoReceipts, archive: Archive, observer: Observer, alarms: Alarms, seals: NoSeals,
    ) -> None:  # fmt: skip
        super().__init__(
            settings, own_share, store, exchange, numbers, receipts, NoDeletionReports(store), observer, alarms
        )
        self.archive = archive
        """What has become of all data."""
        self.arrived = archive
        self._alarms = alarms
        self._seals = seals
        self._claims: dict[int, dict[DatumId, Fate]] = {}
        """What drones report of others' data that may not exist, by the drone that says it."""

    def _take_up(self, own_share: float) -> Holdings:
        # Data that have arrived are in the archive.
        return Holdings(
            self.store, self.settings, self.settings.capacity(own_share, bounded=False), self.exchange, load=False
        )

    def room_for(self, size: int, *, own: bool, items: int = 1) -> bool:
        """Whether the store takes more data, `size` bytes of payload in all."""
        return self.store.room_for(size)

    def make_room(self, size: int, *, own: bool) -> bool:
        """A base drops no data that have arrived."""
        return False

    def has_custody(self, custodian: int, number: int, id: DatumId, crc: int, datum: Datum | None = None) -> bool:
        """Whether this very datum has arrived. The sender may delete the last copy because of this, so check the
        store."""
        stored = self.store.get(id)
        if stored is None or stored.crc != crc or not stored.intact:
            return False
        return datum is None or datum.payload == stored.payload

    def take_custody(self, custodian: int, number: int, datum: Datum) -> bool:
        """A datum arrives. False: no space, the sender keeps it. If two contents have one id, both are kept."""
        stored = self.store.get(datum.id)
        if stored is not None and not stored.intact:
            stored = None
        if stored is not None and stored.crc == datum.crc:
            same = stored.payload == datum.payload
            # Somebody has made a second content for a checksum.
            self.refused += not same
            return same
        if not self._seals.is_authentic(datum):
            return self._put_aside(datum)
        if stored is None:
            return super().take_custody(custodian, number, datum)
        if not (self.may_accept(len(datum.payload)) and self.store.keep_apart(datum)):
            self.refused += 1
            return False
        self._alarms.ring(Alarm.TWO_CONTENTS, str(datum.id))
        self.observer.kept_apart(datum)
        return True

    def _put_aside(self, datum: Datum) -> bool:
        """A datum comes in that was not made by the node that it names. False: the disk fails, the sender keeps it.

        It is accepted, or else it would stay where it is, in the place of the true one. But it has not arrived: no
        receipt names it. It is kept apart while there is space, because the keys here may be the wrong ones.
        """
        if not self.store.accepting:
            self.refused += 1
            return False
        if self.store.get_apart(datum.id, datum.crc) is None:
            self.store.count("forged")
            self._alarms.ring(Alarm.UNSEALED, str(datum.id))
            self.store.keep_apart(datum)
        return True

    def keep(self, datum: Datum, custodian: int | None = None) -> None:
        """A datum has arrived."""
        self.store.put(datum)
        if self.archive.is_lost(datum.id):
            self.store.found(datum.id)
        if self.archive.add(datum.id):
            self.receipts.arrived(datum.id)
        self.observer.delivered(datum)
        for claims in self._claims.values():
            for id in [id for id in claims if id.sequence < self.archive.end(id[:2])]:
                self._lose(id, claims.pop(id))

    def keep_replica(self, custodian: int, number: int, datum: Datum, distance: Distance | None = None) -> bool:
        """A replica has arrived like any other."""
        return self.take_custody(custodian, number, datum)

    def overhear(self, handovers: Iterable[Handover]) -> None:
        """Data have arrived that were meant for another node. Only receipts say so: sender and receiver keep custody
        until there is an answer to a hand-over of their own."""
        for _, datum in handovers:
            id = datum.id
            if id in self.archive or not datum.intact or self.has_id_conflict(id):
                continue
            if self.may_accept(len(datum.payload)) and self._seals.is_authentic(datum):
                self.keep(datum.arrived())

    def apply(self, changed: set[Pair]) -> None:
        """Nothing that receipts are about is held here."""

    @property
    def takes_notes(self) -> bool:
        """Whether bases report arrivals and losses at all."""
        return self.receipts.active

    def take_note(self, id: DatumId, note: Note) -> bool:
        """A neighbour reports that a datum is lost, or a store damaged. False: there is no space for the note.

        Where there are keys, a node is believed about itself. Of others it may have had what they have created: what it
        says of their data waits until a later number of theirs has arrived.
        """
        fate = fate_of(note.reason)
        if not self._seals.vouched:
            return self._lose(id, fate)
        by = self._seals.reporter(id, note.reason, note.proof)
        if by is None or (by != id.origin and fate in STORE_FAULTS):
            # If it were refused, it would be offered indefinitely.
            return True
        if by == id.origin or id.sequence < self.archive.end(id[:2]):
            return self._lose(id, fate)
        claims = self._claims.setdefault(by, {})
        claims[id] = fate
        if len(claims) > MAX_CLAIMS:
            del claims[next(iter(claims))]
        return True

    def _lose(self, id: DatumId, fate: Fate) -> bool:
        archive = self.archive
        if self.has_id_conflict(id) or (
            id in archive.store_faults if fate in STORE_FAULTS else archive.is_lost(id) or self.has(id)
        ):
            return True
        if not archive.lose(id, fate):
            return False
        self.store.lose(id, fate)
        if fate in STORE_FAULTS:
            self._alarms.ring(Alarm.UNKNOWN if fate is Fate.UNKNOWN else Alarm.DAMAGED, str(id))
        else:
            self.receipts.lost(id)
        return True

    def has(self, id: DatumId) -> bool:
        """Whether a good copy has arrived, by the store, not by the index in memory."""
        stored = self.store.get(id)
        return stored is not None and stored.intact
