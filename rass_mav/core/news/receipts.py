"""Receipts: a base's statements of what it has, relayed from neighbour to neighbour until all nodes know.

Each node keeps the statements that it has heard (`table`), and announces a hash of them in its beacon. In its turn,
once in so many steps, it sends at most one statement:

- News: what it has heard since, the longest waiting first. What a neighbour has sent meanwhile has been heard by most
  nodes, so it is not repeated. To a neighbour that sends an outdated statement, the node sends its replacement. A base
  sends its own statements in every other turn, or in each while there is no other news.
- A round: while a neighbour announces another hash, the node sends all that it knows, the latest heard first. So a
  node that was away learns what it has missed. While there is news, a round gets one turn in `ROUND_SHARE`.

This comes to an end. A statement dies only when another covers it, so news dies out, and neighbours that hear each
other end with the same hash. If they cannot (one does not hear the other), each round in which nothing is learned
doubles the pause before the next. After `MAX_ROUNDS` there are no more until something is learned or a new neighbour
appears. A node that had to forget something for lack of space would differ permanently. It announces hash 0, which
means "do not compare", and takes no part in rounds. What it learns at the price of forgetting is no news unless it
replaces something.

The custody store decides what a receipt ends: replicas, and never custody.
"""

from __future__ import annotations

from collections.abc import Collection

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Receipt, SequenceMark
from rass_mav.core.news.archive import Archive, ReportComposer, Serials
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.table import EMPTY, MAX_STATEMENTS, Identity, Pair, Source, Statement, Statements
from rass_mav.core.routes.neighbours import Neighbour

#: While there is news, one turn in this many belongs to a round that is under way.
ROUND_SHARE = 4
#: Turns that a neighbour's hash must differ before a round begins: in most cases news is already in transit.
PATIENCE = 2
#: Turns from one round to the next; doubled with each one while nothing is learned.
PAUSE = 16
#: The most rounds in which nothing is learned.
MAX_ROUNDS = 6
#: An origin's denial is sent in at most one turn of this many.
DENIAL_TURNS = 6
#: How many denials may wait to be sent.
MAX_DENIALS = 64
#: Turns in which a repeated denial counts as outdated; longer than a denial may wait to be sent.
APPLIED_TURNS = DENIAL_TURNS * MAX_DENIALS
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

    def arrives(self, pair: Pair) -> bool:
        """Whether any datum of an (origin, epoch) has arrived."""
        return False

    def arrivals(self) -> dict[Pair, Ranges]:
        """All that bases state has arrived, by (origin, epoch)."""
        return {}

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

    def due(self, step: int) -> bool:
        """Whether this node has its turn in a step."""
        return False

    def turn(self, neighbours: Collection[Neighbour]) -> Receipt | None:
        """What to send, at most one frame's worth; None: nothing."""
        return None

    def denial(self) -> SequenceMark | None:
        """An origin's denial to send in this turn; None: there is none."""
        return None


class Receipts(NoReceipts):
    """What one node knows of arrivals, and what it has to send about them."""

    active = True
    __slots__ = (
        "_applied",
        "_composer",
        "_denials",
        "_hushed",
        "_met",
        "_mine",
        "_news",
        "_pause",
        "_period",
        "_phase",
        "_round",
        "_rounds",
        "_turns",
        "statements",
    )  # fmt: skip

    def __init__(
        self, source: Source = (0, 0), *, archive: Archive | None = None, serials: Serials | None = None,
        period: int = 1, phase: int = 0, max_statements: int = MAX_STATEMENTS,
    ) -> None:  # fmt: skip
        """At a base, `source`: its (node id, life); `archive`: what has arrived at this base; `serials`: of its
        statements. Both None: not a base.

        A turn comes every `period` steps, when (step + phase) is a multiple of it.
        """
        self.statements = Statements(max_statements)
        """What is known."""
        self._composer = None
        if archive is not None and serials is not None:
            self._composer = ReportComposer(source, archive, serials, self.statements)
        self._mine = True
        """Whether it is the turn of the base's own statements."""
        self._turns = 0
        self._news: dict[Identity, None] = {}
        """Statements to send, the longest waiting first."""
        self._round: dict[Identity, None] = {}
        """The rest of the round, the next one last."""
        self._rounds = 0
        """Rounds since something was learned."""
        self._pause = PATIENCE
        """Turns before the next round."""
        self._met: frozenset[Pair] = frozenset()
        """Neighbours at the last turn."""
        self._period = period
        self._phase = phase
        self._denials: dict[Pair, SequenceMark] = {}
        """Denials by origins, to be sent."""
        self._applied: dict[SequenceMark, int] = {}
        """Denials, and the turn from which on each counts in full again."""
        self._hushed = 0
        """Turns before the next denial."""

    # -- knowledge -----------------------------------------------------------------------------------------------------

    def __contains__(self, id: object) -> bool:
        return isinstance(id, DatumId) and id.sequence in self.statements.sum(id[:2]).arrived

    def is_reported_lost(self, id: DatumId) -> bool:
        stated = self.statements.sum((id.origin, id.epoch))
        return id.sequence in stated.lost and id.sequence not in stated.arrived

    def arrives(self, pair: Pair) -> bool:
        return bool(self.statements.sum(pair).arrived)

    def arrivals(self) -> dict[Pair, Ranges]:
        return {pair: ranges for pair in self.statements.pairs() if (ranges := self.statements.sum(pair).arrived)}

    def identities(self) -> set[tuple[int, int, int]]:
        return {identity[:3] for identity in self.statements.of}

    @property
    def statements_hash(self) -> int:
        return 0 if self.statements.forgetful else self.statements.statements_hash or EMPTY

    def disagreement(self) -> str:
        """What is inconsistent in its own tables, for tests; empty: nothing."""
        if not (self._news.keys() | self._round.keys()) <= self.statements.of.keys():
            return "an unknown statement is due to be sent"
        if len(self._denials) > MAX_DENIALS:
            return "too many denials wait"
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
            self._tell(sequence_mark)
        identity: Identity = receipt[:4]
        if identity in self.statements.of:
            # A neighbour sent it: most nodes have heard it.
            self._news.pop(identity, None)
            self._round.pop(identity, None)
            return set()
        changed, is_news, better = self._add(receipt)
        if is_news:
            self._news[identity] = None
        for statement in better:
            # The neighbour is behind.
            self._news[statement.identity] = None
        return changed

    def _add(self, receipt: Receipt) -> tuple[set[Pair], bool, list[Statement]]:
        changed, is_news, better = self.statements.add(receipt)
        if self.statements.forgetful:
            self._round.clear()
        if is_news:
            self._rounds = 0
            self._pause = min(self._pause, PAUSE)
        self._clear_up()
        return changed, is_news, better

    def _clear_up(self) -> None:
        for identity in self.statements.gone:
            self._news.pop(identity, None)
            self._round.pop(identity, None)
        self.statements.gone.clear()

    def contradicts(self, receipt: Receipt) -> bool:
        return self._composer is not None and self._composer.contradicts(receipt)

    def deny(self, sequence_mark: SequenceMark, *, own: bool = False) -> bool:
        applied = not own and self._turns < self._applied.get(sequence_mark, 0)
        # Otherwise the statements that bases send because of it would meet the same denial again, without end.
        since = SEQUENCE_MARK_SINCE if applied and self._composer is None else 0
        if not self.statements.deny(sequence_mark, since):
            return False
        self._clear_up()
        if self._composer is not None:
            self._composer.denied((sequence_mark.origin, sequence_mark.epoch))
        if not applied:
            self._applied.pop(sequence_mark, None)
            self._applied[sequence_mark] = self._turns + APPLIED_TURNS
            if len(self._applied) > MAX_DENIALS:
                del self._applied[next(iter(self._applied))]
        if since or not applied:
            self._tell(sequence_mark)
        return True

    def _tell(self, sequence_mark: SequenceMark) -> None:
        pair = (sequence_mark.origin, sequence_mark.epoch)
        if pair in self._denials or len(self._denials) < MAX_DENIALS:
            self._denials[pair] = sequence_mark

    # -- sending -------------------------------------------------------------------------------------------------------

    def due(self, step: int) -> bool:
        return (step + self._phase) % self._period == 0

    def turn(self, neighbours: Collection[Neighbour]) -> Receipt | None:
        self._look_round(neighbours)
        if not self.statements.forgetful:
            self._compare(neighbours)
        self._turns += 1
        if self._round and self._turns % ROUND_SHARE == 0:
            return self._next(going=True)
        return self._own() or self._next(going=False)

    def _look_round(self, neighbours: Collection[Neighbour]) -> None:
        """Note which bases the neighbours' beacons name."""
        named = {(n.beacon.base, n.beacon.base_life) for n in neighbours if n.beacon.hops != NO_ROUTE}
        if self._composer is not None:
            named.add(self._composer.source)
        if named:
            self.statements.named = named

    def _own(self) -> Receipt | None:
        """At a base: its own statements."""
        if self._composer is None:
            return None
        self._composer.turn()
        self._mine = not self._mine or not self._news
        own = self._composer.statement() if self._mine else None
        if own is not None:
            self._add(own)
        return own

    def _next(self, *, going: bool) -> Receipt | None:
        """Others' statements. `going`: the round comes before the news."""
        while self._news or self._round:
            if self._round and (going or not self._news):
                identity, _ = self._round.popitem()
                self._news.pop(identity, None)
            else:
                identity = next(iter(self._news))
                del self._news[identity]
                self._round.pop(identity, None)
            statement = self.statements.of[identity]
            if statement.receipt[:4] == identity and statement.sound:
                return statement.receipt
            # Neighbours will send it again: the hashes differ now.
            self.statements.forget(statement)
            self._clear_up()
        return None

    def denial(self) -> SequenceMark | None:
        if self._hushed:
            self._hushed -= 1
            return None
        if not self._denials:
            return None
        self._hushed = DENIAL_TURNS - 1
        return self._denials.pop(next(iter(self._denials)))

    def _compare(self, neighbours: Collection[Neighbour]) -> None:
        """Begin a round if a neighbour's knowledge differs, or end it if none does."""
        met = frozenset([(n.id, n.beacon.life) for n in neighbours])
        if not met <= self._met:
            self._rounds = 0
            self._pause = min(self._pause, PATIENCE)
        self._met = met
        statements_hash = self.statements_hash
        if all(n.beacon.statements_hash in (statements_hash, 0) for n in neighbours):
            self._round.clear()
            self._rounds = 0
            self._pause = PATIENCE
        elif self._round or not self.statements.of:
            return
        elif self._pause:
            self._pause -= 1
        elif self._rounds < MAX_ROUNDS:
            self._pause = PAUSE << self._rounds
            self._rounds += 1
            self._round = dict.fromkeys(self.statements.of)
