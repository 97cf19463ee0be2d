"""The number that a base announces: raised now and then and on request, and never one that a restart could repeat.

The number is claimed on disk before it is sent, so a restarted base continues after all that it has announced.
"""

from __future__ import annotations

from rass_mav.core.store import Store


def newer(a: int, b: int) -> bool:
    """Whether 16-bit number `a` is newer than `b` (RFC 1982). Numbers half the circle apart: no, both ways."""
    return 0 < ((a - b) & 0xFFFF) < 0x8000


def following(a: int) -> int:
    """The number after `a`."""
    return (a + 1) & 0xFFFF


#: Bound: How many announcement numbers a base claims on disk at a time. When half of them are used, more are claimed.
ANNOUNCEMENTS_CLAIMED = 256
#: Fact: Turns between two occasions on which a base skips numbers. Old numbers must be forgotten before they come round
#: again: two jumps are nearly the whole circle of 16 bits, and a route dies out in as many turns as it has hops, plus a
#: lifetime.
JUMP_TURNS = 30
#: Fact: The most numbers that it skips: fewer than half the circle, so that a node that remembers one of the last
#: thousand numbers considers the new one newer.
MOST_JUMP = 0x7C00
_KEY = "announcement"


class Announcements:
    """A base's announcement number, turn by turn."""

    __slots__ = ("_claimed", "_due", "_durable", "_jumps_again", "_number", "_period", "_store", "_turns")

    def __init__(self, store: Store, period: int) -> None:
        """`period`: turns after which the number is raised; 0: on request only."""
        self._store = store
        self._period = period
        self._turns = 0
        self._number: int | None = None
        """What is announced now."""
        self._due = following(store.get_meta(_KEY) or 0)
        """What to announce as soon as it is on disk."""
        self._durable: int | None = None
        """All numbers up to this one are claimed on disk."""
        self._jumps_again = 0
        """From this turn on numbers may be left out."""
        self.claim()

    def turn(self, requested: int | None) -> int | None:
        """The number to announce in this turn. None: the first one is not on disk yet.

        `requested`: the newest number that any node has asked for, not older than the present one.
        """
        self._turns += 1
        if self._store.meta_durable(_KEY):
            self._durable = self._claimed
        if self._due == self._number:
            self._raise(requested)
        if not ANNOUNCEMENTS_CLAIMED // 2 <= (self._claimed - self._due) & 0xFFFF <= ANNOUNCEMENTS_CLAIMED:
            self.claim()
        if self._durable is not None and not newer(self._due, self._durable):
            self._number = self._due
        return self._number

    def _raise(self, requested: int | None) -> None:
        """Raise the number if it is time, or if a node asks for a newer one.

        A forged beacon in this base's name, or a request without need, may ask for a number far ahead. A node that has
        heard such a beacon accepts nothing older, so the base has to go there; but not as often as it is asked.
        """
        number = self._due
        ahead = 0 if requested is None else (requested - number) & 0xFFFF
        if ahead > 1 and self._turns >= self._jumps_again:
            self._due = (number + min(ahead, MOST_JUMP)) & 0xFFFF
            self._jumps_again = self._turns + JUMP_TURNS
        elif ahead or (self._period and self._turns % self._period == 0):
            self._due = following(number)

    def claim(self) -> None:
        """Claim numbers on disk, or those that are claimed once more, after the store has forgotten some changes."""
        # Not at each number: that would be a write each turn.
        self._claimed = (self._due + ANNOUNCEMENTS_CLAIMED) & 0xFFFF
        self._store.set_meta(_KEY, self._claimed)
