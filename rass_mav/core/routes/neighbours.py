"""The neighbours: their last beacons, how long each is remembered, and how many at most.

This is Babel's neighbour table (RFC 8966, 3.2.4); a beacon is its Hello, and the missed beacons its history (appendix
A.1).

Any radio can send a beacon under an invented name: a name that was heard once counts for little. It is remembered for
an ordinary lifetime, however long its turn is. It does not affect how long nodes wait for each other, and it gets no
place in a table that is half full. Once heard twice, it is a neighbour.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from rass_mav.core.messages import BEACON_BASE, Beacon
from rass_mav.core.pace import LOSSY, SHARE_GAIN
from rass_mav.core.routes.announcements import newer
from rass_mav.core.routes.contacts import Contacts

# Tuned: python -m tools.sensitivity routes.neighbours
#: A beacon at most this far behind the newest one is a late or duplicated frame; otherwise the neighbour has restarted.
_LATE_WINDOW = 32
#: A neighbour of which recently fewer beacons than this were missed is on a clean link (`Neighbour.missed`).
CLEAN_MISSED = 0.2
#: Bound: The turn in a beacon counts as at most this many seconds: no node has to wait hours for another.
MOST_TURN_S = 60.0
#: Bound: It also counts as at most this many times the time between its sender's last two beacons: a turn may only grow
#: as fast as it is observed.
CREDIT = 4
#: Bound: One place in this many is reserved for bases. There cannot be more: any node can claim to be a base.
_BASES_PART = 4
#: Bound: Beacons missed in a row count as at most so many: a neighbour may say any number.
_MOST_MISSED = 8
#: A neighbour silent for more than this many of its turns has probably moved away. Where beacons get lost, it may miss
#: one.
RECENT_TURNS = 1.5
LOSSY_TURNS = RECENT_TURNS + 1.0
#: Fact: More than the rounding errors of sums of times, seconds.
_ROUNDING_S = 1e-3


class Neighbour:
    """A neighbour as its last beacon described it."""

    __slots__ = (
        "beacon",
        "confirmed",
        "enclosed_until",
        "heard",
        "id",
        "late",
        "leaves",
        "lifetime_s",
        "missed",
        "noticed",
        "odds",
        "patience",
        "refused_until",
        "suspected",
        "turn_s",
        "unanswered_since",
    )  # fmt: skip

    def __init__(self, beacon: Beacon, heard: float, turn_s: float = 1.0, lifetime_s: float = 3.5) -> None:
        self.id = beacon.sender
        self.beacon = beacon
        self.heard = heard
        """When the beacon was heard, seconds."""
        self.noticed = heard
        """When any frame of it was heard, seconds."""
        self.turn_s = turn_s
        """The time between its beacons, seconds."""
        self.lifetime_s = lifetime_s
        """If it is silent for longer, it is gone."""
        self.patience = RECENT_TURNS
        """If it is silent for more than this many of its turns, it has probably moved away."""
        self.missed = 1.0
        """Recently missed beacons: each counts a fifth less with each that is heard."""
        self.confirmed = False
        """Whether it was heard twice: two beacons of one life, in order."""
        self.leaves = inf
        """When it is expected to be out of range, seconds (`Contacts`)."""
        self.late: int | None = None
        """Number of the last beacon that was treated as late."""
        self.suspected = False
        """Whether it takes data and does not deliver them, as far as is known (`custody.journal`)."""
        self.odds = 1.0
        """How many times as much a way by it costs, because of what it did not deliver; 1: nothing."""
        self.refused_until = -inf
        """It refused a replica: until when it is offered none, seconds."""
        self.unanswered_since = inf
        """When the first offer of a replica was sent that it has not answered since it answered one, seconds."""
        self.enclosed_until = -inf
        """It knows no node out of this one's range: until when others are offered replicas first, seconds."""

    def is_missing(self, now: float) -> bool:
        """Whether it has probably moved away: it has been silent for long, or it is expected to be out of range."""
        return self.noticed < now - self.patience * self.turn_s or self.leaves <= now

    @property
    def quality(self) -> float:
        """Share of its recent beacons that were heard, 0..1."""
        # Of the last five or so: the average decays by a fifth.
        return 1.0 / (1.0 + 0.2 * self.missed)

    @property
    def clean(self) -> bool:
        """Whether hardly any beacon is missed on this link: then a missing one means that the link has broken."""
        return self.missed < CLEAN_MISSED


class Neighbours(dict[int, Neighbour]):
    """All neighbours by node id, in the order in which they were first heard."""

    __slots__ = (
        "_expects_loss",
        "_lifetime_s",
        "_longest_s",
        "_loss",
        "_most",
        "_nobody_goes_until",
        "_standing",
        "_step_s",
        "candidates",
        "contacts",
    )  # fmt: skip

    def __init__(
        self,
        step_s: float,
        lifetime_s: float,
        most: int,
        standing: Callable[[Beacon], tuple[int, int]],
        *,
        expects_loss: bool = True,
    ) -> None:
        """`step_s`: the usual time between beacons. A neighbour silent for more than `lifetime_s` is gone; one whose
        beacons are farther apart lives longer accordingly. `standing`: if there is not enough space, the neighbour with
        the greater value is given up. `expects_loss`: where beacons get lost, one that is missing means little."""
        super().__init__()
        self._step_s = step_s
        self._lifetime_s = lifetime_s
        self._most = most
        self._standing = standing
        self.contacts: Contacts | None = None
        """None: no node's motion is taken into account."""
        self.candidates: dict[int, tuple[int, int, float, float]] = {}
        """(life, beacon number, when it was heard, until when the next one must come) of nodes heard once, first in
        first out."""
        # `age` checks no neighbour before that, unless one is new or changes its turn.
        self._expects_loss = expects_loss
        self._loss = 0.0
        """Recent share of the beacons that were missed of neighbours that are still there."""
        self._nobody_goes_until = -inf
        self._longest_s = 0.0

    def hear(self, beacon: Beacon, now: float, next_hop: int | None) -> bool:
        """Process a beacon. False: it is a duplicate or late, there is no space for a new neighbour (the best stay, and
        the next hop, and some bases), or the node has to be heard once more."""
        neighbour = self.get(beacon.sender)
        if neighbour is None:
            return self._hear_new(beacon, now, next_hop)
        last = neighbour.beacon
        missed = (beacon.number - last.number - 1) & 0xFFFF
        lost = 0.0
        if missed:
            behind = -missed - 1 & 0xFFFF
            if behind < _LATE_WINDOW and last.life == beacon.life:
                late = neighbour.late
                if behind:
                    neighbour.late = beacon.number
                if not behind or late is None or not newer(beacon.number, late):
                    return False
                # Late beacons that come in order are current: the newest one was not its own.
            if missed < _MOST_MISSED:
                lost = missed / (missed + 1.0)
            neighbour.missed = 0.8 * neighbour.missed + min(missed, _MOST_MISSED)
        else:
            neighbour.missed *= 0.8
        neighbour.late = None
        if self._expects_loss and (lost or self._loss):
            self._loss += SHARE_GAIN * (lost - self._loss)
            neighbour.patience = LOSSY_TURNS if self._loss > LOSSY else RECENT_TURNS
        neighbour.beacon = beacon
        if not neighbour.confirmed:
            neighbour.confirmed = last.life == beacon.life and newer(beacon.number, last.number)
            self._be_patient(neighbour, now - neighbour.heard)
        elif beacon.turn or neighbour.turn_s > self._step_s or now < neighbour.heard:
            self._be_patient(neighbour, now - neighbour.heard)
        neighbour.heard = neighbour.noticed = now
        contacts = self.contacts
        neighbour.leaves = inf if contacts is None or not beacon.moves else contacts.leaves(beacon.moves, now)
        return True

    def _hear_new(self, beacon: Beacon, now: float, next_hop: int | None) -> bool:
        """A node that is not in the table: heard for the first time, or for the second."""
        id = beacon.sender
        candidates = self.candidates
        life, number, heard, until = candidates.pop(id, (None, 0, now, now))
        new = Neighbour(beacon, now)
        new.confirmed = life == beacon.life and newer(beacon.number, number) and now <= until
        if not new.confirmed:
            if len(candidates) >= self._most:
                del candidates[next(iter(candidates))]
            lifetime_s = self._lifetime_s * (self._turn_s(beacon) / self._step_s)
            candidates[id] = (beacon.life, beacon.number, now, now + lifetime_s)
        if len(self) >= self._most:
            if not (new.confirmed and self._make_room(beacon, next_hop)):
                return False
        elif 2 * len(self) >= self._most and not new.confirmed:
            return False
        if self.contacts is not None:
            new.leaves = self.contacts.leaves(beacon.moves, now)
        self[id] = new
        self._be_patient(new, now - heard)
        return True

    def _turn_s(self, beacon: Beacon) -> float:
        """The time between the beacons of the node that sent this one, seconds."""
        return max(self._step_s, min(beacon.turn / 10, MOST_TURN_S))

    def _be_patient(self, neighbour: Neighbour, gap_s: float) -> None:
        """Set how long a neighbour may be silent, from its last beacon and the time between that and the one before."""
        shown_s = max(self._step_s, CREDIT * gap_s)
        neighbour.turn_s = min(self._turn_s(neighbour.beacon), shown_s) if neighbour.confirmed else self._step_s
        neighbour.lifetime_s = self._lifetime_s * (neighbour.turn_s / self._step_s)
        self._nobody_goes_until = -inf

    def _make_room(self, beacon: Beacon, next_hop: int | None) -> bool:
        """Drop the worst for a better one. The next hop stays, and so do the bases known the longest."""
        stay = {next_hop}
        places = self._most // _BASES_PART
        for n in self.values():
            b = n.beacon
            if places and n.confirmed and is_base(b) and not b.hops and (b.base, b.base_life) == (b.sender, b.life):
                stay.add(n.id)
                places -= 1
        standing = self._standing
        worst = max(
            ((not n.confirmed, *standing(n.beacon), n.id) for n in self.values() if n.id not in stay), default=None
        )
        if worst is None or worst[:3] <= (False, *standing(beacon)):
            return False
        del self[worst[3]]
        return True

    def age(self, now: float) -> float:
        """Forget neighbours that have been silent for too long. Returns the longest lifetime of the others, seconds, or
        0."""
        if now < self._nobody_goes_until:
            return self._longest_s
        gone = []
        until, longest_s = inf, 0.0
        for neighbour in self.values():
            heard, lifetime_s = neighbour.heard, neighbour.lifetime_s
            if heard < now - lifetime_s:
                gone.append(neighbour.id)
                continue
            if lifetime_s > longest_s:
                longest_s = lifetime_s
            if heard + lifetime_s < until:
                until = heard + lifetime_s
        for id in gone:
            del self[id]
        self._nobody_goes_until = until - _ROUNDING_S
        self._longest_s = longest_s
        return longest_s


def is_base(beacon: Beacon) -> bool:
    """Whether the sender of a beacon is a base."""
    return bool(beacon.flags & BEACON_BASE)
