"""Who is around: what the neighbours' last beacons said, how long each is remembered, and how many at most.

Babel's neighbour table (RFC 8966, 3.2.4); a beacon is its Hello, and what was missed its history (appendix A.1).

Anybody can say a beacon in a name of its own invention, so a name that was heard once is worth little: it is
remembered for an ordinary lifetime however long it says its turn is, it does not count in how long nodes wait for each
other, and it finds no place in a table that is half full. Heard twice, it is a neighbour.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from rass_mav.core.messages import BEACON_BASE, Beacon
from rass_mav.core.routes.serial import newer

#: A beacon this little behind the newest one is a late or doubled frame; one further behind is a restarted neighbour.
_LATE_WINDOW = 32
#: A neighbour of whose beacons fewer than this were missed of late is on a clean link (`Neighbour.missed`).
CLEAN_MISSED = 0.2
#: A turn that a beacon says counts as this many seconds at most: nobody has to be waited for over hours.
MOST_TURN_S = 60.0
#: and as so many times the time between its last two beacons at most: a turn that grows faster has to be shown.
CREDIT = 4
#: One place in so many is kept for bases. More cannot be: anybody can say that it is one.
_BASES_PART = 4
_MOST_MISSED = 8
#: More than sums of times are rounded by, seconds.
_ROUNDING_S = 1e-3


class Neighbour:
    """A neighbour as its last beacon described it."""

    __slots__ = ("beacon", "confirmed", "heard", "id", "late", "lifetime_s", "missed", "turn_s")

    def __init__(self, beacon: Beacon, heard: float, turn_s: float = 1.0, lifetime_s: float = 3.5) -> None:
        self.id = beacon.sender
        self.beacon = beacon
        self.heard = heard
        """When the beacon was heard, seconds."""
        self.turn_s = turn_s
        """It says a beacon every so many seconds."""
        self.lifetime_s = lifetime_s
        """If it is silent for longer, it is gone."""
        self.missed = 1.0
        """Beacons missed of late: each one counts a fifth less with each that is heard."""
        self.confirmed = False
        """Whether it was heard twice: two beacons of one life, in order."""
        self.late: int | None = None
        """Number of the last beacon that was taken for a late one."""

    @property
    def clean(self) -> bool:
        """Whether hardly any beacon is missed on this link: then one that is missing means that it has broken."""
        return self.missed < CLEAN_MISSED


class Neighbours(dict[int, Neighbour]):
    """All neighbours by node id, in the order in which they were first heard."""

    __slots__ = ("_candidates", "_lifetime_s", "_longest_s", "_most", "_nobody_goes_until", "_standing", "_step_s")

    def __init__(
        self, step_s: float, lifetime_s: float, most: int, standing: Callable[[Beacon], tuple[int, int]]
    ) -> None:
        """`step_s`: beacons are usually that far apart, and a neighbour silent for more than `lifetime_s` is gone; who
        says that its beacons are farther apart lives longer accordingly. `standing`: of two neighbours the one of the
        greater is given up for want of room."""
        super().__init__()
        self._step_s = step_s
        self._lifetime_s = lifetime_s
        self._most = most
        self._standing = standing
        self._candidates: dict[int, tuple[int, int, float, float]] = {}
        """(life, beacon number, when it was heard, until when the next one has to be) of who was heard once, first in
        first out."""
        # `age` looks at nobody before that, unless somebody comes or changes its turn.
        self._nobody_goes_until = -inf
        self._longest_s = 0.0

    def hear(self, beacon: Beacon, now: float, next_hop: int | None) -> bool:
        """Take in a beacon. False: a duplicate, a late one, or there is no room for a new neighbour (the best stay,
        and the next hop, and some bases), or it has to be heard once more."""
        known = self.get(beacon.sender)
        if known is None:
            return self._hear_new(beacon, now, next_hop)
        last = known.beacon
        ahead = (beacon.number - last.number) & 0xFFFF
        if -ahead & 0xFFFF < _LATE_WINDOW and last.life == beacon.life:
            late = known.late
            if ahead:
                known.late = beacon.number
            if not ahead or late is None or not newer(beacon.number, late):
                return False
            # Late ones that come in order are its words of now: the newest was never its own.
        known.late = None
        missed = (ahead - 1) & 0xFFFF
        known.missed = 0.8 * known.missed + (missed if missed < _MOST_MISSED else _MOST_MISSED)
        known.beacon = beacon
        if not known.confirmed:
            known.confirmed = last.life == beacon.life and newer(beacon.number, last.number)
            self._be_patient(known, now - known.heard)
        elif beacon.turn or last.turn or now < known.heard:
            self._be_patient(known, now - known.heard)
        known.heard = now
        return True

    def _hear_new(self, beacon: Beacon, now: float, next_hop: int | None) -> bool:
        """Somebody who is not in the table: heard for the first time, or for the second."""
        id = beacon.sender
        candidates = self._candidates
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
        self[id] = new
        self._be_patient(new, now - heard)
        return True

    def _turn_s(self, beacon: Beacon) -> float:
        """How far apart the beacons are of who says this one, seconds."""
        return max(self._step_s, min(beacon.turn / 10, MOST_TURN_S))

    def _be_patient(self, neighbour: Neighbour, gap_s: float) -> None:
        """Set how long a neighbour may be silent, by its last beacon, and how long after the one before that came."""
        shown_s = max(self._step_s, CREDIT * gap_s)
        neighbour.turn_s = min(self._turn_s(neighbour.beacon), shown_s) if neighbour.confirmed else self._step_s
        neighbour.lifetime_s = self._lifetime_s * (neighbour.turn_s / self._step_s)
        self._nobody_goes_until = -inf

    def _make_room(self, beacon: Beacon, next_hop: int | None) -> bool:
        """Drop the worst for somebody better. The next hop stays, and of the bases those that are known the longest."""
        kept = {next_hop}
        places = self._most // _BASES_PART
        for n in self.values():
            b = n.beacon
            if places and n.confirmed and is_base(b) and not b.hops and (b.base, b.base_life) == (b.sender, b.life):
                kept.add(n.id)
                places -= 1
        standing = self._standing
        worst = max(
            ((not n.confirmed, *standing(n.beacon), n.id) for n in self.values() if n.id not in kept), default=None
        )
        if worst is None or worst[:3] <= (False, *standing(beacon)):
            return False
        del self[worst[3]]
        return True

    def age(self, now: float) -> float:
        """Forget who has been silent for too long. Returns the longest lifetime of the others, seconds, or 0."""
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
