"""PRoPHET, RFC 6693."""

from __future__ import annotations

from math import inf

from rass_mav.core.datum import DatumId
from rass_mav.core.routes.neighbours import Neighbour, is_base
from rass_mav.lab.baselines.common import Baseline

#: The constants of RFC 6693, figure 3.
P_ENCOUNTER_MAX = 0.7
P_ENCOUNTER_FIRST = 0.5
P_FIRST_THRESHOLD = 0.1
BETA = 0.9
GAMMA = 0.999
DELTA = 0.01
#: What the RFC leaves to the network: the usual time between two encounters (I_typ), and the unit of aging, in steps.
TYPICAL_STEPS = 1.0
AGING_STEPS = 0.02
#: A predictability on the wire is this many times as large, 16 bits.
SCALE = 65535
#: All bases are one destination.
BASES = -1


def met(old: float, interval: float) -> float:
    """P_(A,B) after an encounter, equation 1. `interval`: since the last encounter, as a part of the usual interval."""
    if old < P_FIRST_THRESHOLD:
        return P_ENCOUNTER_FIRST
    return old + (1.0 - DELTA - old) * P_ENCOUNTER_MAX * min(interval, 1.0)


def aged(old: float, units: float) -> float:
    """Any predictability after so many units of time without an encounter, equation 2."""
    return float(old * GAMMA**units)


def passed_on(old: float, to_neighbour: float, from_there: float) -> float:
    """P_(A,C) after an encounter with B, equation 3: P_(A,B) = `to_neighbour`, P_(B,C) = `from_there`."""
    return max(old, to_neighbour * from_there * BETA)


class Prophet(Baseline):
    """A. Lindgren, A. Doria, E. Davies and S. Grasic, Probabilistic Routing Protocol for Intermittently Connected
    Networks, RFC 6693, 2012.

    Each beacon is an encounter, and announces the predictability of the bases, which are one destination. A copy goes
    to the neighbour with the highest one, if it is higher than the own, and than those of all nodes that have received
    this datum from here (the forwarding strategy GRTR+). The own copy stays. A full store drops the oldest (FIFO).
    """

    __slots__ = ("_aged", "_highest", "_met_at", "predictability")

    def begin_life(self, now: float) -> None:
        self.predictability: dict[int, float] = {}
        """Of each neighbour, and of `BASES`."""
        self._met_at: dict[int, float] = {}
        """When each was met last, seconds."""
        self._aged = now
        self._highest: dict[DatumId, int] = {}
        """The highest predictability of those that have received a datum from here."""

    def end(self, id: DatumId) -> None:
        self._highest.pop(id, None)

    def hear(self, neighbour: Neighbour, now: float) -> None:
        known = self.predictability
        whom = BASES if is_base(neighbour.beacon) else neighbour.id
        interval = (now - self._met_at.get(whom, -inf)) / (TYPICAL_STEPS * self.settings.step_s)
        self._met_at[whom] = now
        known[whom] = met(known.get(whom, 0.0), interval)
        if whom != BASES:
            known[BASES] = passed_on(known.get(BASES, 0.0), known[whom], neighbour.beacon.potential / SCALE)

    def announce(self, now: float) -> int:
        units = (now - self._aged) / (AGING_STEPS * self.settings.step_s)
        self._aged = now
        self.predictability = {whom: aged(old, units) for whom, old in self.predictability.items()}
        return SCALE if self.base else round(SCALE * self.predictability.get(BASES, 0.0))

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        best = max(contacts, key=_announced, default=None)
        if best is None or _announced(best) <= max(self.potential, self._highest.get(id, 0)):
            return None
        return best

    def mark(self, id: DatumId, neighbour: Neighbour) -> int:
        return min(_announced(neighbour), SCALE)

    def given(self, id: DatumId, neighbour: int, mark: int) -> bool:
        self._highest[id] = max(mark, self._highest.get(id, 0))
        return False


def _announced(neighbour: Neighbour) -> int:
    return neighbour.beacon.potential
