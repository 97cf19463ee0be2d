"""Who is around: what the neighbours' last beacons said, how long each is remembered, and how many at most.

Babel's neighbour table (RFC 8966, 3.2.4); a beacon is its Hello, and what was missed its history (appendix A.1).
"""

from __future__ import annotations

from math import inf

from rass_mav.core.messages import BEACON_BASE, Beacon

#: A beacon this little behind the newest one is a late or doubled frame; one further behind is a restarted neighbour.
_LATE_WINDOW = 32
#: A neighbour of whose beacons fewer than this were missed of late is on a clean link (`Neighbour.missed`).
CLEAN_MISSED = 0.2
_MOST_MISSED = 8
#: More than sums of times are rounded by, seconds.
_ROUNDING_S = 1e-3


class Neighbour:
    """A neighbour as its last beacon described it."""

    __slots__ = ("beacon", "heard", "id", "lifetime_s", "missed", "turn_s")

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

    @property
    def clean(self) -> bool:
        """Whether hardly any beacon is missed on this link: then one that is missing means that it has broken."""
        return self.missed < CLEAN_MISSED


class Neighbours(dict[int, Neighbour]):
    """All neighbours by node id, in the order in which they were first heard."""

    __slots__ = ("_lifetime_s", "_longest_s", "_most", "_nobody_goes_until", "_step_s")

    def __init__(self, step_s: float, lifetime_s: float, most: int) -> None:
        """`step_s`: beacons are usually that far apart, and a neighbour silent for more than `lifetime_s` is gone; who
        says that its beacons are farther apart lives longer accordingly."""
        super().__init__()
        self._step_s = step_s
        self._lifetime_s = lifetime_s
        self._most = most
        # `age` looks at nobody before that, unless somebody comes or changes its turn.
        self._nobody_goes_until = -inf
        self._longest_s = 0.0

    def hear(self, beacon: Beacon, now: float, next_hop: int | None) -> bool:
        """Take in a beacon. False: a duplicate, a late one, or there is no room for a new neighbour (the fittest stay,
        and the next hop)."""
        known = self.get(beacon.sender)
        if known is None:
            if len(self) >= self._most and not self._make_room(beacon, next_hop):
                return False
            self[beacon.sender] = Neighbour(beacon, now, *self._patience(beacon.turn))
            self._nobody_goes_until = -inf
            return True
        last = known.beacon
        ahead = (beacon.number - last.number) & 0xFFFF
        if -ahead & 0xFFFF < _LATE_WINDOW and last.life == beacon.life:
            return False
        missed = (ahead - 1) & 0xFFFF
        known.missed = 0.8 * known.missed + (missed if missed < _MOST_MISSED else _MOST_MISSED)
        known.beacon = beacon
        if beacon.turn != last.turn or now < known.heard:
            known.turn_s, known.lifetime_s = self._patience(beacon.turn)
            self._nobody_goes_until = -inf
        known.heard = now
        return True

    def _patience(self, turn: int) -> tuple[float, float]:
        """How far apart somebody's beacons are who says `turn`, and how long it may be silent, seconds."""
        turn_s = max(self._step_s, turn / 10)
        return turn_s, self._lifetime_s * (turn_s / self._step_s)

    def _make_room(self, beacon: Beacon, next_hop: int | None) -> bool:
        """Drop the neighbour of the lowest potential for one of a higher, unless it is the next hop."""
        worst = min(self.values(), key=lambda n: (n.beacon.potential, n.id))
        if worst.beacon.potential >= beacon.potential or worst.id == next_hop:
            return False
        del self[worst.id]
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
