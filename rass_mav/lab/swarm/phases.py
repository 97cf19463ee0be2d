"""When in a step each node of the mock swarm has its turn, and when radiation strikes."""

from __future__ import annotations

import random

from rass_mav.agent.turns import MOST_JITTER, jitter


class Phases:
    """The nodes' computers are switched on at any time, so their turns are not at the same time."""

    def __init__(self, nodes: int, *, apart: bool, strikes: int, seed: int) -> None:
        """`apart`: each node has its turns at a moment of its own; False: at the beginning of a step. `strikes`: how
        often in a step data are struck."""
        self.strikes = [part / strikes for part in range(strikes)]
        """How long after the beginning of a step data are struck, in steps."""
        draw = random.Random(f"{seed}:phases").random
        self._phases = [draw() if apart else None for _ in range(nodes)]
        self._rng = random.Random(f"{seed}:jitter")

    def delays(self) -> list[float]:
        """How long after the beginning of this step each node has its turn, in steps, by node id; 0..1."""
        return [0.0 if phase is None else (phase + jitter(self._rng)) / (1.0 + MOST_JITTER) for phase in self._phases]
