"""What an oracle delivers that knows all contacts, levels and failures beforehand, and for which airtime counts.

It keeps up to `COPIES` copies of each datum, sends them over any number of hops in a step, and says when each frame is
sent. It plans in the order of events of the mock swarm (docs/evaluation/simulation.md). Let V_t(P) be the chance that
one copy is
not lost before the end if it is anywhere in P, a connected part of the swarm, when step t is over. q_i(t) is the
probability of Eq. 2.

    V_t(P) = 1                                                         with a base in P, or when the last step is over
    V_t(P) = max over i in P of (1 - q_i(t + 1)) V_{t + 1}(part of i)  otherwise

So a datum goes to the base if it can. Otherwise its copies rest where this is largest, or almost: then they stay.

A hand-over is a Data frame and its answer, alone in their datagrams. It takes the air of both nodes and of all in their
range, as no hidden node may send meanwhile. A hop is possible in a step while the loads of its two nodes leave room for
the whole way: then all hops of the step can be put in a row in which none disturbs another. What finds no room waits.

This schedule can be carried out, so the best protocol delivers at least as much; `Contacts` bounds it from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from random import Random
from typing import Any

from rass_mav.lab.experiment.oracle import Moment, Recorder, parts
from rass_mav.lab.medium.capacity import hand_over_s
from rass_mav.lab.swarm.world import World

#: Copies of a datum that rests.
COPIES = 3
#: A copy moves to a node where it rests better than at this share of the best.
WORTH = 0.9
#: A measurement, bytes of payload.
_SIZE = 20
#: Of the hops of a way, itself included, so many at most disturb one of them: it is the shortest way, so no others have
#: a node in range of that hop's two.
_OF_A_WAY = 5
#: A step more counts as little, so that of ways that are equally safe the one is taken that arrives sooner.
_SOONER = 1.0 - 1e-9


class Air:
    """Who sends in one step."""

    def __init__(self, near: Sequence[Sequence[int]], hop_s: float, step_s: float) -> None:
        self._near = near
        self._hop_s = hop_s
        self._free_s = step_s - _OF_A_WAY * hop_s
        self.load_s = [0.0] * len(near)
        """Airtime taken at each node, seconds."""

    def ways(self, start: int) -> dict[int, int]:
        """For each node that can be reached from this one, the one before it, by the fewest hops; the nearest first."""
        before, queue, load_s = {start: start}, [start], self.load_s
        for node in queue:
            for other in self._near[node]:
                if other not in before and load_s[node] + load_s[other] <= self._free_s:
                    before[other] = node
                    queue.append(other)
        return before

    def take(self, before: dict[int, int], end: int) -> int:
        """Send a datum along a way. Returns the number of hops."""
        hops = 0
        while (node := before[end]) != end:
            for other in {node, end, *self._near[node], *self._near[end]}:
                self.load_s[other] += self._hop_s
            end, hops = node, hops + 1
        return hops


class Schedule(Recorder):
    """The measure."""

    def __init__(self) -> None:
        super().__init__()
        self._hop_s = self._step_s = 0.0

    def after(self, world: World) -> None:
        """Record a step."""
        super().after(world)
        radio = world.scenario.radio
        self._step_s = world.step_s
        self._hop_s = hand_over_s(radio, _SIZE) if radio.takes_time else 0.0

    def result(self) -> dict[str, Any]:
        """`data`: how many are due; `kept` and `delivered`: how many of them it expects to keep and to deliver; `sent`:
        hand-overs; `busiest`: the largest share of a step for which the air at a node is taken."""
        moments, bases = self._moments, self._bases
        rng, shelters = Random(f"{self._seed}:schedule"), self._shelters()
        born: dict[int, list[int]] = {}
        for step, node in self._due:
            born.setdefault(step, []).append(node)
        waiting: list[set[int]] = []
        delivered = sent = 0
        busiest = 0.0
        for t, moment in enumerate(moments):
            waiting = [{node for node in copies if rng.random() < _survives(moment, node)} for copies in waiting]
            waiting = [copies for copies in waiting if copies] + [{node} for node in born.get(t, ())]
            off = moment.off
            near = [() if n in off else [m for m in near if m not in off] for n, near in enumerate(moment.neighbours)]
            air = Air(near, self._hop_s, self._step_s)
            left: list[set[int]] = []
            for copies in waiting:
                hops, arrived = _move(copies, air, shelters[t], bases)
                sent += hops
                delivered += arrived
                if not arrived:
                    left.append(copies)
            busiest = max(busiest, *air.load_s)
            waiting = left
        share = busiest / self._step_s if self._step_s else 0.0
        kept = delivered + len(waiting)
        return {"data": len(self._due), "kept": kept, "delivered": delivered, "sent": sent, "busiest": share}

    def _shelters(self) -> list[list[float]]:
        """(1 - q_i(t + 1)) V_{t + 1}(part of i) as [t][i]: how good it is to rest at a node when step t is over."""
        nodes, later = range(self._nodes), [_SOONER] * self._nodes
        table = [later]
        for t in range(len(self._moments) - 1, 0, -1):
            moment, now = self._moments[t], [0.0] * self._nodes
            for part in parts(moment.neighbours, moment.off):
                inside = [node for node in nodes if part >> node & 1]
                best = 1.0 if inside[0] < self._bases else max(map(later.__getitem__, inside))
                for node in inside:
                    now[node] = best * _survives(moment, node) * _SOONER
            table.append(now)
            later = now
        table.reverse()
        return table


def _move(copies: set[int], air: Air, shelter: Sequence[float], bases: int) -> tuple[int, bool]:
    """Send the copies of a datum where they should be when the step is over. Returns the hops, and whether it has
    arrived."""
    ways = {node: air.ways(node) for node in copies}
    for before in ways.values():
        if (base := next((node for node in before if node < bases), None)) is not None:
            return air.take(before, base), True
    hops = 0
    reached = set().union(*ways.values())
    best = max(map(shelter.__getitem__, reached))
    good = [node for node in copies if shelter[node] >= WORTH * best]
    others = sorted(reached - copies, key=shelter.__getitem__, reverse=True)
    for node in others[: COPIES - len(good)]:
        if shelter[node] < WORTH * best:
            break
        # The copies before it have taken airtime.
        before = air.ways(next(start for start, before in ways.items() if node in before))
        if node in before:
            hops += air.take(before, node)
            good.append(node)
    if good:
        copies.clear()
        copies.update(good)
    return hops, False


def _survives(moment: Moment, node: int) -> float:
    return 0.0 if node in moment.emptied else 1.0 - moment.corruption[node]
