"""Measurements of a running mock swarm, in addition to its summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.messages import NO_ROUTE
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.lab.experiment.located import Located
from rass_mav.lab.experiment.oracle import Ceiling, Contacts
from rass_mav.lab.experiment.schedule import Schedule
from rass_mav.lab.swarm.world import World

#: Steps between two samples of a time series, which also has the last step; the authors' curves are the same.
EVERY = 5
#: Distance of a datum that was created out of every base's reach.
OUT_OF_REACH = -1


class Series(msgspec.Struct):
    """Counts over time, one entry for each of `step`. Each datum counts once; `stored` counts copies."""

    step: list[int]
    created: list[int]
    """Since the beginning."""
    lost: list[int]
    """Since the beginning, except `vanished` (the authors do not count those)."""
    stored: list[int]
    """Items in the drones' stores."""
    base: list[int]
    """Distinct items at the bases."""


class Distance(msgspec.Struct, array_like=True):
    """Data created at one distance from the nearest base."""

    created: int = 0
    arrived: int = 0
    lost: int = 0
    """Except `vanished`."""
    delay_sum: int = 0
    """Steps from creation to arrival, summed over those that arrived."""


def is_sample(step: int, steps: int) -> bool:
    """Whether a time series contains this step of a run of `steps` steps (0 .. steps - 1)."""
    return step % EVERY == 0 or step == steps - 1


class SeriesMeasure:
    """The time series of the paper's figures."""

    def __init__(self) -> None:
        self.series = Series([], [], [], [], [])

    def after(self, world: World) -> None:
        """Record the figures of a completed step."""
        step = world.t - 1
        if not is_sample(step, world.scenario.steps):
            return
        ledger = world.ledger
        lost = ledger.losses()
        series = self.series
        series.step.append(step)
        series.created.append(ledger.created)
        series.lost.append(sum(lost.values()) - lost[Fate.VANISHED.value])
        series.stored.append(ledger.stored)
        stores = world.stores[: world.scenario.bases]
        series.base.append(len({id for store in stores for id in store.ids()}))


class DistanceMeasure:
    """What became of data by the distance at which they were created: hops to the nearest base in the graph of
    ranges."""

    def __init__(self) -> None:
        self._hops: list[list[int | None]] = []

    def after(self, world: World) -> None:
        """Record the distances of this step."""
        self._hops.append(world.graph.hops_from(range(world.scenario.bases)))

    def result(self, world: World) -> dict[int, Distance]:
        """By hops, or `OUT_OF_REACH`. Measurements that a full node refused never got an id and are not included."""
        ledger = world.ledger
        found: dict[int, Distance] = {}
        for id, step in ledger.born.items():
            hops = self._hops[step][id.origin]
            distance = found.setdefault(OUT_OF_REACH if hops is None else hops, Distance())
            distance.created += 1
            arrived = ledger.arrived.get(id)
            if arrived is not None:
                distance.arrived += 1
                distance.delay_sum += arrived - step
            elif ledger.lost.get(id, Fate.VANISHED) is not Fate.VANISHED:
                distance.lost += 1
        return dict(sorted(found.items()))


class Watcher(Protocol):
    """An observer of a swarm."""

    def after(self, world: World) -> None:
        """Called after each step."""


class Measure(Watcher, Protocol):
    """A measurement that only some experiments use."""

    def result(self) -> dict[str, Any]:
        """Plain values, at the end."""


class Origins:
    """Created and lost data by origin, over time: step, then for each node a list of each.

    Measurements that a full node refused are not included; `vanished` data do not count as lost.
    """

    def __init__(self) -> None:
        self._steps: list[int] = []
        self._created: dict[str, list[int]] = {}
        self._lost: dict[str, list[int]] = {}

    def after(self, world: World) -> None:
        """Count, at the steps of the time series."""
        step = world.t - 1
        if not is_sample(step, world.scenario.steps):
            return
        ledger = world.ledger
        created = Counter(id.origin for id in ledger.born)
        lost = Counter(id.origin for id, fate in ledger.lost.items() if fate is not Fate.VANISHED)
        self._steps.append(step)
        for node in range(world.scenario.bases, world.scenario.nodes):
            self._created.setdefault(str(node), []).append(created[node])
            self._lost.setdefault(str(node), []).append(lost[node])

    def result(self) -> dict[str, Any]:
        """Lists of equal length."""
        return {"step": self._steps, "created": self._created, "lost": self._lost}


class Basins:
    """How many data are where the potential has a local maximum away from the base.

    A node is a basin if it knows a route to a base, and has neighbours, none of them a base and none fitter by Eq. 4 (T
    phi < phi_j). Basins are counted after each step, when the air is quiet, from the potentials that all nodes have
    just announced. A node is a `lasting` one if it would be a basin without the sensor's noise: with Eq. 3 of the true
    risk. A corrupted datum is counted where it was when it was struck: at the end of the step before.
    """

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._corrupted: list[int] = []
        self._announced: list[bool] = []
        self._lasting: list[bool] = []

    def after(self, world: World) -> None:
        """Count this step."""
        counts = self._counts
        scenario = world.scenario
        drones = range(scenario.bases, scenario.nodes)
        corrupted = [store.counters().get(Fate.CORRUPTED.value, 0) for store in world.stores]
        if self._corrupted:
            for node in drones:
                struck = corrupted[node] - self._corrupted[node]
                if struck:
                    counts["corrupted"] += struck
                    counts["corrupted_in_basins"] += struck * self._announced[node]
                    counts["corrupted_in_lasting"] += struck * self._lasting[node]
        self._corrupted = corrupted
        nodes = [agent.node for agent in world.agents]
        self._announced = self._basins(world, [node.potential for node in nodes])
        levels = world.surroundings.levels
        self._lasting = self._basins(
            world,
            [
                POTENTIAL_BASE
                if node.sink
                else node.policy.potential(node.routing.distance, min(levels[i], 1.0), node.holdings.free())
                for i, node in enumerate(nodes)
            ],
        )
        counts["node_steps"] += len(drones)
        for node in drones:
            held = len(nodes[node].holdings.custody)
            counts["stored"] += held
            if self._announced[node]:
                counts["basins"] += 1
                counts["stored_in_basins"] += held
            if self._lasting[node]:
                counts["lasting"] += 1
                counts["stored_in_lasting"] += held

    def _basins(self, world: World, potentials: list[int]) -> list[bool]:
        bases = world.scenario.bases
        given = world.scenario.policy.threshold
        threshold = 1.0 if given is None else given
        result = []
        for node, near in enumerate(world.neighbours):
            # Before the first announcements have come through, all are equally fit: that is no maximum.
            informed = world.agents[node].node.routing.distance != NO_ROUTE
            fit = node >= bases and informed and len(near) > 0 and all(n >= bases for n in near)
            result.append(fit and max(potentials[n] for n in near) <= threshold * potentials[node])
        return result

    def result(self) -> dict[str, Any]:
        """Sums over steps: node_steps, basins, lasting; items stored, stored_in_*; data corrupted, corrupted_in_*."""
        keys = (
            "node_steps", "basins", "lasting", "stored", "stored_in_basins", "stored_in_lasting", "corrupted",
            "corrupted_in_basins", "corrupted_in_lasting",
        )  # fmt: skip
        return {key: self._counts[key] for key in keys}


class Cohorts:
    """What became of the data created in each step. Measurements that a full node refused are not included."""

    def __init__(self) -> None:
        self._born: dict[DatumId, int] = {}
        self._arrived: dict[DatumId, int] = {}

    def after(self, world: World) -> None:
        """The ledger knows it all at the end."""
        self._born, self._arrived = world.ledger.born, world.ledger.arrived

    def result(self) -> dict[str, Any]:
        """For each step in which data were created: how many these are, how many arrived, and the sum of the delays of
        those, in steps."""
        found: dict[str, list[int]] = {}
        for id, step in self._born.items():
            cohort = found.setdefault(str(step), [0, 0, 0])
            cohort[0] += 1
            if id in self._arrived:
                cohort[1] += 1
                cohort[2] += self._arrived[id] - step
        return found


#: By the names that a `Run` uses.
MEASURES: dict[str, Callable[[], Measure]] = {
    "origins": Origins,
    "basins": Basins,
    "ceiling": Ceiling,
    "contacts": Contacts,
    "schedule": Schedule,
    "cohorts": Cohorts,
    "sources": Located,
}
