"""Sender: what leaves a node is loaded, numbered, asked and framed in one place.

Percolation and replicas decide what should go where, and yield a `Hand` for each. They change nothing themselves, and
see what each one cost before they decide on the next. The node gives their hands to `Sender.send`, one part after the
other (Alg. 1). Here is also when an unanswered hand-over is repeated.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator

from rass_mav.core.custody.custody_store import STATED_TURNS, CustodyStore
from rass_mav.core.custody.effects import Hand
from rass_mav.core.custody.flow import round_s
from rass_mav.core.custody.holdings import Holding, Pending
from rass_mav.core.custody.transfers import Transfers
from rass_mav.core.datum import Fate, is_share
from rass_mav.core.exchange import MAX_TRIES, MOST_DOUBLINGS, mark
from rass_mav.core.messages import INLINE_BYTES, Committed, Data, Distance, Handover, Message
from rass_mav.core.pace import Pace
from rass_mav.core.routes.neighbours import LOSSY_TURNS, RECENT_TURNS
from rass_mav.core.routes.table import RoutingTable

#: Bound: Turns after which a neighbour must have sent a beacon, with its answers in it.
PATIENT_TURNS = 1.5


class Sender:
    """The hand-overs and replicas of one node on their way out."""

    __slots__ = ("_custody_store", "_exchange", "_pace", "_rng", "_routing", "_transfers")

    def __init__(
        self, custody_store: CustodyStore, transfers: Transfers, routing: RoutingTable, pace: Pace, rng: random.Random
    ) -> None:
        self._custody_store = custody_store
        self._exchange = custody_store.exchange
        self._transfers = transfers
        self._routing = routing
        self._pace = pace
        self._rng = rng

    def send(self, hands: Iterable[Hand], now: float, out: list[Message]) -> None:
        """Send them; what goes to one neighbour in the same way is one message. `out` receives the messages."""
        batches: dict[tuple[int, bool, Distance | None], list[Handover]] = {}
        for hand in hands:
            handover = self._handover(hand, now, out)
            if handover is not None:
                self._pace.spend(again=hand.again is not None)
                batches.setdefault((hand.to, hand.offer is not None, hand.distance), []).append(handover)
        for (to, replica, distance), handovers in batches.items():
            out.append(Data(self._custody_store.settings.node_id, to, tuple(handovers), replica, distance))

    def _handover(self, hand: Hand, now: float, out: list[Message]) -> Handover | None:
        """None: its bytes are corrupt, or it goes in chunks."""
        custody_store, holding = self._custody_store, hand.holding
        if hand.offer is not None:
            # It may have been this node's holder before, and not know so yet.
            custody_store.messages.counts_on(hand.to, holding.id)
        datum = custody_store.load(holding)
        if datum is None:
            return None
        if hand.offer is not None:
            custody_store.holdings.offer(holding, hand.offer)
            return Handover(hand.offer.number, datum)
        if hand.again is not None:
            self._repeat(hand.again, now)
            return Handover(hand.again.number, datum)
        if holding.size > INLINE_BYTES:
            self._transfers.begin(holding, datum, hand.to, now, out)
            return None
        if not custody_store.settings.acknowledged:
            custody_store.drop(holding, Fate.PASSED_ON)
            return Handover(0, datum)
        pending = Pending(self._exchange.draw(holding.taken_as), holding.id, hand.to, now)
        self._wait(pending, now)
        custody_store.holdings.give(holding, pending)
        return Handover(pending.number, datum)

    # -- what is not answered ------------------------------------------------------------------------------------------

    def late(self, now: float, out: list[Message]) -> Iterator[Hand]:
        """What is to be repeated now. Gives up on neighbours that are gone or stay silent."""
        custody_store, pace = self._custody_store, self._pace
        self._exchange.keep(self._routing.neighbours.keys())
        for pending in self._exchange.of(Pending):
            holding = custody_store.holdings.custody[pending.id]
            if self._has_gone(pending.to, now):
                custody_store.holdings.put_off(holding)
            elif pending.tries >= MAX_TRIES:
                custody_store.holdings.put_off(holding)
                if pending.sending is None:
                    custody_store.journal.failed(pending.to)
                else:
                    yield from self._stalled(holding, pending.to, now)
            elif pending.due <= now and pace.left > 0:
                if pending.sending is None:
                    yield Hand(holding, pending.to, again=pending)
                else:
                    self._transfers.check(pending, pending.sending, now, out)
                    self._wait(pending, now)
            elif pending.sending is None and now < pending.due < now + pace.turn_s:
                self._exchange.wake(pending.due)

    def _stalled(self, holding: Holding, to: int, now: float) -> Iterator[Hand]:
        """A transfer in chunks made no progress. The link may have been busy. The second time the datum goes another
        way: this neighbour may take small data only, and these arrive."""
        way = self._routing.another_way(to, now) if holding.stalled == to else None
        holding.stalled = to
        if way is not None and self._transfers.free(way):
            yield Hand(holding, way)

    def _has_gone(self, to: int, now: float) -> bool:
        """Whether to try another neighbour: this one is gone, or silent."""
        neighbour = self._routing.neighbours.get(to)
        if neighbour is None:
            return True
        # It has probably moved away, so another is tried before the routing table gives it up. Where beacons get lost,
        # two must be missing: it may have the datum already, and another neighbour would create a second copy.
        patience = max(neighbour.patience, RECENT_TURNS if neighbour.clean else LOSSY_TURNS)
        return neighbour.noticed < now - patience * neighbour.turn_s

    def _repeat(self, pending: Pending, now: float) -> None:
        most_s = (1 << MOST_DOUBLINGS) * PATIENT_TURNS * self._pace.turn_s
        self._exchange.trip(pending.to).missed(now, now - pending.sent, most_s)
        pending.tries += 1
        pending.sent = now
        self._wait(pending, now)

    def _wait(self, pending: Pending, now: float) -> None:
        """Set when a hand-over that is sent now is sent again."""
        settings, turn_s = self._custody_store.settings, self._pace.turn_s
        if pending.sending is not None:
            # Its rounds without progress are counted.
            pending.due = now + 0.5 * round_s(self._pace)
            return
        if not settings.measured:
            pending.due = now + 0.5 * turn_s
            return
        trip = self._exchange.trip(pending.to)
        wait_s = (trip.wait_s if pending.tries == 1 else trip.usual_s) or PATIENT_TURNS * turn_s
        if pending.tries > 1:
            # At random: others may wait for the same air.
            wait_s *= (1 << min(pending.tries - 1, MOST_DOUBLINGS)) * (0.75 + 0.5 * self._rng.random())
        pending.due = now + wait_s
        self._exchange.wake(pending.due)

    def not_answered(self, neighbour: int, now: float) -> None:
        """A neighbour repeated its answers of the last turn: what it has not answered by now it has not got."""
        if not self._custody_store.settings.measured:
            return
        for pending in self._exchange.of(Pending):
            if pending.to != neighbour or pending.sending is not None:
                continue
            if 0.0 < self._exchange.trip(neighbour).wait_s <= now - pending.sent:
                # In the next turn: many have heard this beacon.
                pending.due = min(pending.due, now)

    def answered(self, pending: Pending, now: float) -> None:
        """A neighbour has taken a datum that was handed over to it."""
        if pending.sending is not None:
            return
        if pending.tries == 1:
            self._exchange.trip(pending.to).measure(now - pending.sent)

    def needed(self, answers: list[Message], moves: Iterable[Message]) -> list[Message]:
        """The answers without those that `moves_on` reads from `moves`, if all neighbours hear these.

        With keys, and of shares, of which no replica stays, an answer is always needed. Where none stays for another
        reason, the next beacon has the answer.
        """
        if self._custody_store.numbers.content_hashes.proven:
            return answers
        moved = {
            (number & 0xFFFF, datum.crc)
            for data in moves
            if type(data) is Data and not data.replica
            for number, datum in data.handovers
            if number and not is_share(datum.kind)
        }
        if not moved:
            return answers
        needed: list[Message] = []
        for answer in answers:
            if type(answer) is Committed:
                left = tuple([pair for pair in answer.committed if (mark(pair[0]), pair[1]) not in moved])
                if not left and not answer.refused:
                    continue
                answer = answer._replace(committed=left)
            needed.append(answer)
        return needed

    def moves_on(self, data: Data, now: float) -> Iterator[Holding]:
        """A neighbour hands data on. If it has one of them from this node, this frame is its answer, or as good as one
        that was lost (passive acknowledgement): yields the copy here, of which custody has passed on.

        Without a replica here, and with keys, which prove answers but not data, an answer is still needed. But a
        corrupt copy is not looked for at once.
        """
        custody_store = self._custody_store
        proven = custody_store.numbers.content_hashes.proven
        if data.replica:
            return
        for number, datum in data.handovers:
            holding = custody_store.holdings.custody.get(datum.id)
            if holding is None or (pending := holding.pending) is None or pending.sending is not None:
                continue
            if pending.to != data.sender or not number or number & 0xFFFF != mark(pending.number):
                continue
            if holding.crc != datum.crc or not datum.intact:
                continue
            if not proven and custody_store.stays(holding, data.sender):
                self.answered(pending, now)
                yield holding
            else:
                holding.moves_until = now + STATED_TURNS * self._routing.longest_turn_s
