"""A protocol like RAPID: copies where they shorten the expected delay most."""

from __future__ import annotations

from collections.abc import Iterable

from rass_mav.core.custody.holdings import Holding
from rass_mav.core.datum import DatumId
from rass_mav.core.routes.neighbours import Neighbour, is_base
from rass_mav.lab.baselines.common import Baseline

#: The longest expected time in a beacon, steps; also that of a node that knows nothing.
LONGEST = 0xFFFF
#: Expected times in beacons have this many parts a step.
PARTS = 16
#: Rates in marks have this many parts.
RATE_PARTS = 4096
#: Weight of the latest interval in the average.
GAIN = 0.25


class Rapid(Baseline):
    """A. Balasubramanian, B. N. Levine and A. Venkataramani, DTN Routing as a Resource Allocation Problem, ACM SIGCOMM
    2007, with the utility for the average delay.

    Each node estimates the time until it meets a base, from the intervals of its meetings and what its neighbours
    expect; the beacon announces it. Copies are taken to be delivered independently, so their rates (1 / expected time)
    add up. At each opportunity the copy that shortens an expected delay most leaves first, as long as there is
    bandwidth. A full store drops the datum with the longest expected delay, age included, but no own one that has not
    arrived.

    The mark is the rate of the other copies. Unlike RAPID a node does not learn of copies that others have made since,
    and does not count the data that wait before this one.
    """

    __slots__ = ("_heard", "_interval", "_rates", "_via")

    def begin_life(self, now: float) -> None:
        self._heard: dict[int, float] = {}
        """When each node was met last, seconds."""
        self._interval: dict[int, float] = {}
        """Average time between two meetings, steps."""
        self._via: dict[int, float] = {}
        """What each node expected, steps; 0: a base."""
        self._rates: dict[DatumId, float] = {}
        """Rate at which copies elsewhere are delivered, 1/steps."""

    def begin(self, id: DatumId, mark: int | None) -> None:
        self._rates[id] = (mark or 0) / RATE_PARTS

    def end(self, id: DatumId) -> None:
        self._rates.pop(id, None)

    def hear(self, neighbour: Neighbour, now: float) -> None:
        id = neighbour.id
        since = (now - self._heard.get(id, now - self.settings.step_s)) / self.settings.step_s
        self._heard[id] = now
        self._interval[id] = since if id not in self._interval else (1 - GAIN) * self._interval[id] + GAIN * since
        self._via[id] = 0.0 if is_base(neighbour.beacon) else _expected(neighbour)

    def announce(self, now: float) -> int:
        if self.base:
            return 0
        step_s = self.settings.step_s
        expected = min(
            (max(self._interval[id], (now - heard) / step_s) + self._via[id] for id, heard in self._heard.items()),
            default=LONGEST,
        )
        return round(PARTS * min(expected, LONGEST))

    @property
    def _rate(self) -> float:
        """The rate of a copy here, 1/steps."""
        return PARTS / max(self.potential, 1)

    def order(self, ids: Iterable[DatumId], now: float) -> Iterable[DatumId]:
        """The datum that gains most first. 1/R - 1/(R + m) is the greater, the smaller the rate R of its copies."""
        return sorted(ids, key=self._rates.__getitem__)

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        return min(contacts, key=_expected, default=None)

    def mark(self, id: DatumId, neighbour: Neighbour) -> int:
        return min(round(RATE_PARTS * (self._rates[id] + self._rate)), 0xFFFF)

    def given(self, id: DatumId, neighbour: int, mark: int) -> bool:
        known = self.routing.neighbours.get(neighbour)
        if known is not None:
            self._rates[id] += 1.0 / max(_expected(known), 1.0)
        return False

    def victim(self) -> Holding | None:
        others = [holding for holding in self.holdings.custody.values() if holding.id.origin != self.id]
        rate, step_s = self._rate, self.settings.step_s
        return max(others, key=lambda h: 1.0 / (self._rates[h.id] + rate) - h.created / step_s, default=None)


def _expected(neighbour: Neighbour) -> float:
    """What a neighbour announces, steps."""
    return neighbour.beacon.potential / PARTS
