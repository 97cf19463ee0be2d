"""The storing half of a base, where data arrive for good."""

from __future__ import annotations

import random
from collections.abc import Iterable

from rass_mav.core.alarms import Alarm, Alarms
from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.handovers import HandoverNumbers
from rass_mav.core.custody.holdings import Holdings
from rass_mav.core.datum import STORE_FAULTS, Datum, DatumId, Fate
from rass_mav.core.exchange import Exchange
from rass_mav.core.messages import Distance, Handover
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.deletion_reports import NoDeletionReports, Note, fate_of
from rass_mav.core.news.receipts import NoReceipts
from rass_mav.core.news.table import Pair
from rass_mav.core.observer import Observer
from rass_mav.core.routes.table import RoutingTable
from rass_mav.core.seals import NoSeals
from rass_mav.core.settings import NodeSettings
from rass_mav.core.store import Store

#: Reports of one drone about others' data that a base keeps until it knows that these were created.
MAX_CLAIMS = 64


class BaseStore(CustodyStore):
    """The storing half of a base: data that reach it have arrived for good."""

    __slots__ = ("_alarms", "_claims", "_seals", "archive")

    def __init__(
        self, settings: NodeSettings, own_share: float, store: Store, exchange: Exchange, numbers: HandoverNumbers,
        receipts: NoReceipts, archive: Archive, observer: Observer, alarms: Alarms, routing: RoutingTable,
        rng: random.Random, now: float, seals: NoSeals,
    ) -> None:  # fmt: skip
        super().__init__(
            settings, own_share, store, exchange, numbers, receipts, NoDeletionReports(store), observer, alarms,
            routing, rng, now,
        )  # fmt: skip
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
            # A second content was made for a checksum.
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

    def overhear(self, sender: int, handovers: Iterable[Handover], now: float) -> None:
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
