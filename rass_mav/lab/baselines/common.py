"""What the baselines have in common: an idealised participant that copies or moves data from neighbour to neighbour.

The ideal: all nodes trust each other, nothing waits for a disk, and a neighbour's beacon is believed at once. The cost
is real: every frame goes over the mock radio in an existing kind of message, at its full size.

- Beacon: as ever, once a turn. The protocol's own estimate takes the place of the potential.
- Data: a copy for one neighbour. The hand-over's number has the protocol's mark for that copy in its low 16 bits.
- Committed: the neighbour has it (or refused it). Without an answer the datum is sent again.
- Words, all `HERE`: the summary vector. A new neighbour is told of all copies, later only of new ones. It also stands
  for an answer that was lost.
- Receipt: as among our own nodes, the bases' statements of what has arrived. They end copies ("vaccines"). A node sends
  at most one in its turn, but relays it at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rass_mav.core import messages
from rass_mav.core.custody.holdings import Holding, Holdings
from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.messages import (
    BROADCAST,
    INLINE_BYTES,
    Committed,
    CopyStatus,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    Handover,
    Message,
)
from rass_mav.core.news.archive import Archive, Serials
from rass_mav.core.news.receipts import NoReceipts, Receipts
from rass_mav.core.participant import Participant
from rass_mav.core.routes.neighbours import Neighbour, is_base

#: A neighbour is in contact if its last beacon is at most this old, turns; and so long where beacons get lost.
CONTACT_TURNS = 1.5
LOSSY_TURNS = 3.5
#: How often a copy is sent without an answer. The wait doubles each time.
MAX_TRIES = 4
#: A full summary vector is sent at most once in this many steps.
SUMMARY_STEPS = 5
#: How often what is known of data that have arrived is cleared up, steps.
CLEAR_STEPS = 16


class Sending:
    """A copy that a neighbour has not answered for."""

    __slots__ = ("again", "neighbour", "number", "tries")

    def __init__(self, number: int, neighbour: int, again: float) -> None:
        self.number = number
        """The protocol's mark is in the low 16 bits."""
        self.neighbour = neighbour
        self.again = again
        """When it is sent again, seconds."""
        self.tries = 1


class Baseline(Participant):
    """A node of a protocol that others have published. A subclass says what goes where."""

    __slots__ = (
        "_archive",
        "_dirty",
        "_full_at",
        "_gained",
        "_learned",
        "_live",
        "_may_tell",
        "_met",
        "_offered",
        "_pending",
        "_strangers",
        "refused",
        "where",
    )  # fmt: skip

    #: Whether neighbours tell each other which copies they have.
    summarises = True

    def _take_up(self, now: float) -> Holdings:
        assert self.policy.costs is None, "what a beacon announces in place of the potential is no cost"
        settings, store = self.settings, self.store
        self._archive = Archive(store.ids()) if self.base else None
        if settings.receipts:
            period, phase = settings.custody.receipt_steps, self.id
            self.receipts: NoReceipts = Receipts(self.rng, period=period, phase=phase)
            if self._archive is not None:
                self.receipts = Receipts(
                    self.rng,
                    (self.id, store.life),
                    archive=self._archive,
                    serials=Serials(store),
                    period=period,
                    phase=phase,
                )
        self.where: dict[DatumId, set[int]] = {}
        """Which neighbours are known to have a datum."""
        self.refused = 0
        """Copies refused for lack of space."""
        self._pending: dict[DatumId, Sending] = {}
        self._offered: dict[int, DatumId] = {}
        """What is pending, by number."""
        self._dirty: dict[DatumId, None] = {}
        """What may leave at once: it has just come in, or its last copy has just been answered for."""
        self._gained: dict[DatumId, None] = {}
        """What the neighbours have not been told of."""
        self._live: list[Neighbour] = []
        """The neighbours in contact."""
        self._met: frozenset[int] = frozenset()
        self._may_tell = False
        """Whether a statement may still be sent in this turn."""
        self._learned = False
        """Whether one came in that `forward` has not looked at."""
        self._strangers = False
        """Whether a neighbour needs the full summary vector."""
        self._full_at = 0
        """The first step in which it may be sent again."""
        self.begin_life(now)
        holdings = Holdings(
            store, settings, settings.capacity(self.policy.own_share, bounded=not self.base), self.exchange
        )
        for id in holdings:
            self.begin(id, 0)
        return holdings

    # -- what a protocol says ------------------------------------------------------------------------------------------

    def begin_life(self, now: float) -> None:
        """Create the protocol's own state."""

    def hear(self, neighbour: Neighbour, now: float) -> None:
        """A beacon of a neighbour was heard."""

    def announce(self, now: float) -> int:
        """What the beacon announces in the place of the potential, 32 bits. Called once a turn, before data leave."""
        return 0

    def begin(self, id: DatumId, mark: int | None) -> None:
        """A datum is here now. `mark`: as the sender sent it, or 0 after a reboot; None: it was created here."""

    def end(self, id: DatumId) -> None:
        """A datum is no longer here."""

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        """Which of the drones in contact that are not known to have a datum receives it now; None: it waits for a
        base."""
        return None

    def mark(self, id: DatumId, neighbour: Neighbour) -> int:
        """The mark for this copy, 16 bits; 0 if the own copy goes."""
        return 0

    def given(self, id: DatumId, neighbour: int, mark: int) -> bool:
        """The neighbour has it. Returns whether the own copy goes."""
        return False

    def order(self, ids: Iterable[DatumId], now: float) -> Iterable[DatumId]:
        """In which order data leave: first in, first out."""
        return ids

    def victim(self) -> Holding | None:
        """What a full store drops for a new datum, the oldest; None: it refuses the new one."""
        return next(iter(self.holdings.custody.values()), None)

    # -- turns ---------------------------------------------------------------------------------------------------------

    def step(self, now: float) -> list[Message]:
        """One turn. Returns what to send, the beacon first."""
        self._steps += 1
        for holding in self.holdings.damaged(self.settings.store.scrub_items):
            self._drop(holding, Fate.CORRUPTED)
        self.pace.begin_turn()
        lifetime_s = self.settings.data.lifetime_s
        if lifetime_s is not None and not self.base:
            for holding in self.holdings.older(now - lifetime_s):
                self._drop(holding, Fate.EXPIRED)
        self.update_routing_table(now)
        self._look_round(now)
        potential = self.announce(now)
        out: list[Message] = [self.update_fitness(now)._replace(potential=potential)]
        self.potential = potential
        self._may_tell = not self._tell(out)
        if self.summarises and self._live:
            self._summarise(out)
        if not self.base and self._live:
            self._repeat(now, out)
            self._dirty.clear()
            self._send(self.order(list(self.holdings.custody), now), now, out)
        return out

    def forward(self, now: float) -> list[Message]:
        """Send at once what may leave."""
        if not (self._dirty or self._learned):
            return []
        dirty, self._dirty = self._dirty, {}
        out: list[Message] = []
        if self._learned:
            self._learned = False
            if self._may_tell:
                self._may_tell = not self._tell(out)
        if not self.base and self._live:
            self._send(self.order(dirty, now), now, out)
        return out

    def _tell(self, out: list[Message]) -> bool:
        """Send a statement of what has arrived. Returns whether there was one."""
        statements = self.receipts.turn(self._steps, self.routing.neighbours.values())
        out += statements
        return len(statements) > 0

    def _look_round(self, now: float) -> None:
        """Who is in contact, who is new, and who has gone."""
        neighbours = self.routing.neighbours
        turn_s = self.routing.longest_turn_s
        fresh, oldest = now - CONTACT_TURNS * turn_s, now - LOSSY_TURNS * turn_s
        self._live = [n for n in neighbours.values() if n.heard >= fresh or (not n.clean and n.heard >= oldest)]
        met = frozenset(neighbours)
        if met != self._met:
            if gone := self._met - met:
                for known in self.where.values():
                    known -= gone
            self._strangers = self._strangers or not met <= self._met
            self._met = met
        if self._steps % CLEAR_STEPS == 0:
            for id in [id for id, known in self.where.items() if not known or id in self.receipts]:
                del self.where[id]

    def _summarise(self, out: list[Message]) -> None:
        """Tell the neighbours of all copies if one is new, otherwise of new ones."""
        ids: Iterable[DatumId] = self._gained
        if self._strangers and self._steps >= self._full_at and not self.base:
            ids = self.holdings
            self._strangers = False
            self._full_at = self._steps + SUMMARY_STEPS
        entries = tuple([CopyStatusEntry(id, CopyStatus.HERE) for id in ids])
        self._gained.clear()
        if entries:
            out.append(CopyStatuses(self.id, BROADCAST, entries))

    # -- sending -------------------------------------------------------------------------------------------------------

    def _send(self, ids: Iterable[DatumId], now: float, out: list[Message]) -> None:
        """Send what the protocol chooses, within the bandwidth."""
        frames: dict[int, list[Handover]] = {}
        bases = [n for n in self._live if is_base(n.beacon)]
        drones = [n for n in self._live if not is_base(n.beacon)]
        for id in ids:
            if self.pace.left <= 0:
                break
            if id in self._pending:
                continue
            known = self.where.get(id, ())
            neighbour = next((n for n in bases if n.id not in known), None)
            if neighbour is None:
                neighbour = self.choose(id, [n for n in drones if n.id not in known] if known else drones, now)
            if neighbour is not None and (datum := self._load(id)) is not None:
                number = self._number(self.mark(id, neighbour))
                self._pending[id] = Sending(number, neighbour.id, now + self._patience_s)
                self._offered[number] = id
                self._put_in(frames, neighbour.id, number, datum)
        self._put_out(frames, out)

    def _number(self, mark: int) -> int:
        """A number for a copy with this mark; 0 would mean that no answer is wanted."""
        return self.exchange.draw() & 0xFFFF0000 | mark or self._number(mark)

    @property
    def _patience_s(self) -> float:
        """How long to wait for an answer, seconds."""
        return self.routing.longest_turn_s

    def _put_in(self, frames: dict[int, list[Handover]], target: int, number: int, datum: Datum) -> None:
        self.pace.spend()
        frames.setdefault(target, []).append(Handover(number, datum))

    def _put_out(self, frames: dict[int, list[Handover]], out: list[Message]) -> None:
        out += [Data(self.id, target, tuple(handovers)) for target, handovers in frames.items()]

    def _repeat(self, now: float, out: list[Message]) -> None:
        """Send again what has not been answered, and give up what went to a neighbour that is gone."""
        if not self._pending:
            return
        contacts = {n.id for n in self._live}
        frames: dict[int, list[Handover]] = {}
        for id, sending in list(self._pending.items()):
            if sending.neighbour not in contacts or sending.tries >= MAX_TRIES:
                self._cancel(id)
            elif now >= sending.again and self.pace.left > 0 and (datum := self._load(id)) is not None:
                sending.again = now + self._patience_s * (1 << sending.tries)
                sending.tries += 1
                self._put_in(frames, sending.neighbour, sending.number, datum)
        self._put_out(frames, out)

    def _cancel(self, id: DatumId) -> None:
        sending = self._pending.pop(id, None)
        if sending is not None:
            self._offered.pop(sending.number, None)

    # -- stored data ---------------------------------------------------------------------------------------------------

    @property
    def most_bytes(self) -> int:
        """A datum goes whole in one frame."""
        return INLINE_BYTES

    def _has_room_for_own(self, size: int) -> bool:
        return self._make_room(size, own=True)

    def _make_room(self, size: int, *, own: bool) -> bool:
        while not self.holdings.room_for(size, own=own):
            victim = self.victim()
            if victim is None:
                return False
            self._drop(victim, Fate.OVERFLOW)
        return self.store.room_for(size)

    def _keep_own(self, datum: Datum) -> None:
        self._keep(datum, None)

    def _keep(self, datum: Datum, mark: int | None) -> None:
        self.holdings.add(datum)
        self._gained[datum.id] = self._dirty[datum.id] = None
        self.begin(datum.id, mark)
        self.observer.gained(datum)

    def _load(self, id: DatumId) -> Datum | None:
        """A datum that is here. None: it is corrupt, and has been dropped."""
        holding, datum = self.holdings.get(id), self.store.get(id)
        if holding is not None and (datum is None or not datum.intact):
            self._drop(holding, Fate.CORRUPTED)
            return None
        return datum

    def _drop(self, holding: Holding, fate: Fate) -> None:
        id = holding.id
        self._cancel(id)
        self._dirty.pop(id, None)
        self._gained.pop(id, None)
        self.where.pop(id, None)
        if fate not in (Fate.PASSED_ON, Fate.DELIVERED):
            self.numbers.forget(id)
        self.end(id)
        self.store.count(fate.value)
        self.holdings.remove(holding, fate)
        self.observer.dropped(id, fate)

    def figures(self) -> dict[str, int]:
        """Counters of this life, by name, for `status`."""
        return {
            "sent_data": self.pace.sent, "refused": self.refused, "corrupt_received": 0,
            "handovers_pending": len(self._pending),
        }  # fmt: skip

    # -- incoming messages ---------------------------------------------------------------------------------------------

    def receive(self, message: Message, now: float) -> list[Message]:
        """A message from a neighbour. Returns the answers."""
        return HANDLERS.get(type(message), Baseline._ignore)(self, message, now)

    def _hear_beacon(self, beacon: messages.Beacon, now: float) -> list[Message]:
        self._on_beacon(beacon, now)
        neighbour = self.routing.neighbours.get(beacon.sender)
        if neighbour is not None and neighbour.beacon is beacon:
            self.hear(neighbour, now)
        return []

    def _on_data(self, data: Data, now: float) -> list[Message]:
        committed: list[tuple[int, int]] = []
        refused: list[int] = []
        for number, datum in data.handovers:
            if not datum.intact:
                continue
            if self._take(data.sender, number, datum):
                committed.append((number, datum.crc))
            else:
                refused.append(number)
        if data.target == BROADCAST or not (committed or refused):
            return []
        return [Committed(self.id, data.sender, tuple(committed), tuple(refused))]

    def _take(self, custodian: int, number: int, datum: Datum) -> bool:
        """Whether a datum is here now, or need not be."""
        id = datum.id
        if self._archive is not None:
            if self._archive.add(id):
                self.holdings.add(datum.arrived())
                self.receipts.arrived(id)
                self._gained[id] = None
                self.observer.delivered(datum.arrived())
            return True
        if id in self.holdings:
            if (sending := self._pending.get(id)) is not None and not sending.number & 0xFFFF:
                # Nodes that hand each other the same datum must not all let go of it.
                self._cancel(id)
            self.where.setdefault(id, set()).add(custodian)
            return True
        if id in self.receipts or self.numbers.has_accepted(custodian, number, id, datum.crc):
            return True
        if not self._make_room(len(datum.payload), own=False):
            self.refused += 1
            return False
        self._keep(datum.arrived(), number & 0xFFFF)
        self.where.setdefault(id, set()).add(custodian)
        self.numbers.accept(custodian, number, id, datum.crc)
        return True

    def _on_committed(self, answer: Committed, now: float) -> list[Message]:
        for number, _ in answer.committed:
            id = self._offered.get(number)
            if id is not None and self._pending[id].neighbour == answer.sender:
                self._settle(id)
        for number in answer.refused:
            id = self._offered.get(number)
            if id is not None and self._pending[id].neighbour == answer.sender:
                self._cancel(id)
        return []

    def _on_copy_statuses(self, words: CopyStatuses, now: float) -> list[Message]:
        for id, word in words.entries:
            if word != CopyStatus.HERE:
                continue
            self.where.setdefault(id, set()).add(words.sender)
            if id in self._pending and self._pending[id].neighbour == words.sender:
                # Its answer was lost.
                self._settle(id)
        return []

    def _settle(self, id: DatumId) -> None:
        """The neighbour that was sent a datum has it."""
        sending, holding = self._pending[id], self.holdings.get(id)
        assert holding is not None, "what is pending is here"
        self._cancel(id)
        neighbour = self.routing.neighbours.get(sending.neighbour)
        if neighbour is not None and is_base(neighbour.beacon):
            self._drop(holding, Fate.DELIVERED)
        elif self.given(id, sending.neighbour, sending.number & 0xFFFF):
            self._drop(holding, Fate.PASSED_ON)
        else:
            self.where.setdefault(id, set()).add(sending.neighbour)
            self._dirty[id] = None

    def _on_receipt(self, receipt: messages.Receipt, now: float) -> list[Message]:
        changed = self.receipts.learn(receipt)
        self._learned = self._learned or bool(changed)
        if changed and not self.base:
            for id in [id for id in self.holdings if (id.origin, id.epoch) in changed and id in self.receipts]:
                holding = self.holdings.get(id)
                assert holding is not None
                self._drop(holding, Fate.DELIVERED)
        return []


#: The handlers of the messages that mean something here.
HANDLERS: dict[type, Callable[[Any, Any, float], list[Message]]] = {
    messages.Beacon: Baseline._hear_beacon,
    messages.Data: Baseline._on_data,
    messages.Committed: Baseline._on_committed,
    messages.CopyStatuses: Baseline._on_copy_statuses,
    messages.Receipt: Baseline._on_receipt,
}
