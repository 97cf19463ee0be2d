"""Epidemic routing with receipts."""

from __future__ import annotations

from collections.abc import Iterable

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BROADCAST, Data, Handover, Message
from rass_mav.lab.baselines.common import Baseline

#: Steps after which a datum is broadcast again if a neighbour has still not reported it; doubled each time.
REPEAT_STEPS = 2


class Epidemic(Baseline):
    """A. Vahdat and D. Becker, Epidemic Routing for Partially-Connected Ad Hoc Networks, Duke University CS-2000-06,
    2000: neighbours compare summary vectors, and every node gets a copy of what it lacks. A full store drops the
    oldest. Receipts end copies (VACCINE in X. Zhang, G. Neglia, J. Kurose and D. Towsley, Performance Modeling of
    Epidemic Routing, Computer Networks 51, 2007).

    The paper sends a copy to one neighbour at a time. Here one broadcast serves all neighbours that lack a datum, which
    favours it. Nobody answers: who has it by now is in the next summary vectors.
    """

    __slots__ = ("_said",)

    def begin_life(self, now: float) -> None:
        self._said: dict[DatumId, tuple[float, int]] = {}
        """When a datum may be broadcast again, seconds, and how often it has been."""

    def end(self, id: DatumId) -> None:
        self._said.pop(id, None)

    def _send(self, ids: Iterable[DatumId], now: float, out: list[Message]) -> None:
        handovers = []
        for id in ids:
            if self.pace.left <= 0:
                break
            again, times = self._said.get(id, (now, 0))
            if now < again:
                continue
            known = self.where.get(id, ())
            if all(n.id in known for n in self._live) or (datum := self._load(id)) is None:
                continue
            self.pace.spend()
            handovers.append(Handover(0, datum))
            self._said[id] = (now + REPEAT_STEPS * (1 << times) * self.settings.step_s, times + 1)
            # The broadcast itself tells the neighbours.
            self._gained.pop(id, None)
        if handovers:
            out.append(Data(self.id, BROADCAST, tuple(handovers)))
