"""Who hears whom, who notices that another sends, and how well."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from .neighbours import Position, RangeGraph
from .settings import RadioSection

#: The steepness of a receiver's threshold: 1 dB above it 9 of 10 frames arrive, 1 dB below it 1 of 10.
_STEEPNESS = math.log(9.0)
#: Links that are worse than the threshold by this many standard deviations of the shadowing, and by this many dB
#: more, carry nothing.
_DEVIATIONS, _MARGIN_DB = 3.0, 3.0
#: The exponent by which the strength of frames is compared if no path loss is set.
_FREE_SPACE = 2.0


class Reach:
    """The links of a step. Node ids, and those of attackers after them, are the indices."""

    def __init__(self, settings: RadioSection, seed: int) -> None:
        self._settings = settings
        self._seed = seed
        self._exponent = settings.path_loss or _FREE_SPACE
        self._positions: Sequence[Position] = ()
        self._shadows: dict[tuple[int, int], float] = {}
        self.hearers: Sequence[Sequence[int]] = ()
        """For each sender the nodes that may hear it."""
        self.noticed: Sequence[Sequence[int]] = ()
        """For each sender the nodes that notice that it sends."""
        self.fades = settings.path_loss is not None
        """Whether frames get lost with the distance: ask `chance`."""

    def update(self, neighbours: Sequence[Sequence[int]], positions: Sequence[Position]) -> None:
        """The links of a new step. `neighbours`: the nodes within the range."""
        settings = self._settings
        self._positions = positions
        self.hearers = self.noticed = neighbours
        if settings.path_loss is not None:
            farther_db = _DEVIATIONS * settings.shadowing_db + _MARGIN_DB
            farthest_m = settings.range_m * 10.0 ** (farther_db / (10.0 * settings.path_loss))
            self.hearers = RangeGraph(positions, farthest_m).neighbours
        if settings.sense > 1.0:
            self.noticed = RangeGraph(positions, settings.sense * settings.range_m).neighbours

    def chance(self, sender: int, hearer: int) -> float:
        """The probability that a frame arrives if no other is in the air."""
        margin_db = self.strength_db(sender, hearer) + 10.0 * self._exponent * math.log10(self._settings.range_m)
        return 1.0 / (1.0 + math.exp(-_STEEPNESS * margin_db))

    def strength_db(self, sender: int, hearer: int) -> float:
        """How strong a frame arrives, compared with a distance of 1 m, dB."""
        distance_m = max(math.dist(self._positions[sender], self._positions[hearer]), 0.01)
        return self._shadow_db(sender, hearer) - 10.0 * self._exponent * math.log10(distance_m)

    def _shadow_db(self, a: int, b: int) -> float:
        deviation = self._settings.shadowing_db
        if not deviation:
            return 0.0
        link = (a, b) if a < b else (b, a)
        shadow = self._shadows.get(link)
        if shadow is None:
            shadow = self._shadows[link] = random.Random(f"{self._seed}:shadow:{link}").gauss(0.0, deviation)
        return shadow
