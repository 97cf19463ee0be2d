"""What radiation does to frames that wait or fly."""

from __future__ import annotations

import random
from array import array
from bisect import bisect_right
from collections.abc import Mapping
from math import expm1, log1p

#: A strike that hits everything, in numbers that can be subtracted.
_MOST = 1.0 - 1e-12


class Exposure:
    """The strikes that each node has been exposed to."""

    def __init__(self, nodes: int, rng: random.Random) -> None:
        self._rng = rng
        self._times: list[float] = []
        # For each node the sum of -log(1 - probability) before each strike, and after the last.
        self._sums = [array("d", [0.0]) for _ in range(nodes)]

    def strike(self, probabilities: Mapping[int, float], now: float) -> None:
        """A strike. `probabilities`: that an item at a node is hit, 0..1; nodes that are left out are safe."""
        self._times.append(now)
        for node, sums in enumerate(self._sums):
            sums.append(sums[-1] - log1p(-min(probabilities.get(node, 0.0), _MOST)))

    def touched(self, node: int, frame: bytes, since: float, until: float) -> bytes:
        """A frame after it was at a node between two times, seconds: with a flipped bit if a strike hit it."""
        sums = self._sums[node]
        exposed = sums[bisect_right(self._times, until)] - sums[bisect_right(self._times, since)]
        if not exposed or self._rng.random() >= -expm1(-exposed):
            return frame
        place = self._rng.randrange(8 * len(frame))
        struck = bytearray(frame)
        struck[place // 8] ^= 1 << place % 8
        return bytes(struck)
