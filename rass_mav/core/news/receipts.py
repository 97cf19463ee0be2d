"""Receipts: a base's statements of what it has, told on from neighbour to neighbour until all know.

Each node keeps the statements that it has heard (`table`), and announces a digest of them in its beacon. In its turn,
once in so many steps, it says one statement at most:

- News: what it has heard since, the longest waiting first. What a neighbour has said meanwhile has been heard by most,
  so it is not said again. To a neighbour that says what is outdated, what replaces it is said. A base speaks for itself
  in every other turn, or in each while there is no other news.
- A round: while a neighbour announces another digest, all that is known goes round, the latest heard first. So a node
  that was away learns what it has missed. While there is news, a round gets one turn in `ROUND_SHARE`.

It comes to an end. Statements die only of others that say more, so news dies out, and neighbours that hear each other
end with the same digest. If they cannot (one does not hear the other), each round without anything new learned doubles
the pause before the next, and after `MAX_ROUNDS` no more follow until something is learned or a new neighbour appears.
A node that had to forget for want of room would differ for ever: it announces digest 0, which means "do not compare",
it takes no part in rounds, and what it learns at the price of forgetting is no news unless it replaces something.

What a receipt may end is the keeper's affair: spare copies, and never custody.
"""

from __future__ import annotations

from collections.abc import Collection

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import NO_ROUTE, Given, Receipt
from rass_mav.core.news.archive import Archive
from rass_mav.core.news.checksums import is_sound
from rass_mav.core.news.ranges import Ranges
from rass_mav.core.news.table import EMPTY, MAX_STATEMENTS, Identity, Kept, Pair, Source, Statements
from rass_mav.core.news.voice import Serials, Voice
from rass_mav.core.routes.neighbours import Neighbour

#: While there is news, one turn in so many belongs to a round that is under way.
ROUND_SHARE = 4
#: Turns that a neighbour's digest must differ before a round begins: news is on its way, mostly.
PATIENCE = 2
#: Turns from one round to the next; doubled with each one while nothing is learned.
PAUSE = 16
#: So many rounds go without anything learned.
MAX_ROUNDS = 6
#: An origin's denial is said in one turn of so many at most.
DENIAL_TURNS = 6
#: How many denials wait to be said.
MAX_DENIALS = 64
#: For so many turns, longer than a denial may wait to be said, the same one is an old one,
HEEDED_TURNS = DENIAL_TURNS * MAX_DENIALS
#: and its origin may have given so many numbers since.
GIVEN_SINCE = 1024


class NoReceipts:
    """Of a node that neither says nor hears what has arrived."""

    __slots__ = ()

    told = False
    """Whether bases say what has arrived."""

    def __contains__(self, id: object) -> bool:
        """Whether a base is known to have said that a datum has arrived."""
        return False

    def told_lost(self, id: DatumId) -> bool:
        """Whether a base was told that a datum is lost, and no base is known to have got it."""
        return False

    def known(self) -> dict[Pair, Ranges]:
        """All that bases say has arrived, by (origin, epoch)."""
        return {}

    @property
    def digest(self) -> int:
        """For the beacon: equal digests, equal knowledge. 0: there is no use in comparing."""
        return 0

    def arrived(self, id: DatumId) -> None:
        """At a base: a datum has arrived, the archive has it."""

    def lost(self, id: DatumId) -> None:
        """At a base: a datum was told lost, the archive knows."""

    def learn(self, receipt: Receipt) -> set[Pair]:
        """Take in what a neighbour says. Returns the pairs of which something new is known."""
        return set()

    def contradicts(self, receipt: Receipt) -> bool:
        """At a base: whether a statement in its name says that something has arrived here that has not."""
        return False

    def deny(self, given: Given, *, own: bool = False) -> bool:
        """An origin says how many numbers it has given. Whether statements are known that name others; they are told
        no more, and the origin's word is told on. `own`: this node is the origin."""
        return False

    def due(self, step: int) -> bool:
        """Whether this node has its turn in a step."""
        return False

    def turn(self, neighbours: Collection[Neighbour]) -> Receipt | None:
        """What to say, at most one frame's worth; None: nothing."""
        return None

    def denial(self) -> Given | None:
        """An origin's denial that is to be said in this turn; None: there is none."""
        return None


class Receipts(NoReceipts):
    """What one node knows of arrivals, and what it has to say about them."""

    told = True
    __slots__ = (
        "_denials", "_heeded", "_hushed", "_met", "_mine", "_news", "_pause", "_period", "_phase", "_round", "_rounds",
        "_turns", "_voice", "statements",
    )  # fmt: skip

    def __init__(
        self, source: Source = (0, 0), *, archive: Archive | None = None, serials: Serials | None = None,
        period: int = 1, phase: int = 0, max_statements: int = MAX_STATEMENTS,
    ) -> None:  # fmt: skip
        """At a base, `source`: its (node id, life); `archive`: what has arrived at this very base; `serials`: of its
        statements. Both None: not a base.

        A turn comes every `period` steps, when (step + phase) is a multiple of it.
        """
        self.statements = Statements(max_statements)
        """What is known."""
        self._voice = None
        if archive is not None and serials is not None:
            self._voice = Voice(source, archive, serials, self.statements)
        self._mine = True
        """Whether it is the base's own turn."""
        self._turns = 0
        self._news: dict[Identity, None] = {}
        """What is to be said, the longest waiting first."""
        self._round: dict[Identity, None] = {}
        """What has yet to go round, the next one last."""
        self._rounds = 0
        """Rounds since something was learned."""
        self._pause = PATIENCE
        """Turns before the next round."""
        self._met: frozenset[Pair] = frozenset()
        """Neighbours at the last turn."""
        self._period = period
        self._phase = phase
        self._denials: dict[Pair, Given] = {}
        """Of origins, to be said."""
        self._heeded: dict[Given, int] = {}
        """Denials, and the turn from which on each is heeded once more."""
        self._hushed = 0
        """Turns before the next denial."""

    # -- what is known -------------------------------------------------------------------------------------------------

    def __contains__(self, id: object) -> bool:
        return isinstance(id, DatumId) and id.sequence in self.statements.sum((id.origin, id.epoch)).arrived

    def told_lost(self, id: DatumId) -> bool:
        known = self.statements.sum((id.origin, id.epoch))
        return id.sequence in known.lost and id.sequence not in known.arrived

    def known(self) -> dict[Pair, Ranges]:
        return {pair: known for pair in self.statements.pairs() if (known := self.statements.sum(pair).arrived)}

    @property
    def digest(self) -> int:
        return 0 if self.statements.forgetful else self.statements.digest or EMPTY

    def disagreement(self) -> str:
        """What is wrong with its own books, for tests; empty: nothing."""
        if not (self._news.keys() | self._round.keys()) <= self.statements.of.keys():
            return "something is to be said that is not known"
        return self.statements.disagreement()

    # -- learning ------------------------------------------------------------------------------------------------------

    def arrived(self, id: DatumId) -> None:
        if self._voice is not None:
            self._voice.changed(id, lost=False)

    def lost(self, id: DatumId) -> None:
        if self._voice is not None:
            self._voice.changed(id, lost=True)

    def learn(self, receipt: Receipt) -> set[Pair]:
        for given in self.statements.denials(receipt):
            # The neighbour has not heard it.
            self._tell(given)
        identity: Identity = receipt[:4]
        if identity in self.statements.of:
            # Said by somebody: most have heard it.
            self._news.pop(identity, None)
            self._round.pop(identity, None)
            return set()
        changed, is_news, better = self._add(receipt)
        if is_news:
            self._news[identity] = None
        for kept in better:
            # The neighbour is behind.
            self._news[kept.identity] = None
        return changed

    def _add(self, receipt: Receipt) -> tuple[set[Pair], bool, list[Kept]]:
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
        return self._voice is not None and self._voice.contradicts(receipt)

    def deny(self, given: Given, *, own: bool = False) -> bool:
        heeded = not own and self._turns < self._heeded.get(given, 0)
        # Else what bases say anew because of it would meet the same word again, without end.
        since = GIVEN_SINCE if heeded and self._voice is None else 0
        if not self.statements.deny(given, since):
            return False
        self._clear_up()
        if self._voice is not None:
            self._voice.denied((given.origin, given.epoch))
        if not heeded:
            self._heeded.pop(given, None)
            self._heeded[given] = self._turns + HEEDED_TURNS
            if len(self._heeded) > MAX_DENIALS:
                del self._heeded[next(iter(self._heeded))]
        if since or not heeded:
            self._tell(given)
        return True

    def _tell(self, given: Given) -> None:
        pair = (given.origin, given.epoch)
        if pair in self._denials or len(self._denials) < MAX_DENIALS:
            self._denials[pair] = given

    # -- telling -------------------------------------------------------------------------------------------------------

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
        """Which bases do beacons name?"""
        named = {(n.beacon.base, n.beacon.base_life) for n in neighbours if n.beacon.hops != NO_ROUTE}
        if self._voice is not None:
            named.add(self._voice.source)
        if named:
            self.statements.named = named

    def _own(self) -> Receipt | None:
        """At a base: what it says itself."""
        if self._voice is None:
            return None
        self._voice.turn()
        self._mine = not self._mine or not self._news
        said = self._voice.statement() if self._mine else None
        if said is not None:
            self._add(said)
        return said

    def _next(self, *, going: bool) -> Receipt | None:
        """What others have said. `going`: what goes round comes before the news."""
        while self._news or self._round:
            if self._round and (going or not self._news):
                identity, _ = self._round.popitem()
                self._news.pop(identity, None)
            else:
                identity = next(iter(self._news))
                del self._news[identity]
                self._round.pop(identity, None)
            kept = self.statements.of[identity]
            if kept.receipt[:4] == identity and is_sound(kept.receipt):
                return kept.receipt
            # Neighbours will say it again: the digests differ now.
            self.statements.forget(kept)
            self._clear_up()
        return None

    def denial(self) -> Given | None:
        if self._hushed:
            self._hushed -= 1
            return None
        if not self._denials:
            return None
        self._hushed = DENIAL_TURNS - 1
        return self._denials.pop(next(iter(self._denials)))

    def _compare(self, neighbours: Collection[Neighbour]) -> None:
        """Begin a round if a neighbour knows something else, or end it if none does."""
        met = frozenset([(n.id, n.beacon.life) for n in neighbours])
        if not met <= self._met:
            self._rounds = 0
            self._pause = min(self._pause, PATIENCE)
        self._met = met
        digest = self.digest
        if all(n.beacon.digest in (digest, 0) for n in neighbours):
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
