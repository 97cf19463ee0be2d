"""The radiation field of the mock swarm: what a sensor reads (Eq. 1) and what it does to stored data (Eq. 2).

Sources are points. At distance d source j adds I_j / (1 + lambda d^2), with intensity I_j and decay lambda in 1/m^2.
Equation numbers are those of the paper (arXiv 2201.01349).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from random import Random
from typing import NamedTuple

from rass_mav.errors import ConfigError
from rass_mav.sensor.dose import DoseMeter, Tube


class Source(NamedTuple):
    """A point source of radiation."""

    x: float
    """Metres from the arena's centre."""
    y: float
    """Metres from the arena's centre."""
    intensity: float
    """Radiation level at the source itself, >= 0 without unit; 1 corrupts every datum there in one step."""


class Threshold(NamedTuple):
    """The authors' rule of corruption: a datum is struck when a tolerance drawn for it is below the drone's risk.

    Tolerances are uniform in low..high, so a risk of at most `low - jitter` is perfectly safe, and one of at least
    `high + jitter` strikes everything. Source: the authors' code (docs/evaluation/reproduction.md).
    """

    low: float
    high: float
    jitter: float
    """Added to the risk, uniform in +-jitter, once for each drone and step."""

    def probability(self, level: float, rng: Random) -> float:
        """Probability 0..1 that a datum is struck in this step, at this level (clipped to a risk of 0..1)."""
        risk = min(max(level, 0.0), 1.0) + rng.uniform(-self.jitter, self.jitter)
        return min(max((risk - self.low) / (self.high - self.low), 0.0), 1.0)


def random_sources(rng: Random, n: int = 3, spread_m: float = 3.5) -> list[Source]:
    """The paper's sources: `n` of them, x and y uniform in +-spread_m metres, intensity uniform in 0..1."""

    def axis() -> float:
        return rng.uniform(-spread_m, spread_m)

    return [Source(axis(), axis(), rng.uniform(0.0, 1.0)) for _ in range(n)]


class RadiationField:
    """The sum of some sources, which may drift."""

    sources: list[Source]
    """The sources where they are now."""

    def __init__(
        self,
        sources: Iterable[Source],
        *,
        decay: float = 1.0,
        drift: float = 0.0,
        rng: Random | None = None,
        bounds: float = 10.0,
    ) -> None:
        """Create a field.

        `decay` is lambda of Eq. 1, >= 0, in 1/m^2. `drift` is how far each source moves in a step, 0 to 2 `bounds`, in
        metres; above 0 it needs `rng`, and the sources do not leave the square of +-`bounds` metres.

        Raises `ConfigError` for a number out of range, and `ValueError` if the generator is missing.
        """
        self.sources = list(sources)
        self.decay = decay
        self.drift = drift
        self.bounds = bounds
        self._rng = rng
        if not (math.isfinite(decay) and decay >= 0):
            raise ConfigError(f"radiation.decay: expected a number >= 0, got {decay!r}")
        if not 0 <= drift <= 2 * bounds:
            raise ConfigError(f"radiation.drift: expected 0..{2 * bounds:g} m a step, got {drift!r}")
        for i, source in enumerate(self.sources):
            if not all(math.isfinite(value) for value in source) or source.intensity < 0:
                raise ConfigError(f"radiation.sources[{i}]: expected x, y and an intensity >= 0, got {list(source)!r}")
        if drift and rng is None:
            raise ValueError("a drifting field needs a random generator")

    @property
    def moves(self) -> bool:
        """Whether `step` changes anything."""
        return self.drift > 0 and bool(self.sources)

    def level(self, x: float, y: float) -> float:
        """Eq. 1 without its noise b: the level at (x, y) metres, >= 0, not clipped."""
        return sum(self._parts(x, y))

    def corruption(self, x: float, y: float) -> float:
        """Eq. 2: the probability 0..1 that a datum stored at (x, y) metres is corrupted in one step.

        1 - prod(1 - clip(I_j / (1 + lambda d_j^2), 0, 1)): the sources strike independently of each other.
        """
        survival = 1.0
        for part in self._parts(x, y):
            survival *= 1.0 - min(part, 1.0)
        return 1.0 - survival

    def step(self) -> bool:
        """Let every source drift: `drift` metres in a new uniform direction, mirrored at the walls. True if any moved.

        With a new heading in each step a source does a random walk; after n steps it is about drift sqrt(n) away. A
        source that starts beyond a wall only moves inwards, and stays once it is inside.
        """
        if not self.moves or self._rng is None:
            return False
        moved = []
        for source in self.sources:
            heading = self._rng.uniform(0.0, 2 * math.pi)
            x = _moved(source.x, self.drift * math.cos(heading), self.bounds)
            y = _moved(source.y, self.drift * math.sin(heading), self.bounds)
            moved.append(Source(x, y, source.intensity))
        self.sources = moved
        return True

    def _parts(self, x: float, y: float) -> list[float]:
        decay = self.decay
        return [i / (1.0 + decay * ((sx - x) * (sx - x) + (sy - y) * (sy - y))) for sx, sy, i in self.sources]


def _moved(coordinate: float, by: float, wall: float) -> float:
    """One axis of a step: mirrored at the walls, inwards from beyond them."""
    if abs(coordinate) > wall:
        return coordinate - math.copysign(by, coordinate)
    there = coordinate + by
    if abs(there) > wall:
        return math.copysign(2 * wall, there) - there
    return there


_HOUR_S = 3600.0
# Up to this many pulses are drawn one by one. With more, their number is very nearly normal.
_PULSES = 100


def random_strong_sources(rng: Random, n: int, spread_m: float, strength: tuple[float, float]) -> list[Source]:
    """`n` sources, x and y uniform in +-spread_m metres, the logarithm of the strength uniform.

    `strength`: the least and the greatest dose rate 1 m from a source, uSv/h, > 0.
    """
    low, high = (math.log(bound) for bound in strength)
    return [
        Source(rng.uniform(-spread_m, spread_m), rng.uniform(-spread_m, spread_m), math.exp(rng.uniform(low, high)))
        for _ in range(n)
    ]


class DoseField(RadiationField):
    """Point sources on the ground under drones at one height. A source's intensity is the dose rate 1 m from it, in
    uSv/h, and falls with the square of the distance. docs/evaluation/simulation.md states the laws, and where their
    numbers come from.
    """

    def __init__(
        self,
        sources: Iterable[Source],
        *,
        background: float,
        height_m: float,
        page_dose: float,
        step_s: float,
        drift: float = 0.0,
        rng: Random | None = None,
        bounds: float = 10.0,
    ) -> None:
        """See `RadiationField`.

        :param background: dose rate without sources, uSv/h, >= 0.
        :param height_m: of the drones above the sources, metres, > 0.
        :param page_dose: the mean dose at which a page of memory is lost, uSv, > 0.
        """
        super().__init__(sources, drift=drift, rng=rng, bounds=bounds)
        self._background = background
        self._height2 = height_m * height_m
        self._pages_per_rate = step_s / _HOUR_S / page_dose

    def level(self, x: float, y: float) -> float:
        """Dose rate above (x, y) metres, uSv/h, at least the background."""
        height2 = self._height2
        return self._background + sum(
            strength / ((sx - x) * (sx - x) + (sy - y) * (sy - y) + height2) for sx, sy, strength in self.sources
        )

    def corruption(self, x: float, y: float) -> float:
        """The probability 0..1 that a page of memory above (x, y) metres is lost in one step."""
        return -math.expm1(-self.level(x, y) * self._pages_per_rate)


class Counter:
    """A Geiger counter that counts for a time, corrects its dead time and gives the dose rate.

    Pulses come at random (a Poisson process). After each the tube is dead for a fixed time, which pulses that come
    meanwhile do not prolong (non-paralysable).
    """

    def __init__(self, tube: Tube, interval_s: float) -> None:
        """`interval_s`: how long it counts for a reading, seconds, > 0."""
        self._meter = DoseMeter(tube)
        self._interval_s = interval_s
        self._dead_s = tube.dead_time_us / 1e6
        self._rate_per_level = tube.cpm_per_usvh / 60.0

    def reading(self, level: float, rng: Random) -> float:
        """What it reads, uSv/h, where the dose rate is `level` uSv/h, >= 0."""
        return self._meter.reading(60.0 / self._interval_s * self.counts(level, rng))

    def counts(self, level: float, rng: Random) -> int:
        """How many pulses it counts for one reading."""
        rate, interval, dead = self._rate_per_level * level, self._interval_s, self._dead_s
        if rate <= 0.0:
            return 0
        # Of a renewal process: the mean gap is dead + 1 / rate, its standard deviation 1 / rate.
        live = 1.0 / (1.0 + rate * dead)
        mean = rate * interval * live
        if mean > _PULSES:
            drawn = round(rng.gauss(mean, math.sqrt(mean) * live))
            return min(max(drawn, 0), self._most())
        pulses = 0
        at = rng.expovariate(rate)
        while at <= interval:
            pulses += 1
            at += dead + rng.expovariate(rate)
        return pulses

    def _most(self) -> int:
        """The most that fit, one after the other."""
        return int(self._interval_s / self._dead_s) + 1 if self._dead_s else 1 << 62
