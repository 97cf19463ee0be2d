"""The mock swarm in virtual time: the driver of many agents over one radio. Real MAVLink bytes, no clock."""

from __future__ import annotations

import random
from collections.abc import Callable

from rass_mav.agent.agent import Agent
from rass_mav.store.memory import MemoryStore
from rass_mav.swarm.autopilot import MockAutopilot
from rass_mav.swarm.invariants import count_loops
from rass_mav.swarm.ledger import Ledger
from rass_mav.swarm.mobility import make_mobility
from rass_mav.swarm.neighbours import RangeGraph
from rass_mav.swarm.radiation import RadiationField, Source, random_sources
from rass_mav.swarm.radio import Radio
from rass_mav.swarm.scenario import Scenario, system_id
from rass_mav.swarm.statistics import Statistics


class World:
    """A swarm, its radio, its field and its ledger. `step` does one step in the order that docs/simulation.md states."""

    def __init__(self, scenario: Scenario, *, record: Callable[[bytes], None] | None = None) -> None:
        """`record` is called with every frame put on the air. Raises `ConfigError` for a swarm that cannot be placed."""
        self.scenario = scenario
        seed = scenario.seed
        # One generator for each purpose: what one part draws does not disturb the others. Seeding with a text is
        # the same in every process.
        self.mobility = make_mobility(
            scenario.topology,
            nodes=scenario.nodes,
            range_m=scenario.radio.range_m,
            arena_m=scenario.arena,
            rng=random.Random(f"{seed}:places"),
            bases=scenario.bases,
            pitch_m=scenario.mobility.pitch_m,
            split_step=scenario.mobility.split_step,
            rejoin_step=scenario.mobility.rejoin_step,
            gap_m=scenario.mobility.gap_m,
            positions=scenario.mobility.positions,
        )
        radiation = scenario.radiation
        field_rng = random.Random(f"{seed}:field")
        if radiation.sources is None:
            sources = random_sources(field_rng, radiation.random_sources, radiation.spread_m)
        else:
            sources = [Source(*source) for source in radiation.sources]
        self.field = RadiationField(
            sources, decay=radiation.decay, drift=radiation.drift, rng=field_rng, bounds=scenario.arena / 2
        )
        self.graph = RangeGraph(self.mobility.positions, scenario.radio.range_m)
        self.radio = Radio(scenario.radio, random.Random(f"{seed}:radio"), record=record)
        self.ledger = Ledger()
        self.t = 0
        """The step that comes next."""
        self.loops = 0
        """Cycles of next hops seen, one for each cycle and step."""
        self._strike_rng = random.Random(f"{seed}:strikes")
        self._noise_rng = random.Random(f"{seed}:noise")
        self.stores: list[MemoryStore] = []
        self.agents: list[Agent] = []
        self.autopilots: list[MockAutopilot] = []
        for node_id in range(scenario.nodes):
            rng = random.Random(f"{seed}:node:{node_id}")
            store = MemoryStore(rng.getrandbits(32), quota_bytes=scenario.store.quota_bytes)
            base = node_id < scenario.bases
            self.stores.append(store)
            settings = scenario.agent_settings(node_id)
            self.agents.append(Agent(settings, store, rng, now=0.0, observer=self.ledger.book(base=base)))
            self.autopilots.append(MockAutopilot(system_id(node_id), reading_name=scenario.mavlink.reading_name))
        self.statistics = Statistics(self)
        self._levels: list[tuple[float, float]] = []

    def run(self, steps: int, *, after: Callable[[World], None] | None = None) -> None:
        """Do `steps` steps; `after` is called after each."""
        for _ in range(steps):
            self.step()
            if after is not None:
                after(self)

    def step(self) -> None:
        """One step: arrivals due, places and readings, corruption, every node's turn in id order, the air."""
        t = self.t
        now = t * self.scenario.node.step_s
        self.ledger.step = t - 1
        if self.scenario.radio.latency_steps or self.scenario.radio.reorder:
            self.radio.begin_step(t)
            self._deliver(t, now)
        self.ledger.step = t
        self._move(t)
        self._sense(now)
        self._strike()
        send = self.radio.send
        for node_id, agent in enumerate(self.agents):
            for outgoing in agent.step(now):
                send(node_id, outgoing[0], t)
            if agent.to_vehicle:
                agent.to_vehicle.clear()
        if not self.scenario.radio.latency_steps:
            self._deliver(t, now)
        self.loops += count_loops([agent.node.routing.next_hop for agent in self.agents])
        self.statistics.count()
        self.t = t + 1

    def _deliver(self, t: int, now: float) -> None:
        agents = self.agents
        send = self.radio.send
        for _, hearer, frame in self.radio.arrivals(t, self.graph.neighbours):
            for outgoing in agents[hearer].peer_bytes(frame, now):
                send(hearer, outgoing[0], t)

    def _move(self, t: int) -> None:
        moved = self.mobility.step(t)
        if moved:
            self.graph.update(self.mobility.positions)
        drifted = self.field.step() if t and self.field.moves else False
        if moved or drifted or not self._levels:
            self._levels = [
                (self.field.level(x, y), self.field.corruption(x, y)) for x, y in self.mobility.positions
            ]

    def _sense(self, now: float) -> None:
        noise = self.scenario.radiation.noise
        gauss = self._noise_rng.gauss
        positions = self.mobility.positions
        levels = self._levels
        agents = self.agents
        for node_id, autopilot in enumerate(self.autopilots):
            x, y = positions[node_id]
            vehicle_bytes = agents[node_id].vehicle_bytes
            for frame in autopilot.frames(now, x, y, levels[node_id][0] + gauss(0.0, noise)):
                vehicle_bytes(frame, now)

    def _strike(self) -> None:
        """Corruption strikes each datum in each drone's store once, by flipping a stored bit."""
        if not self.scenario.radiation.corruption:
            return
        rng = self._strike_rng
        for node_id in range(self.scenario.bases, self.scenario.nodes):
            probability = self._levels[node_id][1]
            store = self.stores[node_id]
            if not probability:
                continue
            for id in list(store.ids()):
                if rng.random() < probability:
                    store.flip_bit(id, rng.randrange(8 * len(self.ledger.payloads[id])))


