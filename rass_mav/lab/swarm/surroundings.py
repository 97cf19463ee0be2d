"""The surroundings of a mock swarm, step by step: where the nodes are, which of them hear each other, the radiation."""

from __future__ import annotations

import math
import random

from rass_mav.lab.medium.neighbours import Position, RangeGraph
from rass_mav.lab.swarm.authors import make_authors_mobility
from rass_mav.lab.swarm.mobility import Mobility, make_mobility
from rass_mav.lab.swarm.radiation import (
    Counter,
    DoseField,
    RadiationField,
    Source,
    random_sources,
    random_strong_sources,
)
from rass_mav.lab.swarm.scenario import Scenario
from rass_mav.sensor.dose import TUBES


class Surroundings:
    """Places, links and levels of a scenario. The same seed gives the same ones in any process."""

    def __init__(self, scenario: Scenario) -> None:
        """At step 0. Raises `ConfigError` for a swarm that cannot be placed."""
        seed = scenario.seed
        # One generator for each purpose: the draws of one part do not disturb the others. Seeding with a text is the
        # same in every process.
        self.mobility = _mobility(scenario, random.Random(f"{seed}:places"))
        radiation = scenario.radiation
        self.field = _field(scenario, random.Random(f"{seed}:field"))
        cylinders = [(x, y) for x, y, _ in radiation.cylinders_of(seed)] if radiation.cylinder_m else []
        self.graph = RangeGraph(self.mobility.positions, scenario.radio.range_m, cylinders, radiation.cylinder_m)
        self._round_m = radiation.round_m
        self.levels: list[float] = []
        """Radiation at each node without the sensor's noise: Eq. 1, or the dose rate in uSv/h."""
        self.corruption: list[float] = []
        """Probability that a datum at each node is struck in a step, Eq. 2, or that one of its pages is."""
        self.t = 0
        """The present step."""
        self.mobility.step(0)
        self._measure()

        self._counter: Counter | None = None
        if radiation.law == "dose":
            self._counter = Counter(TUBES[radiation.tube], scenario.node.step_s)
        self._noise = radiation.noise

    def reading(self, node: int, rng: random.Random) -> float:
        """What the sensor of a node reads now: Eq. 1 with its noise, or what a Geiger counter gives, in uSv/h."""
        if self._counter is not None:
            return self._counter.reading(self.levels[node], rng)
        return self.levels[node] + rng.gauss(0.0, self._noise)

    @property
    def positions(self) -> list[Position]:
        """Of each node, metres east and north of the arena's centre."""
        return self.mobility.positions

    def step(self) -> None:
        """Advance to the next step."""
        self.t += 1
        moved = self.mobility.step(self.t)
        if moved:
            self.graph.update(self.mobility.positions)
        if self.field.step() or moved:
            self._measure()

    def _measure(self) -> None:
        positions = self.mobility.positions
        if self._round_m:
            grain = self._round_m
            positions = [
                (grain * math.floor(x / grain + 0.5), grain * math.floor(y / grain + 0.5)) for x, y in positions
            ]
        self.levels = [self.field.level(x, y) for x, y in positions]
        self.corruption = [self.field.corruption(x, y) for x, y in positions]


def _field(scenario: Scenario, rng: random.Random) -> RadiationField:
    about, bounds = scenario.radiation, scenario.arena / 2
    given = about.sources_of(scenario.seed)
    if given is not None:
        sources = [Source(*source) for source in given]
    elif about.law == "dose":
        sources = random_strong_sources(rng, about.random_sources, about.spread_m, about.strength)
    else:
        sources = random_sources(rng, about.random_sources, about.spread_m)
    if about.law == "dose":
        return DoseField(
            sources, background=about.background, height_m=about.height_m, page_dose=about.page_dose,
            step_s=scenario.node.step_s, drift=about.drift, rng=rng, bounds=bounds,
        )  # fmt: skip
    return RadiationField(sources, decay=about.decay, drift=about.drift, rng=rng, bounds=bounds)


def _mobility(scenario: Scenario, rng: random.Random) -> Mobility:
    if scenario.mobility.layout == "authors":
        return make_authors_mobility(scenario.topology, scenario.nodes, rng)
    about, step_s = scenario.mobility, scenario.node.step_s
    return make_mobility(
        scenario.topology, nodes=scenario.nodes, bases=scenario.bases, range_m=scenario.radio.range_m,
        arena_m=scenario.arena, rng=rng, pitch_m=about.pitch_m, split_step=about.split_step,
        rejoin_step=about.rejoin_step, gap_m=about.gap_m, positions=about.positions, area_m=about.area_m,
        strip_m=about.strip_m, speed_m=(step_s * about.speed_m_s[0], step_s * about.speed_m_s[1]),
        base_speed_m=step_s * about.base_speed_m_s, even_bases=about.bases == "even",
    )  # fmt: skip
