"""The ceiling: what an oracle would save that knows all places, links and levels of a run beforehand.

It keeps one copy of each datum and has no limit of bandwidth or capacity. Its data follow the order of events of the
mock swarm (docs/simulation.md): a datum created in step t is struck for the first time in step t + 1, and may then
stay, or go one hop over a link of step t + 1. So a datum created h hops from the base is struck at least h times. Data
held at the end count as kept, as they do in a run's reliability.

Let S_t(i) be the chance that a datum which is at drone i when step t begins is not lost before the end, q_i(t) the
probability of Eq. 2 at i, and N_i(t) the nodes in i's range in step t:

    S_T(i) = 1                                                              when step T - 1, the last, is over
    S_t(i) = (1 - q_i(t)) max(S_{t+1}(i), max of S_{t+1}(j) over j in N_i(t))
    S_t(base) = 1

A drone that is off neither sends nor hears: its data stay. When it dies for good, or is wiped, in step t: S_t(i) = 0.

This is a dynamic program, backwards in time. Where nothing moves and the end is far away it is Dijkstra's shortest path
with the weights -log(1 - q_i). A policy that keeps one copy and moves it at most one hop a step cannot be better on
average. One that keeps spare copies, or moves data several hops a step, can.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

from rass_mav.agent.settings import DataSettings
from rass_mav.core.store import Store
from rass_mav.swarm.world import World


class Moment(NamedTuple):
    """What the oracle knows of a step."""

    neighbours: Sequence[Sequence[int]]
    """For each node the ids in its range."""
    corruption: Sequence[float]
    """For each node the probability 0..1 that a datum in its store is struck."""
    off: Collection[int] = ()
    """Nodes that are off: they neither send nor hear."""
    emptied: Collection[int] = ()
    """Nodes that lost their store when the step began: they died for good, or were wiped."""


def survival(moments: Sequence[Moment], nodes: int, bases: int) -> list[list[float]]:
    """S_t(i) of the module's docstring as [t][i], t = 0 .. T.

    `moments`: steps 0 .. T - 1. The nodes 0 .. bases - 1 are bases.
    """
    later = [1.0] * nodes
    table = [later]
    for neighbours, corruption, off, emptied in reversed(moments):
        now = [1.0] * nodes
        for node in range(bases, nodes):
            near: Iterable[int] = neighbours[node]
            if off:
                near = () if node in off else (other for other in near if other not in off)
            best = max(map(later.__getitem__, near), default=0.0)
            now[node] = 0.0 if node in emptied else (1.0 - corruption[node]) * max(best, later[node])
        table.append(now)
        later = now
    table.reverse()
    return table


def is_due(data: DataSettings, node: int, step: int) -> bool:
    """Whether a drone that is on creates a datum in this step."""
    if not data.interval_steps or (data.until_step is not None and step >= data.until_step):
        return False
    phase = {"step-id": node, "step+id": -node, "together": 0}[data.due]
    return (step - phase) % data.interval_steps == 0


class Ceiling:
    """The measure: the share of all data that the oracle expects to keep.

    It counts the data that are due, not those that were created. So it is the same for all policies, even for one whose
    nodes are too full to create data.
    """

    def __init__(self) -> None:
        self._moments: list[Moment] = []
        self._due: list[tuple[int, int]] = []
        """Step and node of each datum."""
        self._nodes = 0
        self._bases = 0
        self._stores: list[Store] = []
        """Those of the step before."""

    def after(self, world: World) -> None:
        """Record the links, the levels and the failures of this step, and the drones that create data in it."""
        scenario = world.scenario
        step = world.t - 1
        self._nodes, self._bases = scenario.nodes, scenario.bases
        drones = range(scenario.bases, scenario.nodes)
        off: frozenset[int] = frozenset()
        emptied: frozenset[int] = frozenset()
        if world.failures is not None:
            off = frozenset(world.off)
            # In the first step there is nothing to lose yet.
            if self._stores:
                emptied = frozenset(node for node in drones if world.stores[node] is not self._stores[node])
            self._stores = world.stores[:]
        corruption = world.surroundings.corruption if scenario.radiation.corruption else [0.0] * scenario.nodes
        self._moments.append(Moment(world.neighbours, corruption, off, emptied))
        self._due += ((step, node) for node in drones if node not in off and is_due(scenario.data, node, step))

    def result(self) -> dict[str, Any]:
        """`data`: how many are due; `kept`: how many of them the oracle expects to keep."""
        table = survival(self._moments, self._nodes, self._bases)
        return {"data": len(self._due), "kept": sum(table[step + 1][node] for step, node in self._due)}
