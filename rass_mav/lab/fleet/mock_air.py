"""The air of a mock swarm of real processes: a world that advances step by step, and a flight controller for each
node."""

from __future__ import annotations

import sys

from rass_mav.lab.fleet.air_server import Air, AirOrder, Figures, main
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.lab.swarm.scenario import system_id
from rass_mav.lab.swarm.surroundings import Surroundings


class MockAir(Air[Figures]):
    """Nodes move and sources drift as in virtual time, once the air has been told to start."""

    def __init__(self, order: AirOrder) -> None:
        """See `Air`."""
        scenario = order.scenario
        self.surroundings = Surroundings(scenario)
        super().__init__(order, self.surroundings.graph, Figures())
        name = scenario.mavlink.reading_name
        self._autopilots = [MockAutopilot(system_id(node), reading_name=name) for node in range(scenario.nodes)]

    def step(self) -> None:
        """Advance one step: the world moves, and delayed frames arrive."""
        if self.started:
            self.surroundings.step()
        super().step()

    def look(self, now: float) -> float:
        """The flight controllers send once a step; in steps that are caught up they are silent."""
        surroundings = self.surroundings
        for node, wire in enumerate(self._companion):
            if wire.peer is None:
                continue
            x, y = surroundings.positions[node]
            reading = surroundings.reading(node, self._noise_rng)
            for frame in self._autopilots[node].frames(now, x, y, reading):
                wire.send(frame)
        return self.due


if __name__ == "__main__":
    sys.exit(main(MockAir, AirOrder, sys.argv[1:]))
