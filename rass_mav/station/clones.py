"""Detects another node that runs on a copy of this node's store, for example of its card."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.core.participant import Participant

#: Steps after the start in which own beacons from before may still be on their way back.
SETTLED_STEPS = 20
#: Beacons that show it. Anybody can forge them, so what follows must not harm.
ENOUGH = 3


class Clones(VehicleService):
    """A service of the agent. Both nodes would assign the same ids to different data, and seal both with one nonce."""

    def __init__(self, agent: Agent, found: Callable[[], None]) -> None:
        """`found`: called once."""
        self._agent = agent
        self._found = found
        self._node: Participant | None = None
        self._from = 0
        """The step in which that node began."""
        self._before = 0

    def step(self, now: float) -> None:
        """Once a step."""
        node, clones = self._agent.node, self._agent.node.alarms.clones
        if node is not self._node:
            self._node, self._from = node, self._agent.steps
        if self._agent.steps <= self._from + SETTLED_STEPS:
            self._before = clones
        elif clones >= self._before + ENOUGH:
            self._before = clones
            self._found()
