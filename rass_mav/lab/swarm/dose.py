"""Radiation as drones meet it in the field: dose rates in uSv/h, what a Geiger counter reads, what a dose destroys.

docs/field.md states the laws, and where their numbers come from.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from random import Random

from rass_mav.lab.swarm.radiation import RadiationField, Source
from rass_mav.sensor.dose import DoseMeter, Tube

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
    uSv/h, and falls with the square of the distance."""

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
