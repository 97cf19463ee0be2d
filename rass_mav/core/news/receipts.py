"""Receipts: a base's statements of what it has, relayed from neighbour to neighbour until all nodes know.

Each node keeps the statements that it has heard (`table`), and announces a hash of them in its beacon. Statements are
items of gossip (`rass_mav.core.gossip`), and so are sequence marks, in which origins deny statements about themselves.
A statement dies only when another covers it, so news dies out, and neighbours that hear each other end with the same
hash. To a neighbour that sends an outdated statement, the node sends its replacement. A base sends its own statements
in every other turn, or in each while others' do not wait.

A node that had to forget something for lack of space would differ permanently: it announces hash 0. What it learns at
the price of forgetting is no news unless it replaces something.

The custody store decides what a receipt ends: replicas and searches, and never custody.
"""

from __future__ import annotations

import random
from collections.abc import Collection, Hashable, Sequence

from rass_mav.core.datum import DatumId
from rass_mav.core.gossip import IMAX, Gossip
from rass_mav.core.messages import NO_ROUTE, Message, Receipt, SequenceMark
from rass_mav.core.news.archive import USUAL_ENTRIES, Archive, ReportComposer, Serials
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.table import EMPTY, MAX_STATEMENTS, Identity, Pair, Source, Statement, Statements
from rass_mav.core.routes.neighbours import Neighbour

#: How many sequence marks may wait to be sent, and of how many a node remembers that it has applied them.
MAX_MARKS = 64
#: Periods in which a repeated sequence mark counts as outdated.
APPLIED_PERIODS = 6 * IMAX
# Tuned: python -m tools.sensitivity news.receipts
#: Numbers that its origin may have assigned since.
SEQUENCE_MARK_SINCE = 1024


class NoReceipts:
    """For a node that neither sends nor hears what has arrived."""

    __slots__ = ()

    active = False
    """Whether bases report what has arrived."""

    def __contains__(self, id: object) -> bool:
        """Whether a base is known to have stated that a datum has arrived."""
        return False

    def is_reported_lost(self, id: DatumId) -> bool:
        """Whether a datum was reported lost to a base, and no base is known to have it."""
        return False

    def is_disputed(self, id: DatumId) -> bool:
        """Whether the origin of a datum has denied what bases state about its numbers: receipts about it count for
        nothing then."""
        return False

    def arrives_after(self, id: DatumId) -> bool:
        """Whether a datum that its origin created after this one has arrived."""
        return False

    def arrivals(self) -> dict[Pair, Ranges]:
        """All that bases state has arrived, by (origin, epoch)."""
        return {}

    def round_turns(self, most: float) -> float:
        """Turns in which a node can relay once what each base states about each origin; at most `most` a base."""
        return 0.0

    def identities(self) -> set[tuple[int, int, int]]:
        """Base, base life and serial of the statements that are known here, and may be relayed."""
        return set()

    @property
    def statements_hash(self) -> int:
        """For the beacon: equal hashes mean equal knowledge. 0: do not compare."""
        return 0

    def arrived(self, id: DatumId) -> None:
        """At a base: a datum has arrived, and the archive has it."""

    def lost(self, id: DatumId) -> None:
        """At a base: a datum was reported lost, and the archive knows."""

    def learn(self, receipt: Receipt) -> set[Pair]:
        """Process a neighbour's statement. Returns the pairs about which something new is known."""
        return set()

    def contradicts(self, receipt: Receipt) -> bool:
        """At a base: whether a statement in its name covers a datum that has not arrived here."""
        return False

    def deny(self, sequence_mark: SequenceMark, *, own: bool = False) -> bool:
        """An origin states how many numbers it has assigned. Returns whether statements are known that name others.
        These are no longer relayed, and the origin's denial is. `own`: this node is the origin."""
        return False

    def turn(self, turn: int, neighbours: Collection[Neighbour]) -> Sequence[Message]:
        """Once a turn of the node: what to send."""
        return ()


class Receipts(NoReceipts):
    """What one node knows of arrivals, and what it has to send about them."""

    active = True
    __slots__ = (
        "_applied",
        "_composer",
        "_mine",
        "_phase",
        "_turn",
        "gossip",
        "marks",
        "statements",
    )

    def __init__(
        self, rng: random.Random, source: Source = (0, 0), *, archive: Archive | None = None,
        serials: Serials | None = None, period: int = 1, phase: int = 0, max_statements: int = MAX_STATEMENTS,
    ) -> None:  # fmt: skip
        """At a base, `source`: its (node id, life); `archive`: what has arrived at this base; `serials`: of its
        statements. Both None: not a base.

        In each `period` turns at most one statement leaves. Once in a period, when (turn + phase) is a multiple of it,
        the node looks at what its neighbours announce.
        """
        self.statements = Statements(max_statements)
        """What is known."""
        self._composer = None
        if archive is not None and serials is not None:
            self._composer = ReportComposer(source, archive, serials, self.statements)
        self._mine = True
        """Whether it is the turn of the base's own statements."""
        self._turn = 0
        self._phase = phase
        self.gossip: Gossip[Identity, Statement] = Gossip(rng, period=period)
        """The statements to send."""
        self.marks: Gossip[Pair, SequenceMark] = Gossip(rng, period=period, most=MAX_MARKS)
        """The sequence marks to send."""
        self._applied: dict[SequenceMark, int] = {}
        """Sequence marks, and the turn from which on each counts in full again."""

    # -- knowledge -----------------------------------------------------------------------------------------------------

    def __contains__(self, id: object) -> bool:
        return isinstance(id, DatumId) and id.sequence in self.statements.sum(id[:2]).arrived

    def is_reported_lost(self, id: DatumId) -> bool:
        stated = self.statements.sum((id.origin, id.epoch))
        return id.sequence in stated.lost and id.sequence not in stated.arrived

    def is_disputed(self, id: DatumId) -> bool:
        return self.statements.is_disputed(id[:2])

    def arrives_after(self, id: DatumId) -> bool:
        bounds = self.statements.sum((id.origin, id.epoch)).arrived.bounds
        return bool(bounds) and bounds[-1] > id.sequence + 1

    def arrivals(self) -> dict[Pair, Ranges]:
        return {pair: ranges for pair in self.statements.pairs() if (ranges := self.statements.sum(pair).arrived)}

    def round_turns(self, most: float) -> float:
        statements = self.statements
        return min(self.gossip.period * statements.reported / USUAL_ENTRIES, statements.bases * most)

    def identities(self) -> set[tuple[int, int, int]]:
        return {identity[:3] for identity in self.statements.of}

    @property
    def statements_hash(self) -> int:
        return 0 if self.statements.forgetful else self.statements.statements_hash or EMPTY

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        if not self.gossip.keys() <= self.statements.of.keys():
            return "an unknown statement is due to be sent"
        if max(self.marks.news, len(self._applied)) > MAX_MARKS:
            return "too many sequence marks"
        return self.statements.disagreement()

    # -- learning ------------------------------------------------------------------------------------------------------

    def arrived(self, id: DatumId) -> None:
        if self._composer is not None:
            self._composer.changed(id, lost=False)

    def lost(self, id: DatumId) -> None:
        if self._composer is not None:
            self._composer.changed(id, lost=True)

    def learn(self, receipt: Receipt) -> set[Pair]:
        for sequence_mark in self.statements.denials(receipt):
            # The neighbour has not heard it.
            self._relay_mark(sequence_mark)
        identity: Identity = receipt[:4]
        if identity in self.statements.of:
            for sender in receipt.senders or (None,):
                self.gossip.hear(identity, sender)
            return set()
        changed, is_news, better = self._add(receipt._replace(senders=()))
        if is_news:
            self._relay(self.statements.of[identity], receipt.senders)
        for statement in better:
            # The neighbour is behind.
            self._relay(statement)
        return changed

    def _relay(self, statement: Statement, senders: tuple[Hashable, ...] = ()) -> None:
        self.gossip.add(statement.identity, statement, statement.identity[:2], self._turn, senders)

    def _add(self, receipt: Receipt) -> tuple[set[Pair], bool, list[Statement]]:
        added = self.statements.add(receipt)
        self._clear_up()
        return added

    def _clear_up(self) -> None:
        for identity in self.statements.gone:
            self.gossip.drop(identity)
        self.statements.gone.clear()

    def contradicts(self, receipt: Receipt) -> bool:
        return self._composer is not None and self._composer.contradicts(receipt)

    def deny(self, sequence_mark: SequenceMark, *, own: bool = False) -> bool:
        applied = not own and self._turn < self._applied.get(sequence_mark, 0)
        # Otherwise the statements that bases send because of it would meet the same mark again, without end.
        since = SEQUENCE_MARK_SINCE if applied and self._composer is None else 0
        if not self.statements.deny(sequence_mark, since):
            if applied:
                self.marks.hear(sequence_mark[:2])
            return False
        self._clear_up()
        if self._composer is not None:
            self._composer.denied(sequence_mark[:2])
        if not applied:
            self._applied.pop(sequence_mark, None)
            self._applied[sequence_mark] = self._turn + APPLIED_PERIODS * self.marks.period
            if len(self._applied) > MAX_MARKS:
                del self._applied[next(iter(self._applied))]
        if since or not applied:
            self._relay_mark(sequence_mark)
        return True

    def _relay_mark(self, sequence_mark: SequenceMark) -> None:
        pair: Pair = sequence_mark[:2]
        self.marks.add(pair, sequence_mark, pair, self._turn)

    # -- sending -------------------------------------------------------------------------------------------------------

    def turn(self, turn: int, neighbours: Collection[Neighbour]) -> Sequence[Message]:
        self._turn = turn
        if (turn + self._phase) % self.gossip.period == 0:
            self._look_round(neighbours)
        statement = self._own() or self._next()
        mark = self.marks.leave(turn)
        out: list[Message] = [] if statement is None else [statement]
        return out if mark is None else [*out, mark[1]]

    def _look_round(self, neighbours: Collection[Neighbour]) -> None:
        """Note what the neighbours' beacons announce."""
        named = {(n.beacon.base, n.beacon.base_life) for n in neighbours if n.beacon.hops != NO_ROUTE}
        if self._composer is not None:
            named.add(self._composer.source)
            self._composer.turn()
        if named:
            self.statements.named = named
        hashes = [((n.id, n.beacon.life), n.beacon.statements_hash) for n in neighbours]
        if self.gossip.differs(self._turn, self.statements_hash, hashes):
            self.gossip.offer(self.statements.of.items())

    def _own(self) -> Receipt | None:
        """At a base: its own statements."""
        if self._composer is None or self._turn < self.gossip.free_at:
            return None
        self._mine = not self._mine or not self.gossip.news
        own = self._composer.statement() if self._mine else None
        if own is not None:
            self._add(own)
            self.gossip.spend(self._turn)
        return own

    def _next(self) -> Receipt | None:
        """Others' statements."""
        while (left := self.gossip.leave(self._turn)) is not None:
            identity, statement = left
            if statement.receipt[:4] == identity and statement.sound:
                return statement.receipt
            # Neighbours will send it again: the hashes differ now.
            self.statements.forget(statement)
            self._clear_up()
        return None
