"""The mock swarm in virtual time: places, radiation and flight controllers are simulated."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from rass_mav.core.participant import Participant
from rass_mav.lab.medium.air import Record
from rass_mav.lab.medium.neighbours import Position, RangeGraph
from rass_mav.lab.swarm.autopilot import MockAutopilot
from rass_mav.lab.swarm.failures import Blast, Failures
from rass_mav.lab.swarm.gps import GpsErrors
from rass_mav.lab.swarm.mission import swarm_trusts
from rass_mav.lab.swarm.radiation import Threshold
from rass_mav.lab.swarm.scenario import Scenario, system_id
from rass_mav.lab.swarm.surroundings import Surroundings
from rass_mav.lab.swarm.traffic import Pictures, loaded
from rass_mav.lab.swarm.virtual import Danger, VirtualSwarm


class World(VirtualSwarm):
    """A swarm in its surroundings, with its radio and its ledger."""

    def __init__(
        self, scenario: Scenario, *, record: Record | None = None, participant: type[Participant] | None = None
    ) -> None:
        """`record` is called with every frame put on the air, and its step. `participant`: what every node is; None:
        what the policy asks for. Raises `ConfigError`."""
        self.surroundings = Surroundings(scenario)
        neighbours = self.surroundings.graph.neighbours
        scenario, load = loaded(scenario, max(round(sum(map(len, neighbours)) / scenario.nodes) + 1, 2))
        self.scenario = scenario
        self._pictures = Pictures(scenario)
        self._noise_rng = random.Random(f"{scenario.seed}:noise")
        self._places: Sequence[tuple[float, float]] | None = None
        """Where the nodes were a step ago, if their flight controllers report velocities; else nobody asks."""
        # A node that foresees contacts asks for a position in each step. (Twice as often, so that rounding skips none.)
        hz = 2.0 / scenario.node.step_s if "contacts" not in scenario.without else 1.0
        self._autopilots = [
            MockAutopilot(
                system_id(node_id), reading_name=scenario.mavlink.reading_name, position_hz=hz,
                accuracy_m=scenario.mobility.gps_error_m,
            )
            for node_id in range(scenario.nodes)
        ]  # fmt: skip
        self._gps = GpsErrors(
            random.Random(f"{scenario.seed}:gps"), scenario.nodes, scenario.mobility.gps_error_m, scenario.node.step_s
        )
        radiation = scenario.radiation
        self._threshold: Threshold | None = None
        self._robot_rngs: list[random.Random] = []
        if radiation.rule == "threshold":
            self._threshold = Threshold(*radiation.tolerance, radiation.jitter)
            # The authors' robots draw the same numbers in each run: these generators start from the id alone.
            self._robot_rngs = [random.Random(f"robot:{node_id}") for node_id in range(scenario.nodes)]
        failures: Failures | None = None
        if scenario.failures.of_robots:
            failures = Failures(
                scenario.failures, seed=scenario.seed, steps=scenario.steps, nodes=scenario.nodes,
                bases=scenario.bases, step_s=scenario.node.step_s,
            )  # fmt: skip
        super().__init__(
            scenario,
            map(scenario.agent_settings, range(scenario.nodes)),
            topology=scenario.topology,
            full_items=scenario.statistics.full_items,
            failures=failures,
            disk=scenario.disk,
            hostile=scenario.hostile,
            off_steps=scenario.failures.reboot_steps,
            strikes=scenario.radiation.strikes_per_step,
            record=record,
            participant=participant,
            trusts=swarm_trusts(scenario),
        )
        self.statistics.load = load
        self.statistics.pictures = self._pictures
        if failures is not None and scenario.failures.blast is not None:
            failures.blast = Blast(self.ledger)

    @property
    def graph(self) -> RangeGraph:
        """Which nodes are in range of each other."""
        return self.surroundings.graph

    @property
    def neighbours(self) -> Sequence[Sequence[int]]:
        """For each node the ids in its range, ascending."""
        return self.surroundings.graph.neighbours

    @property
    def positions(self) -> Sequence[Position]:
        """Of each node, metres east and north of the arena's centre."""
        return self.surroundings.positions

    def _surround(self, t: int, now: float) -> None:
        if t:
            self.surroundings.step()
        if self.failures is not None:
            for failure in self.failures.due(t, self.surroundings.levels):
                self.crash(failure.node, failure.back, wiped=failure.wiped)
            if self.failures.blast is not None and t == self.scenario.failures.blast:
                self._explode(self.failures, self.failures.blast)
        self._sense(now)
        for node_id in self._pictures.due(t):
            if node_id not in self.off:
                # It leaves in the node's turn.
                self._pictures.take(self.agents[node_id], now)

    def _dangers(self) -> Iterator[Danger]:
        """The drones where radiation is, by Eq. 2, the authors' rule, or the dose."""
        radiation = self.scenario.radiation
        if not radiation.corruption:
            return
        page_bytes = radiation.page_bytes if radiation.law == "dose" else None
        for node_id in range(self.scenario.bases, self.scenario.nodes):
            if self._threshold is None:
                danger = Danger(node_id, self.surroundings.corruption[node_id], None, page_bytes)
            else:
                rng = self._robot_rngs[node_id]
                danger = Danger(node_id, self._threshold.probability(self.surroundings.levels[node_id], rng), rng)
            if danger.probability:
                yield danger

    def _explode(self, failures: Failures, blast: Blast) -> None:
        """The blast of this step."""
        holdings = [agent.node.holdings for agent in self.agents]
        dying = failures.kill(blast.aim(holdings, self.neighbours, self.scenario.bases))
        blast.begins(len(dying))
        for failure in dying:
            self.crash(failure.node, failure.back)
        blast.is_over()

    def _sense(self, now: float) -> None:
        """Each flight controller sends its position, and its sensor's reading."""
        rng = self._noise_rng
        positions = self.surroundings.positions
        reading = self.surroundings.reading
        agents = self.agents
        off = self.off
        before, step_s = self._places or positions, self.step_s
        if "contacts" not in self.scenario.without:
            self._places = positions
        self._gps.step()
        for node_id, autopilot in enumerate(self._autopilots):
            x, y = positions[node_id]
            last_x, last_y = before[node_id]
            velocity = ((x - last_x) / step_s, (y - last_y) / step_s)
            vehicle_bytes = agents[node_id].vehicle_bytes
            frames = autopilot.frames(now, *self._gps.place(node_id, (x, y)), reading(node_id, rng), velocity)
            if node_id in off:
                continue
            for frame in frames:
                vehicle_bytes(frame, now)
