"""The ceilings: what an oracle would save that knows all places, links and levels of a run beforehand.

`Ceiling` keeps one copy of each datum and has no limit of bandwidth or capacity. Its data follow the order of events of
the mock swarm (docs/evaluation/simulation.md): a datum created in step t is struck for the first time in step t + 1,
and may then
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
average. One that keeps replicas, or moves data several hops a step, can.

`Contacts` bounds those too. Its oracle copies each datum to all nodes that it can reach over any number of hops, at
once and in each step, without any limit. So after step t either all nodes of a connected part of the swarm have a copy,
or none has. In step t + 1 each copy is struck independently, and the parts of step t + 1 in which a copy is left have
it everywhere. No protocol keeps more on average.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from random import Random
from typing import Any, NamedTuple

from rass_mav.agent.settings import DataSettings
from rass_mav.core.store import Store
from rass_mav.lab.swarm.world import World


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


class Recorder:
    """What all oracles know: the moments of a run, and the data that are due."""

    def __init__(self) -> None:
        self._moments: list[Moment] = []
        self._due: list[tuple[int, int]] = []
        """Step and node of each datum."""
        self._nodes = 0
        self._bases = 0
        self._seed = 0
        self._stores: list[Store] = []
        """Those of the step before."""

    def after(self, world: World) -> None:
        """Record the links, the levels and the failures of this step, and the drones that create data in it."""
        scenario = world.scenario
        step = world.t - 1
        self._nodes, self._bases, self._seed = scenario.nodes, scenario.bases, scenario.seed
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


class Ceiling(Recorder):
    """The measure: the share of all data that the oracle expects to keep.

    It counts the data that are due, not those that were created. So it is the same for all policies, even for one whose
    nodes are too full to create data.
    """

    def result(self) -> dict[str, Any]:
        """`data`: how many are due; `kept`: how many of them the oracle expects to keep."""
        table = survival(self._moments, self._nodes, self._bases)
        return {"data": len(self._due), "kept": sum(table[step + 1][node] for step, node in self._due)}


def parts(neighbours: Sequence[Sequence[int]], off: Collection[int]) -> list[int]:
    """The connected parts of a swarm, as masks with a bit for each node. A node that is off is a part of its own."""
    found = []
    seen: set[int] = set()
    for start in range(len(neighbours)):
        if start in seen:
            continue
        seen.add(start)
        mask, queue = 0, [start]
        while queue:
            node = queue.pop()
            mask |= 1 << node
            if node not in off:
                near = [other for other in neighbours[node] if other not in seen and other not in off]
                seen.update(near)
                queue += near
        found.append(mask)
    return found


def spread(
    moments: Sequence[Moment], begin: int, node: int, bases: int, swarm: Sequence[Sequence[int]], rng: Random
) -> bool:
    """Whether a datum that `node` creates in step `begin` arrives or is held at the end, with copies everywhere.

    `swarm`: the `parts` of each step.
    """
    base_mask = (1 << bases) - 1
    holders = 1 << node
    for t in range(begin, len(moments)):
        moment = moments[t]
        kept = 0
        for part in swarm[t]:
            here = holders & part
            if here and (t == begin or not _all_struck(here, moment, rng)):
                if part & base_mask:
                    return True
                kept |= part
        holders = kept
        if not holders:
            return False
    return True


def _all_struck(holders: int, moment: Moment, rng: Random) -> bool:
    """Whether radiation strikes all of these copies, or their drones have lost their stores."""
    chance = 1.0
    while holders:
        lowest = holders & -holders
        holders ^= lowest
        node = lowest.bit_length() - 1
        if node not in moment.emptied:
            chance *= moment.corruption[node]
            if not chance:
                return False
    return rng.random() < chance


class Contacts(Recorder):
    """The measure: how many of all data an oracle with all contacts keeps, in one draw of the strikes."""

    def result(self) -> dict[str, Any]:
        """`data`: how many are due; `kept`: how many of them it keeps."""
        rng = Random(f"{self._seed}:contacts")
        swarm = [parts(moment.neighbours, moment.off) for moment in self._moments]
        kept = sum(spread(self._moments, step, node, self._bases, swarm, rng) for step, node in self._due)
        return {"data": len(self._due), "kept": kept}
