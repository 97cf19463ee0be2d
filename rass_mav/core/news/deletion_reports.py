"""Deletion reports: reports that a datum is lost, in transit to a base.

A node that finds a datum in its custody beyond repair creates a note. Notes are handed over from node to node along the
route, with a number and COMMITTED, like data; until then a node keeps them in its store's table of losses. A base that
accepts one knows what has become of the datum. A note is only its origin's belief: some node may have a good copy all
the same. A note therefore deletes nothing, and a node with a good copy does not relay it. A receipt ends no note: notes
go to a base, which knows.

Each note has a checksum, computed by the node that created it and relayed with it. Two kinds are about no single datum
(`STORE_FAULTS`): a damaged store, and numbers of which no node knows whether they were assigned.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import islice
from typing import NamedTuple

from rass_mav.core.datum import REASONS, STORE_FAULTS, DatumId, Fate
from rass_mav.core.exchange import Exchange, Question
from rass_mav.core.messages import DeletionEntry, DeletionReport
from rass_mav.core.news.statements import is_sound_note, note_crc
from rass_mav.core.seals import NO_SEALS, NoSeals
from rass_mav.core.store import Store

#: Most notes of a node. Its own replace others'; others share what is left, by neighbour and by origin.
MAX_NOTES = 256
#: Fact: Notes in a frame, and unanswered at a time, without proofs and with them.
NOTES_IN_FRAME, PROVEN_NOTES_IN_FRAME = 6, 4

_FATES = {reason: fate for fate, reason in REASONS.items()}


def fate_of(reason: int) -> Fate:
    """The fate that a note reports. An unknown reason counts as `VANISHED`."""
    return _FATES.get(reason, Fate.VANISHED)


class Note(NamedTuple):
    """What a node knows of a note, besides the id that it is about."""

    reason: int
    """As it travels."""
    crc: int
    received_from: int | None
    """The node that handed it over; None: it is this node's own, or from an earlier run."""
    proof: bytes = b""
    """Shows the ground who created it (`DeletionEntry`)."""


class NoteOffer(Question):
    """A note that is handed over."""

    __slots__ = ()


class NoDeletionReports:
    """For a node that creates and accepts no notes: a base, or any node where losses are not reported."""

    __slots__ = ("_store", "waiting")

    active = False
    """Whether notes are created and accepted."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.waiting: dict[DatumId, Note] = {}
        """Notes to hand over, the oldest first."""

    def make(self, id: DatumId, fate: Fate) -> None:
        """A datum in custody here is beyond repair; the store knows."""

    def give_up(self, id: DatumId, fate: Fate) -> None:
        """A datum that this node looked for is beyond repair."""
        self._store.lose(id, fate)

    def suspect(self, id: DatumId, fate: Fate) -> None:
        """The copy in custody here is gone, and another node is asked for the datum: `make` or `forget` follow."""

    def take(self, id: DatumId, note: Note) -> bool:
        """A neighbour hands over a sound note. False: there is no space."""
        return False

    def forget(self, id: DatumId) -> None:
        """There is nothing (more) to report about a datum."""

    def turn(self, sender: int, next_hop: int | None, now: float) -> DeletionReport | None:
        """What to send, at most one frame: again what was not answered, or the oldest."""
        return None

    def committed(self, offer: NoteOffer) -> None:
        """A neighbour has accepted a note."""

    def refused(self, offer: NoteOffer) -> None:
        """A neighbour has no space for it: it is offered again, after the others, under a new number."""


class DeletionReports(NoDeletionReports):
    """The notes of one drone."""

    __slots__ = ("_exchange", "_seals", "suspected")

    active = True

    def __init__(self, store: Store, exchange: Exchange, seals: NoSeals = NO_SEALS) -> None:
        """Takes up what the table of losses holds from an earlier life. `seals`: prove own notes."""
        super().__init__(store)
        self._exchange = exchange
        self._seals = seals
        self.suspected: dict[DatumId, Fate] = {}
        """Notes held back while another node is asked for the datum. On disk too, so that a restart does not lose them.
        Bounded by `repairs.MAX_SEARCHES`."""
        self._take_up()

    def _take_up(self) -> None:
        self.waiting = {}
        proofs = self._store.proofs()
        for id, fate in self._store.losses():
            if id not in self.suspected:
                note = self._own(id, fate)
                self._add(id, note._replace(proof=proofs.get(id, note.proof)))

    def make(self, id: DatumId, fate: Fate) -> None:
        self._store.lose(id, fate)
        self.suspected.pop(id, None)
        if id not in self.waiting:
            self._add(id, self._own(id, fate))

    def _own(self, id: DatumId, fate: Fate) -> Note:
        reason = REASONS.get(fate, REASONS[Fate.VANISHED])
        return Note(reason, note_crc(id, reason), None, self._seals.of_note(id, reason))

    def give_up(self, id: DatumId, fate: Fate) -> None:
        self.make(id, fate)

    def suspect(self, id: DatumId, fate: Fate) -> None:
        self._store.lose(id, fate)
        self.suspected[id] = fate

    def _add(self, id: DatumId, note: Note) -> None:
        self.waiting[id] = note
        if len(self.waiting) > MAX_NOTES:
            self._end(self._superfluous() or next(iter(self.waiting)))
            self._store.count("notes_dropped")

    def _superfluous(self) -> DatumId | None:
        """The latest note from the neighbour that has handed over the most, about the origin that has most of these;
        None: all are own."""
        custodians = Counter(note.received_from for note in self.waiting.values() if note.received_from is not None)
        if not custodians:
            return None
        [(most, _)] = custodians.most_common(1)
        theirs = [id for id, note in self.waiting.items() if note.received_from == most]
        [(origin, _)] = Counter(id.origin for id in theirs).most_common(1)
        return next(id for id in reversed(theirs) if id.origin == origin)

    def take(self, id: DatumId, note: Note) -> bool:
        before = self.waiting.get(id)
        if before is not None:
            if (fate_of(before.reason) in STORE_FAULTS) != (
                fate_of(note.reason) in STORE_FAULTS
            ) or before.proof != note.proof:
                # Two different notes happen to have one id, or one of them is forged: the first has to leave first.
                return False
            # It came back: no answer to an earlier offer may delete it any more.
            self._cancel(id)
            return True
        if len(self.waiting) >= MAX_NOTES:
            other = self._superfluous()
            if other is None:
                return False
            if self._share(id.origin, note.received_from) >= self._share(
                other.origin, self.waiting[other].received_from
            ):
                return False
        self._store.lose(id, fate_of(note.reason), note.proof)
        self.suspected.pop(id, None)
        self._add(id, note)
        return True

    def _share(self, origin: int, custodian: int | None) -> tuple[int, int]:
        """How many notes are from a sender, and how many of these are about an origin."""
        theirs = [id for id, note in self.waiting.items() if note.received_from == custodian]
        return len(theirs), sum(id.origin == origin for id in theirs)

    def forget(self, id: DatumId) -> None:
        note = self.waiting.get(id) if self.waiting else None
        if note is not None:
            if fate_of(note.reason) not in STORE_FAULTS:
                self._end(id)
        elif self.suspected and self.suspected.pop(id, None) is not None:
            self._store.found(id)

    def _end(self, id: DatumId) -> None:
        del self.waiting[id]
        self._cancel(id)
        self._store.found(id)

    def _cancel(self, id: DatumId) -> None:
        self._close([offer for offer in self._exchange.of(NoteOffer) if offer.id == id])

    def _close(self, offers: Iterable[NoteOffer]) -> None:
        for offer in offers:
            self._exchange.close(offer)

    def turn(self, sender: int, next_hop: int | None, now: float) -> DeletionReport | None:
        if next_hop is None or not self.waiting:
            return None
        exchange = self._exchange
        offers = exchange.of(NoteOffer)
        if not offers or offers[0].to != next_hop:
            self._close(offers)
            most = NOTES_IN_FRAME if self._seals is NO_SEALS else PROVEN_NOTES_IN_FRAME
            ids = list(islice(self.waiting, most))
            offers = [exchange.ask(NoteOffer(exchange.draw(), id, next_hop, now)) for id in ids]
        entries = []
        for offer in offers:
            reason, crc, _, proof = self.waiting[offer.id]
            entries.append(DeletionEntry(offer.number, offer.id, reason, crc, proof))
        if not all(is_sound_note(entry.id, entry.reason, entry.crc) for entry in entries):
            # Bits have flipped here. The disk has the right ones.
            self._close(offers)
            self._take_up()
            return None
        return DeletionReport(sender, next_hop, tuple(entries))

    def committed(self, offer: NoteOffer) -> None:
        self._end(offer.id)

    def refused(self, offer: NoteOffer) -> None:
        self._exchange.close(offer)
        # A note that finds no space there must not delay the others.
        self.waiting[offer.id] = self.waiting.pop(offer.id)
