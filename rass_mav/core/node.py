"""The node: Alg. 1 of the paper with custody, over messages. Sans I/O: time and randomness come in, messages go out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from math import inf
from typing import Any

from rass_mav.core import messages
from rass_mav.core.alarms import Alarm
from rass_mav.core.custody.base_store import BaseStore
from rass_mav.core.custody.custody_store import CustodyStore
from rass_mav.core.custody.effects import Ask, Count, Drop, Effect, Hand, Lose, Retire, Take, Tell
from rass_mav.core.custody.holdings import Holdings, Pending, ReplicaOffer
from rass_mav.core.custody.incoming import Incoming
from rass_mav.core.custody.percolation import Percolation
from rass_mav.core.custody.sender import Sender
from rass_mav.core.custody.transfers import Transfers
from rass_mav.core.datum import MAX_PAYLOAD, Datum, DatumId, Fate
from rass_mav.core.messages import BROADCAST, Beacon, Committed, Message, sender_of
from rass_mav.core.news.archive import Archive, Serials
from rass_mav.core.news.deletion_reports import DeletionReports, NoDeletionReports, Note, NoteOffer
from rass_mav.core.news.own_numbers import OwnNumbers
from rass_mav.core.news.receipts import NoReceipts, Receipts
from rass_mav.core.news.statements import is_sound_note, make_sequence_mark
from rass_mav.core.participant import Participant
from rass_mav.core.policy import Policy
from rass_mav.core.replicas.replicas import AtBase, NoReplicas, Replicas
from rass_mav.core.settings import NodeSettings

#: How many answers a node remembers until its next beacon, which carries eight.
MAX_ANSWERED = 64


class Node(Participant):
    """A participant that keeps data in custody, and percolates them towards a base."""

    __slots__ = (
        "_answered",
        "_phase",
        "archive",
        "custody_store",
        "incoming",
        "own",
        "percolation",
        "replicas",
        "sender",
        "transfers",
    )

    def _take_up(self, now: float) -> Holdings:
        self._answered: dict[tuple[int, int], tuple[DatumId, int, bool]] = {}
        """Datum and content hash of what was accepted since the last turn, and whether as a replica, by sender and
        number, the latest last."""
        self.archive = Archive(self.store.ids(), self.store.losses()) if self.base else None
        """At a base: what has become of all data."""
        # Neighbours' turns should not coincide, so ids are scattered (by Knuth's multiplicative hashing).
        self._phase = self.id * 2654435761 % (1 << 32) >> 16
        self.receipts = self._make_receipts()
        self.custody_store = custody_store = self._make_custody_store(now)
        watches = custody_store.notes.active and self.archive is None
        self.own = OwnNumbers(self.id, self.store, self.receipts, self.alarms) if watches else None
        """What becomes of own data; None: receipts do not exist."""
        self.transfers = Transfers(custody_store, self.pace, self.rng)
        self.incoming = Incoming(custody_store, self.routing, self.pace, self.rng)
        self.sender = Sender(custody_store, self.transfers, self.routing, self.pace, self.rng)
        self.percolation = Percolation(
            custody_store, self.transfers, self.routing, self.pace, self.policy, self.risk, self.rng
        )
        self.replicas = self._make_replicas()
        return custody_store.holdings

    def _make_replicas(self) -> NoReplicas:
        custody_store = self.custody_store
        if isinstance(custody_store, BaseStore):
            return AtBase(custody_store)
        if self.settings.replicas:
            return Replicas(custody_store, self.routing, self.pace, self.risk, self.rng)
        return NoReplicas()

    def _make_receipts(self) -> NoReceipts:
        if not self.settings.receipts:
            return NoReceipts()
        period, phase = self.settings.custody.receipt_steps, self._phase
        if self.archive is None:
            return Receipts(self.rng, period=period, phase=phase)
        source, serials = (self.id, self.store.life), Serials(self.store)
        return Receipts(self.rng, source, archive=self.archive, serials=serials, period=period, phase=phase)

    def _make_custody_store(self, now: float) -> CustodyStore:
        settings, store, exchange, numbers = self.settings, self.store, self.exchange, self.numbers
        if self.archive is not None:
            news = self.receipts, self.archive
            return BaseStore(
                settings, self.policy.own_share, store, exchange, numbers, *news, self.observer, self.alarms,
                self.routing, self.rng, now, self.seals,
            )  # fmt: skip
        active = settings.receipts and settings.acknowledged
        notes = DeletionReports(store, exchange, self.seals) if active else NoDeletionReports(store)
        return CustodyStore(
            settings, self.policy.own_share, store, exchange, numbers, self.receipts, notes, self.observer, self.alarms,
            self.routing, self.rng, now,
        )  # fmt: skip

    # -- Alg. 1 --------------------------------------------------------------------------------------------------------

    def step(self, now: float) -> list[Message]:
        """One turn of Alg. 1. Returns what to send, the beacon first."""
        custody_store = self.custody_store
        out: list[Message] = []
        self._begin_turn(now)
        custody_store.journal.step(self.routing)
        self.update_routing_table(now)
        out.append(self.update_fitness(now))
        out += self.receipts.turn(self._steps, self.routing.neighbours.values())
        if self.own is not None and self.routing.route is not None:
            self.own.turn(self.holdings)
        custody_store.now = now
        self._apply(self.replicas.step(now), now, out)
        if is_due := self.exchange.due <= now:
            self.exchange.due = inf
        # If not is_fit() and |N| > 0: evict_data(). While the node is fit (Eq. 4), its policy has no plan.
        if self.holdings.custody:
            self._apply(self._evict(now, out), now, out)
        if is_due:
            out += self.transfers.tend(now)
        self._apply(self.replicas.spread_far(now), now, out)
        custody_store.messages.flush(out)
        if (self._steps + self._phase) % self.settings.custody.receipt_steps == 0 and (
            note := custody_store.notes.turn(self.id, self.routing.next_hop, now)
        ) is not None:
            out.append(note)
        # store_measurements() follows: `put`.
        return out

    def _begin_turn(self, now: float) -> None:
        """Drop what has been corrupted or has expired since the last turn, and renew the bandwidth."""
        self._steps += 1
        self.custody_store.scrub()
        self.custody_store.dirty = False
        self.pace.begin_turn()
        self.custody_store.expire(now)
        self.incoming.age(now)
        self.transfers.age(now)

    def _evict(self, now: float, out: list[Message]) -> Iterator[Effect]:
        """All that leaves in a turn, in this order, as far as the bandwidth goes."""
        if self.exchange.open:
            yield from self.sender.late(now, out)
        yield from self.percolation.scattered(now)
        yield from self.percolation.detours(self.replicas.detours)
        yield from self._forward(now)

    def _forward(self, now: float) -> Iterator[Effect]:
        """What leaves between two turns, too."""
        if self.pace.left > 0 and self.routing.neighbours:
            yield from self.percolation.probes()
            yield from self.percolation.plan(self.potential, now)
            yield from self.replicas.spread(now)

    def forward(self, now: float) -> list[Message]:
        """`evict_data` of Alg. 1 between two turns."""
        custody_store = self.custody_store
        if not custody_store.dirty:
            return []
        custody_store.dirty = False
        out: list[Message] = []
        if self.holdings.custody:
            self._apply(self._forward(now), now, out)
        custody_store.messages.flush(out)
        return out

    def tend(self, now: float) -> list[Message]:
        exchange = self.exchange
        if now < exchange.due:
            return []
        exchange.due = inf
        out = self.transfers.tend(now)
        if exchange.open:
            self._apply(self.sender.late(now, out), now, out)
        return out

    def _apply(self, effects: Iterable[Effect], now: float, out: list[Message]) -> None:
        """Do what a part asks for, one effect after the other. `out` receives the data; what neighbours are told and
        asked follows with the next `flush`."""
        self.sender.send(self._done(effects), now, out)

    def _done(self, effects: Iterable[Effect]) -> Iterator[Hand]:
        """What `Sender` has to do of them, in their order; the others are done when it is their turn."""
        custody_store = self.custody_store
        for effect in effects:
            match effect:
                case Hand():
                    yield effect
                case Drop(holding, fate):
                    custody_store.drop(holding, fate)
                case Take(id):
                    custody_store.rescue(id)
                case Count(holding, on):
                    custody_store.count_on(holding, on)
                case Retire(holding):
                    custody_store.retire(holding)
                case Lose(id):
                    custody_store.give_up(id)
                case Ask(search):
                    custody_store.ask(search)
                case Tell(to, id, status):
                    custody_store.messages.say(to, id, status)

    # -- own data ------------------------------------------------------------------------------------------------------

    @property
    def most_bytes(self) -> int:
        """Largest payload of a datum that may be created here."""
        return MAX_PAYLOAD

    def _has_room_for_own(self, size: int) -> bool:
        return self.custody_store.room_for(size, own=True) or self.custody_store.make_room(size, own=True)

    def _keep_own(self, datum: Datum) -> None:
        self.custody_store.keep(datum)

    def needed(self, answers: list[Message], moves: list[Message]) -> list[Message]:
        """Whoever gave this node a datum hears it handed on, so no Committed names it."""
        return self.sender.needed(answers, moves) if self.settings.passive else answers

    @property
    def overhears(self) -> bool:
        """Whether this node handles the data that neighbours send to others."""
        return self.settings.overhears or self.settings.measured

    @property
    def overheard(self) -> dict[DatumId, Datum]:
        """Data that others handed over to each other, and that are kept here in memory only."""
        return self.custody_store.overheard.data

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        custody_store = self.custody_store
        return {
            "sent_data": self.pace.sent,
            "refused": custody_store.refused,
            "corrupt_received": custody_store.corrupt_received,
            "handovers_pending": len(self.exchange.of(Pending)),
            **self.replicas.figures(),
            **custody_store.journal.figures(),
            **({} if self.archive is None else _report_of(self.archive)),
            **({"loss_notes": len(custody_store.notes.waiting)} if custody_store.notes.active else {}),
        }

    def adopt(self, settings: NodeSettings, policy: Policy) -> None:
        """Continue with other weights and another bandwidth. The policy's costs add up as before."""
        super().adopt(settings, policy)
        self.percolation.policy = policy

    def keep_pace(self, turn_s: float, items: int, now: float, told_s: float | None = None) -> None:
        """As for every participant; transfers live as long as neighbours do."""
        super().keep_pace(turn_s, items, now, told_s)
        routing = self.routing
        self.incoming.lifetime_s = routing.lifetime_s * (routing.turn_s / routing.step_s)

    # -- incoming messages ---------------------------------------------------------------------------------------------

    def receive(self, message: Message, now: float) -> list[Message]:
        """A message from a neighbour. Returns the answers; they may be sent once the store has committed."""
        if type(message) is Beacon:
            if self.exchange.open:
                return self._hear_beacon(message, now)
            # Most messages are beacons. While nothing waits for answers they change no copies.
            if message.sender != self.id:
                self.routing.hear(message, now)
                return []
            return self._on_beacon(message, now)
        sender = sender_of(message)
        if sender is not None and (neighbour := self.routing.neighbours.get(sender)) is not None:
            neighbour.noticed = now
        answers = HANDLERS[type(message)](self, message, now)
        self.custody_store.messages.flush(answers)
        return answers

    def _hear_beacon(self, beacon: Beacon, now: float) -> list[Message]:
        """A beacon, while hand-overs or offers wait for answers: these may be in it."""
        out = self._on_beacon(beacon, now)
        for answer in beacon.answers:
            if answer.target == self.id:
                out += self._on_committed(answer, now, again=True)
        self.sender.not_answered(beacon.sender, now)
        self.custody_store.messages.flush(out)
        return out

    def _on_data(self, data: messages.Data, now: float) -> list[Message]:
        sender, target, handovers, _, _ = data
        if target == self.id or target == BROADCAST:
            return self._take(data)
        # A neighbour sends data to another node. Only that one can promise anything.
        if self.holdings.custody and self.settings.passive:
            for holding in self.sender.moves_on(data, now):
                self.custody_store.give_away(holding, sender)
        if self.settings.overhears:
            self.custody_store.overhear(sender, handovers, now)
        return []

    def _take(self, data: messages.Data) -> list[Message]:
        custody_store, content_hashes = self.custody_store, self.numbers.content_hashes
        committed: list[tuple[int, int]] = []
        refused: list[int] = []
        for number, datum in data.handovers:
            if not datum.intact:
                custody_store.corrupt_received += 1
            elif not (
                custody_store.keep_replica(data.sender, number, datum, data.distance)
                if data.replica
                else custody_store.take_custody(data.sender, number, datum)
            ):
                refused.append(number)
            elif number:
                content_hash = content_hashes.of(datum, replica=data.replica)
                committed.append((number, content_hash))
                if self.settings.measured:
                    self._answered[data.sender, number] = datum.id, content_hash, data.replica
        while len(self._answered) > MAX_ANSWERED:
            del self._answered[next(iter(self._answered))]
        return self._answer(data.sender, committed, [number for number in refused if number])

    def _answers_again(self) -> tuple[Committed, ...]:
        if not self._answered:
            return ()
        answered, self._answered = self._answered, {}
        to: dict[int, list[tuple[int, int]]] = {}
        for (custodian, number), (id, content_hash, replica) in answered.items():
            # The sender may delete its copy because of this, so the copy here must still be good.
            stored = self.store.get(id)
            if (
                stored is None
                or self.numbers.content_hashes.of(stored, replica=replica) != content_hash
                or not stored.intact
            ):
                continue
            if self.store.durable(id):
                to.setdefault(custodian, []).append((number, content_hash))
            else:
                # The answer itself still waits for the disk.
                self._answered[custodian, number] = id, content_hash, replica
        return tuple([Committed(self.id, custodian, tuple(done), ()) for custodian, done in to.items()])

    def _answer(self, to: int, committed: list[tuple[int, int]], refused: list[int]) -> list[Message]:
        if not committed and not refused:
            return []
        return [Committed(self.id, to, tuple(committed), tuple(refused))]

    def _on_committed(self, message: Committed, now: float, *, again: bool = False) -> list[Message]:
        """`again`: the answer waited for a beacon, so it says nothing of how long answers take."""
        custody_store, exchange, sender = self.custody_store, self.exchange, message.sender
        out: list[Message] = []
        for number, crc in message.committed:
            match exchange.answered(number, sender):
                case Pending() as pending if (holding := self.holdings.custody[pending.id]).crc == crc:
                    if not again:
                        self.sender.answered(pending, now)
                    custody_store.give_away(holding, sender)
                    if pending.sending is not None:
                        out += self.transfers.taken(pending.sending, now)
                case ReplicaOffer() as offer:
                    self._apply(self.replicas.taken(offer, crc, now), now, out)
                case NoteOffer() as note:
                    custody_store.notes.committed(note)
        refused: list[ReplicaOffer] = []
        for number in message.refused:
            match exchange.answered(number, sender):
                case Pending() as pending:
                    custody_store.journal.refused(sender)
                    self.holdings.put_off(self.holdings.custody[pending.id])
                case ReplicaOffer() as offer:
                    refused.append(offer)
                case NoteOffer() as note:
                    custody_store.notes.refused(note)
        if refused:
            self._apply(self.replicas.refused(refused, now), now, out)
        return out

    def _on_offer(self, offer: messages.Offer, now: float) -> list[Message]:
        if offer.target == self.id:
            return self.incoming.on_offer(offer, now)
        if self.settings.overhears:
            self.incoming.listening.on_offer(offer)
        return []

    def _on_accept(self, accept: messages.Accept, now: float) -> list[Message]:
        if accept.target == self.id:
            return self.transfers.on_accept(accept, now)
        if self.settings.overhears:
            self.incoming.listening.on_accept(accept, now)
        return []

    def _on_copy_statuses(self, message: messages.CopyStatuses, now: float) -> list[Message]:
        out: list[Message] = []
        self._apply(self.replicas.on_copy_statuses(message, now), now, out)
        return out

    def _on_receipt(self, receipt: messages.Receipt, now: float) -> list[Message]:
        if self.receipts.contradicts(receipt):
            self.alarms.ring(Alarm.FORGED, f"statement {receipt.serial}")
            return []
        changed = self.receipts.learn(receipt)
        if changed:
            if (self.id, self.store.epoch) in changed and not self.seals.vouched:
                self._contradict(receipt)
            self.custody_store.apply(changed)
        return []

    def _contradict(self, receipt: messages.Receipt) -> None:
        """A receipt is about own data: does it name numbers that were never assigned?"""
        store = self.store
        if store.assigned <= 0xFFFFFFFF and self.receipts.deny(
            make_sequence_mark(self.id, store.epoch, store.assigned), own=True
        ):
            self.alarms.ring(Alarm.DENIED, f"base {receipt.base}")

    def _on_sequence_mark(self, sequence_mark: messages.SequenceMark, now: float) -> list[Message]:
        if self.seals.vouched:
            return []
        if (
            self.archive is not None
            and self.archive.end((sequence_mark.origin, sequence_mark.epoch)) > sequence_mark.assigned
        ):
            self.alarms.ring(Alarm.DENIED, f"node {sequence_mark.origin}, which has assigned {sequence_mark.assigned}")
        if (sequence_mark.origin, sequence_mark.epoch) != (self.id, self.store.epoch):
            # The origin itself knows better what it has assigned.
            self.receipts.deny(sequence_mark)
        return []

    def _on_deletion_report(self, note: messages.DeletionReport, now: float) -> list[Message]:
        if not self.custody_store.takes_notes:
            return []
        taken: dict[int, int | None] = {}
        for number, id, reason, crc, proof in note.entries:
            if is_sound_note(id, reason, crc):
                good = self.custody_store.take_note(id, Note(reason, crc, note.sender, proof))
                taken[number] = self.numbers.content_hashes.of_note(id, reason) if good else None
        committed = [(number, content_hash) for number, content_hash in taken.items() if content_hash is not None]
        return self._answer(note.sender, committed, [number for number, good in taken.items() if good is None])


def _report_of(archive: Archive) -> dict[str, int]:
    """What was reported to a base, for `status`."""
    store_faults = Counter(archive.store_faults.values())
    return {
        "reported_lost": archive.reported_lost,
        "told_unknown": store_faults[Fate.UNKNOWN],
        "told_damaged": store_faults[Fate.DAMAGED],
    }


#: The handler of each message. Entries of a stigmergy are for `StigmergyNode`.
HANDLERS: dict[type, Callable[[Node, Any, float], list[Message]]] = {
    Beacon: Node._on_beacon,
    messages.Data: Node._on_data,
    Committed: Node._on_committed,
    messages.Offer: Node._on_offer,
    messages.Accept: Node._on_accept,
    messages.Chunk: lambda node, message, now: node.incoming.on_chunk(message, now),
    messages.Sack: lambda node, message, now: node.transfers.on_sack(message, now),
    messages.Receipt: Node._on_receipt,
    messages.DeletionReport: Node._on_deletion_report,
    messages.Put: Node._ignore,
    messages.Query: Node._ignore,
    messages.CopyStatuses: Node._on_copy_statuses,
    messages.SequenceMark: Node._on_sequence_mark,
}
