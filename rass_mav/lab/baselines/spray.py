"""Spray and wait, and spray and focus: a bounded number of copies."""

from __future__ import annotations

from rass_mav.core.datum import DatumId
from rass_mav.core.routes.neighbours import Neighbour, is_base
from rass_mav.lab.baselines.common import Baseline

#: Copies of each datum (L in the papers).
COPIES = 8
#: A timer in a beacon, steps: a base was met this long ago, or longer.
NEVER = 0xFFFF
#: How much more recently, in steps, a neighbour must have met a base to receive the last copy (U_th in the paper).
THRESHOLD = 0.5


class SprayAndWait(Baseline):
    """T. Spyropoulos, K. Psounis and C. S. Raghavendra, Spray and Wait, ACM SIGCOMM workshop on delay-tolerant
    networking, 2005, in its binary form: the origin has L tokens. A node with n > 1 of them gives half, rounded down,
    to any node without a copy. A node with one token keeps its copy until it meets a base. A full store drops the
    oldest.

    The mark is the number of tokens given. Tokens whose copy is lost are lost too, and after a reboot one is left. So
    there are never more than L, unless the air loses an answer.
    """

    __slots__ = ("tokens",)

    def begin_life(self, now: float) -> None:
        self.tokens: dict[DatumId, int] = {}
        """Of each datum that is here."""

    def begin(self, id: DatumId, mark: int | None) -> None:
        self.tokens[id] = COPIES if mark is None else max(mark, 1)

    def end(self, id: DatumId) -> None:
        self.tokens.pop(id, None)

    def mark(self, id: DatumId, neighbour: Neighbour) -> int:
        return self.tokens[id] // 2

    def given(self, id: DatumId, neighbour: int, mark: int) -> bool:
        self.tokens[id] -= mark
        return not mark

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        if self.tokens[id] < 2 or not contacts:
            return None
        return contacts[self.rng.randrange(len(contacts))]


class SprayAndFocus(SprayAndWait):
    """T. Spyropoulos, K. Psounis and C. S. Raghavendra, Spray and Focus, IEEE PerCom workshops, 2007: the same spray,
    but a last token moves on, to a neighbour that has met a base more recently.

    Each node has a timer: the steps since it met a base, itself or through others. A node that meets a neighbour with
    a smaller timer sets its own to that plus the time it takes to get there, one step. The beacon announces the timer.
    In the paper copies are sprayed to whoever comes first; here to the neighbour with the smallest timer, which favours
    it.
    """

    __slots__ = ("_met_at",)

    def begin_life(self, now: float) -> None:
        super().begin_life(now)
        self._met_at: float | None = None
        """When a base was met, as far as the timer knows, seconds."""

    def hear(self, neighbour: Neighbour, now: float) -> None:
        if is_base(neighbour.beacon):
            self._met_at = now
        elif neighbour.beacon.potential != NEVER:
            met_at = now - (neighbour.beacon.potential + 1) * self.settings.step_s
            if self._met_at is None or met_at > self._met_at:
                self._met_at = met_at

    def announce(self, now: float) -> int:
        if self.base:
            return 0
        if self._met_at is None:
            return NEVER
        return min(round((now - self._met_at) / self.settings.step_s), NEVER - 1)

    def choose(self, id: DatumId, contacts: list[Neighbour], now: float) -> Neighbour | None:
        best = min(contacts, key=_timer, default=None)
        if best is None or self.tokens[id] > 1:
            return best
        return best if _timer(best) < self.potential - THRESHOLD else None


def _timer(neighbour: Neighbour) -> int:
    return neighbour.beacon.potential
