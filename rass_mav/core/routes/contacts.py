"""Contacts: how long a neighbour will stay in radio range, from the motion of both.

Each node that knows its place on Earth and its velocity appends both to its beacons (`pack`), unless nothing around it
moves. A neighbour is expected to have left when the two, each on a straight line since it last reported, are farther
apart than the range. The range is not configured: it is the greatest distance at which a beacon was heard lately. A
wrong expectation does little harm: a neighbour that is expected to have left is chosen only if no other is fit, and its
next beacon corrects the expectation.
"""

from __future__ import annotations

import math
from functools import lru_cache
from math import inf
from typing import Protocol

#: Fact: Metres in a degree of latitude (WGS 84, mean), and in a unit of position in beacons.
_METRES_PER_DEGREE = 111_319.5
UNIT_DEGREES = 4e-7
_UNIT_M = UNIT_DEGREES * _METRES_PER_DEGREE
#: Fact: Positions in beacons have 20 bits a coordinate, velocities 12, in units of this many metres per second.
_PLACE_BITS, _SPEED_BITS = 20, 12
UNIT_M_S = 0.02
_PLACE, _SPEED = 1 << _PLACE_BITS, 1 << _SPEED_BITS
_FASTEST = (_SPEED // 2 - 1) * UNIT_M_S
# Tuned: python -m tools.sensitivity routes.contacts
#: A motion older than this is unknown, seconds.
STALE_S = 5.0
#: The range is the greatest distance in the present window and the one before; a window lasts this many seconds.
WINDOW_S = 20.0
#: Fact: A node slower than this hovers, metres per second: autopilots report a little noise.
HOVERS_M_S = 0.1


class Motion(Protocol):
    """A place and a velocity."""

    @property
    def latitude(self) -> float:
        """Degrees, -90..90."""

    @property
    def longitude(self) -> float:
        """Degrees, -180..180."""

    @property
    def north(self) -> float:
        """Metres per second."""

    @property
    def east(self) -> float:
        """Metres per second."""

    @property
    def at(self) -> float:
        """When it was there, seconds."""


def pack(motion: Motion, now: float) -> int:
    """A motion in 64 bits, as it is at `now` if the velocity has not changed. Never 0."""
    age = now - motion.at
    latitude = motion.latitude + motion.north * age / _METRES_PER_DEGREE
    longitude = motion.longitude + motion.east * age / (_METRES_PER_DEGREE * _shrink(motion.latitude))
    packed = 0
    for degrees in (latitude, longitude):
        packed = packed << _PLACE_BITS | round(degrees / UNIT_DEGREES) % _PLACE
    for speed in (motion.north, motion.east):
        packed = packed << _SPEED_BITS | round(max(-_FASTEST, min(speed, _FASTEST)) / UNIT_M_S) % _SPEED
    return packed or 1 << 2 * _SPEED_BITS


@lru_cache(maxsize=64)
def unpack(packed: int) -> tuple[int, int, float, float]:
    """Two coordinates in units of `UNIT_DEGREES`, each up to a multiple of 2^20; and the velocity, m/s."""
    parts = []
    for _ in range(2):
        speed = packed % _SPEED
        parts.append((speed - _SPEED if speed >= _SPEED // 2 else speed) * UNIT_M_S)
        packed >>= _SPEED_BITS
    return packed >> _PLACE_BITS, packed % _PLACE, parts[1], parts[0]


def _shrink(latitude: float) -> float:
    """How much shorter a degree of longitude is here than on the equator."""
    return max(math.cos(math.radians(latitude)), 1e-3)


class Contacts:
    """What one node knows of its own motion and of the range of its radio."""

    __slots__ = ("_dirty_until", "_farthest", "_farthest_before", "_motion", "_since")

    def __init__(self) -> None:
        self._motion: Motion | None = None
        self._farthest = self._farthest_before = 0.0
        """The greatest distance at which a beacon was heard in the present window and the one before, metres."""
        self._since = -inf
        """When the present window began, seconds."""
        self._dirty_until = -inf
        """Until then a neighbour that moves is around, seconds."""

    @property
    def range_m(self) -> float:
        """The range as far as it is known, metres."""
        return max(self._farthest, self._farthest_before)

    def observe(self, motion: Motion) -> None:
        """Where this node is."""
        self._motion = motion

    def announced(self, now: float) -> int:
        """What this node's beacon tells of its motion; 0: it does not know it, or nothing around moves."""
        motion = self._known(now)
        if motion is None:
            return 0
        moves = math.hypot(motion.north, motion.east) > HOVERS_M_S
        return pack(motion, now) if moves or now < self._dirty_until else 0

    def leaves(self, moves: int, now: float) -> float:
        """When a neighbour will be out of range that has just sent this, seconds; inf: as far as is known, never."""
        if not moves:
            return inf
        latitude, longitude, north, east = unpack(moves)
        if north * north + east * east > HOVERS_M_S * HOVERS_M_S:
            self._dirty_until = now + STALE_S
        own = self._known(now)
        if own is None:
            return inf
        age = now - own.at
        shrink = _shrink(own.latitude)
        x = _UNIT_M * _nearest(latitude - own.latitude / UNIT_DEGREES) - own.north * age
        y = _UNIT_M * shrink * _nearest(longitude - own.longitude / UNIT_DEGREES) - own.east * age
        distance = math.hypot(x, y)
        self._heard_at(distance, now)
        u, v = north - own.north, east - own.east
        speed = u * u + v * v
        if speed < HOVERS_M_S * HOVERS_M_S:
            return inf
        # |(x, y) + t (u, v)| = range
        along = x * u + y * v
        beyond = self.range_m**2 - distance**2
        return now + (math.sqrt(along * along + speed * beyond) - along) / speed

    def _known(self, now: float) -> Motion | None:
        motion = self._motion
        return motion if motion is not None and now - motion.at <= STALE_S else None

    def _heard_at(self, distance: float, now: float) -> None:
        if now - self._since >= WINDOW_S:
            self._farthest_before, self._farthest, self._since = self._farthest, 0.0, now
        if distance > self._farthest:
            self._farthest = distance


def _nearest(units: float) -> float:
    """The difference of two coordinates, given up to a multiple of 2^20 units."""
    return (units + _PLACE / 2) % _PLACE - _PLACE / 2
