"""Many agents over one mock radio in virtual time: real MAVLink bytes, no clock.

Motion and autopilots are left to subclasses: `lab.swarm.world` simulates them, `replay` takes them from logs.
"""

from __future__ import annotations

import gc
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from math import inf
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from rass_mav.agent.agent import Agent
from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, Way
from rass_mav.agent.settings import AgentSettings
from rass_mav.agent.turns import MOST_JITTER, jitter
from rass_mav.core.datum import Datum, Fate
from rass_mav.core.observer import Observer
from rass_mav.core.participant import Participant
from rass_mav.core.store import Store
from rass_mav.errors import StoreError
from rass_mav.lab.disk.power import Power
from rass_mav.lab.disk.settings import DiskSection
from rass_mav.lab.hostile.band import Band
from rass_mav.lab.hostile.kinds import HostileSection
from rass_mav.lab.ledger import Ledger
from rass_mav.lab.medium.air import Air, Record, open_datagram
from rass_mav.lab.medium.channel import Order, Timeline
from rass_mav.lab.medium.drivers import Drivers
from rass_mav.lab.medium.instant import Instant
from rass_mav.lab.medium.neighbours import Position
from rass_mav.lab.swarm.crash_store import CrashStore
from rass_mav.lab.swarm.failures import Failures
from rass_mav.lab.swarm.scenario import SwarmSettings
from rass_mav.lab.swarm.statistics import Statistics, count_loops
from rass_mav.station.node import build_node
from rass_mav.store.memory import MemoryStore, flipped

#: So many more objects than have gone make it look at the young ones. With Python's 700 it did so 83 times in 60 steps
#: of 100 nodes, and took 3.6 % of their time (by `gc.callbacks`; scenario `demo`, all defaults).
YOUNG = 100_000


@contextmanager
def at_rest() -> Iterator[None]:
    """The swarm lives to the end, so it need not be scanned again and again. What a step leaves behind is freed by its
    reference counts: only the few cycles among it wait for the collector."""
    before = gc.get_threshold()
    # Where somebody has frozen objects before, ours could not be told from theirs when they are thawed.
    freezes = gc.get_freeze_count() == 0
    gc.collect()
    if freezes:
        gc.freeze()
    gc.set_threshold(YOUNG, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if freezes:
            gc.unfreeze()


if TYPE_CHECKING:
    from rass_mav.trust.trust import Trust

S = TypeVar("S", bound="VirtualSwarm")


class Danger(NamedTuple):
    """A drone whose data are struck."""

    node: int
    probability: float
    """That a datum, or a page of it, is struck in a step, 0..1."""
    rng: random.Random | None = None
    """The drone's own generator, if it has one for this."""
    page_bytes: int | None = None
    """Size of the pages; None: a datum is struck as a whole."""


class Phases:
    """The nodes' computers are switched on at any time, so their turns are not at the same time."""

    def __init__(self, nodes: int, *, apart: bool, strikes: int, seed: int) -> None:
        """`apart`: each node has its turns at a moment of its own; False: at the beginning of a step. `strikes`: how
        often in a step data are struck."""
        self.strikes = [part / strikes for part in range(strikes)]
        """How long after the beginning of a step data are struck, in steps."""
        draw = random.Random(f"{seed}:phases").random
        self._phases = [draw() for _ in range(nodes)] if apart else []
        self._rng = random.Random(f"{seed}:jitter")

    def delays(self) -> list[float]:
        """How long after the beginning of this step each node has its turn, in steps, by node id; 0..1. Empty: all have
        it then."""
        return [(phase + jitter(self._rng)) / (1.0 + MOST_JITTER) for phase in self._phases]


class VirtualSwarm(ABC):
    """Agents, their radio and their ledger. `step` does one step in the order that docs/evaluation/simulation.md
    describes."""

    #: Holds back a node's frames until its store has written what they depend on.
    make_gate = CommitGate

    def __init__(
        self,
        settings: SwarmSettings,
        agents: Iterable[AgentSettings],
        *,
        topology: str,
        full_items: int | None = None,
        failures: Failures | None = None,
        disk: DiskSection | None = None,
        hostile: Sequence[HostileSection] = (),
        off_steps: int = 1,
        strikes: int = 1,
        record: Record | None = None,
        participant: type[Participant] | None = None,
        trusts: Mapping[int, Trust] | None = None,
    ) -> None:
        """:param agents: settings of each node, by node id from 0; at least one. All have the same step length.
        :param topology: its name in the summary.
        :param full_items: how many data in a drone's store the summary calls 100 %; None: the store's capacity.
        :param failures: which nodes go off, and when; the subclass that simulates the surroundings carries it out.
          None: none do.
        :param disk: what the nodes' disks are like; None: their stores are in memory.
        :param hostile: attackers beside the nodes.
        :param off_steps: how long a node is off after a power cut.
        :param strikes: how often in a step data are struck.
        :param record: called with every frame put on the air, and its step.
        :param participant: what every node is; None: what its policy asks for.
        :param trusts: by id, what keys do for each node and each captured attacker; None: nobody has keys.
        """
        agents, radio = list(agents), settings.radio
        seed = self.seed = settings.seed
        self.topology = topology
        self.step_s = agents[0].step_s
        """Length of a step, seconds."""
        self._timeline = Timeline()
        self._trusts = trusts or {}
        self.air: Air
        """What carries the nodes' frames."""
        # One generator for each purpose: the draws of one part do not disturb the others. Seeding with a text is the
        # same in every process.
        if radio.takes_time:
            self.air = Drivers(
                radio, self._timeline, self._reach, lambda: self.positions, self._hear, nodes=len(agents),
                attackers=len(hostile), step_s=self.step_s, seed=seed, record=record,
            )  # fmt: skip
        else:
            self.air = Instant(radio, self._timeline, self._reach, self._hear, seed=seed, record=record)
        self.ledger = Ledger(custody=agents[0].custody.mode == "acknowledged")
        self.t = 0
        """The next step."""
        self.loops = 0
        """Cycles of next hops seen, one for each cycle and step."""
        self.failures = failures
        self.off: dict[int, int | None] = {}
        """Nodes that are off, and the step in which each has its turn again (None: never)."""
        self.power = None if disk is None else Power(disk, self.ledger, seed=seed, off_steps=off_steps)
        """None: there are no disks."""
        self.stores: list[Store] = []
        self.gates: list[CommitGate] = []
        self.agents: list[Agent] = []
        """For a node that is off: the one that will start on its store, or with disks the one that ran there."""
        for own in agents:
            rng = random.Random(f"{seed}:node:{own.node_id}")
            store: Store
            observer: Observer
            if self.power is None:
                store, observer = self._make_store(own, rng), self.ledger.book(base=own.base)
            else:
                computer = self.power.add(own, rng)
                store, observer = computer.store, computer.diary
            self.stores.append(store)
            self.gates.append(self.make_gate(store))
            self.agents.append(
                build_node(
                    own, store, rng, now=0.0, observer=observer, newborn=True, participant=participant,
                    keys=self._trusts.get(own.node_id),
                )
            )  # fmt: skip
            self.air.start(own.node_id, self.agents[-1], 0.0)
        self._tending = [inf] * len(agents)
        """When each node was last due to be tended, seconds."""
        self.statistics = Statistics(self, full_items)
        some = self.agents[0]
        self.hostile = Band(
            hostile, nodes=len(self.agents), seed=seed, payload_type=some.settings.mavlink.payload_type,
            costs=some.node.policy.costs is not None, trusts=self._trusts, step_s=self.step_s,
        )  if hostile else None  # fmt: skip
        """None: all nodes are honest."""
        self.ledger.lies = bool(hostile)
        self._strike_rng = random.Random(f"{seed}:strikes")
        self._phases = Phases(len(agents), apart=settings.node.phases == "random", strikes=strikes, seed=seed)

    @property
    @abstractmethod
    def neighbours(self) -> Sequence[Sequence[int]]:
        """For each node the ids in its range, ascending."""

    @property
    def positions(self) -> Sequence[Position]:
        """Of each node, metres; empty: they are not known."""
        return ()

    @abstractmethod
    def _surround(self, t: int, now: float) -> None:
        """Places, links and readings take their values of step `t`, at `now` seconds."""

    @abstractmethod
    def _dangers(self) -> Iterator[Danger]:
        """The drones whose data are struck in this step, in order."""

    def run(self: S, steps: int, *, after: Callable[[S], None] | None = None) -> None:
        """Do `steps` steps; `after` is called after each."""
        for _ in range(steps):
            self.step()
            if after is not None:
                after(self)

    def step(self) -> None:
        """One step: arrivals due, places and readings, then corruption, every node's turn in id order, and the air.

        Turns with phases, several strikes, and an air that takes time come when it is their time.
        """
        t, step_s, timeline = self.t, self.step_s, self._timeline
        now = t * step_s
        # What was overtaken belongs to the step before; what takes whole steps arrives in this one.
        self.ledger.step = t - 1 if self.air.at_once else t
        self.air.arrive(t, now)
        self.ledger.step = t
        off = self.off
        if off:
            for node_id in [node_id for node_id, back in off.items() if back == t]:
                self._come_back(node_id, t)
        self._surround(t, now)
        self.air.rearrange()
        for strike in self._phases.strikes:
            timeline.at(now + step_s * strike, Order.STRIKE, self._irradiate)
        if self.power is not None:
            for node_id in self.power.begin_step(t, off):
                self.fail(node_id, None)
        delays = self._phases.delays()
        if not delays:
            timeline.at(now, Order.TURN, self._take_turns)
        for node_id, delay in enumerate(delays):
            timeline.at(now + delay * step_s, Order.TURN, partial(self._take_turn, node_id))
        if self.hostile is not None:
            timeline.at(now, Order.TURN, self._attack)
        timeline.run((t + 1) * step_s)
        self.loops += count_loops(
            [None if node_id in off else agent.node.routing.next_hop for node_id, agent in enumerate(self.agents)]
        )
        self.statistics.count()
        self.t = t + 1

    def _reach(self) -> Sequence[Sequence[int]]:
        """For each node, then for each attacker, the nodes in its range."""
        return self.neighbours if self.hostile is None else self.hostile.reach(self.neighbours)

    def _take_turns(self, now: float) -> None:
        for node_id in range(len(self.agents)):
            self._take_turn(node_id, now)

    def _take_turn(self, node_id: int, now: float) -> None:
        if node_id in self.off:
            return
        agent = self.agents[node_id]
        try:
            self.air.begin_turn(node_id, agent, now)
            self._say(node_id, agent.step(now), now)
        except StoreError as error:
            self.fail(node_id, error)
        else:
            self._tend_later(node_id)

    def _attack(self, now: float) -> None:
        assert self.hostile is not None
        for attacker, frame in self.hostile.turn(self.t, now):
            self.air.broadcast(attacker, frame, now)

    def _irradiate(self, now: float) -> None:
        """Corruption strikes the data in the drones' stores, and what waits in their radios."""
        part = 1.0 / len(self._phases.strikes)
        struck = {}
        for node, probability, rng, page_bytes in self._dangers():
            if len(self._phases.strikes) > 1:
                probability = 1.0 - (1.0 - probability) ** part
            struck[node] = probability
            self.strike(node, probability, rng or self._strike_rng, page_bytes)
        self.air.strike(struck, now)

    def _hear(self, hearers: Sequence[int], frame: bytes, now: float) -> None:
        """Nodes have heard a frame."""
        agents, off = self.agents, self.off
        # Over stores in memory nothing waits.
        waits = self.power is not None
        keyed = bool(self._trusts)
        opened = open_datagram(frame, now)
        for hearer in hearers:
            if off and hearer in off:
                continue
            try:
                agent = agents[hearer]
                if opened is None:
                    answers = agent.peer_bytes(frame, now)
                else:
                    peers = agent.peers
                    message = peers.heard(frame, opened, now) if keyed else peers.message(opened, now)
                    if message is not None:
                        answers = agent.receive(message, now)
                    elif waits:
                        answers = ()
                    else:
                        continue
                if answers or (waits and agent.answers.due == inf):
                    self._say(hearer, answers, now)
            except StoreError as error:
                self.fail(hearer, error)
            else:
                # At most nodes nothing waits.
                if agent.answers.due < inf or agent.node.exchange.due < inf:
                    self._tend_later(hearer)

    def _tend_later(self, node_id: int) -> None:
        """If a node's answers wait, or its transfers, tend it when it is due."""
        agent = self.agents[node_id]
        due = agent.due()
        if due == self._tending[node_id]:
            return
        self._tending[node_id] = due

        def tend(now: float) -> None:
            if self.agents[node_id] is not agent or node_id in self.off:
                return
            try:
                self._say(node_id, agent.tend(now)[0], now)
            except StoreError as error:
                self.fail(node_id, error)
            else:
                self._tend_later(node_id)

        if due < inf:
            self._timeline.at(due, Order.AIR, tend)

    def _say(self, node_id: int, frames: Sequence[Outgoing], now: float) -> None:
        """A node has had its turn, or heard a frame. Its frames leave when its changes are on its disk."""
        gate = self.gates[node_id]
        self._send(node_id, gate.say(frames), now)
        if self.power is not None:
            computer, steps = self.power.computers[node_id], self.power.settings.commit_steps
            self._send(node_id, computer.commit(gate, self.t, steps), now)

    def _send(self, node_id: int, frames: Sequence[Outgoing], now: float) -> None:
        for outgoing in frames:
            # The mock flight controllers and the ground station listen to no node.
            if outgoing.way is not Way.NEIGHBOURS:
                continue
            if self._trusts:
                outgoing = self.agents[node_id].peers.leaving(outgoing)
            self.air.send(node_id, outgoing, now)
            if self.hostile is not None:
                for attacker, frame in self.hostile.overhear(node_id, outgoing.frame, self.neighbours, self.t, now):
                    self.air.broadcast(attacker, frame, now)

    def _make_store(self, settings: AgentSettings, rng: random.Random) -> MemoryStore:
        """An empty store, with an epoch of its own."""
        kind = MemoryStore if self.failures is None else CrashStore
        return kind(rng.getrandbits(32), quota_bytes=settings.store.quota_bytes)

    def crash(self, node_id: int, back: int | None, *, wiped: bool = False) -> None:
        """A node goes off before its turn of the present step: the content of its memory is gone.

        :param back: the step, this or a later one, in which it has its turn again; None: never, it counts as dead.
        :param wiped: its store is gone too, and it comes back with an empty one of a new epoch.
        :raises ValueError: `back` is over, or this swarm was created without failures.
        """
        t = self.t
        if self.failures is None or (back is not None and back < t):
            raise ValueError(f"node {node_id} cannot be off from step {t} to {back}")
        self.air.stop(node_id)
        gone = wiped or back is None
        if self.power is not None:
            self.power.computers[node_id].shut_down()
            if gone:
                self.power.computers[node_id].wipe()
            self.off[node_id] = back
            if back == t:
                self._come_back(node_id, t)
            return
        old, store = self.agents[node_id], self.stores[node_id]
        assert isinstance(store, CrashStore)
        observer = old.node.observer
        rng = self._rng_after(t, node_id)
        stored = dict.fromkeys(store.ids())
        if gone:
            for id in stored:
                observer.dropped(id, Fate.DIED)
            store = self._make_store(old.settings, rng)
        else:
            store.restart()
            for id in store.ids():
                if id not in stored and (datum := store.get(id)) is not None:
                    # Its removal had not been written.
                    observer.gained(datum)
        self._restart(node_id, store, rng, t if back is None else back)
        if back != t:
            self.off[node_id] = back

    def fail(self, node_id: int, error: StoreError | None) -> None:
        """A node's power was cut, or its disk failed so that it starts again."""
        if self.power is None:
            assert error is not None
            raise error
        self.air.stop(node_id)
        self.power.fail(node_id)
        self.off[node_id] = self.t + self.power.off_steps

    def _come_back(self, node_id: int, t: int) -> None:
        """A node is on again. If its disk does not let the store be opened, it tries again in the next step."""
        if self.power is not None:
            computer = self.power.computers[node_id]
            try:
                self._restart(node_id, computer.open(), self._rng_after(t, node_id), t)
            except StoreError:
                computer.shut_down()
                self.off[node_id] = t + 1
                return
        del self.off[node_id]

    def _rng_after(self, t: int, node_id: int) -> random.Random:
        # A new generator, so that no message of the old life is repeated by accident.
        return random.Random(f"{self.seed}:node:{node_id}:off:{t}")

    def _restart(self, node_id: int, store: Store, rng: random.Random, start: int) -> None:
        """A new agent starts over its store, in step `start`."""
        old = self.agents[node_id]
        agent = build_node(
            old.settings, store, rng, now=start * self.step_s, observer=old.node.observer, participant=type(old.node),
            keys=self._trusts.get(node_id),
        )  # fmt: skip
        # So its data are due in the same steps as if it had never been off.
        agent.steps = start
        self.air.start(node_id, agent, start * self.step_s)
        # Frames that waited for a commit were only in memory.
        self.stores[node_id], self.gates[node_id], self.agents[node_id] = store, self.make_gate(store), agent
        self._tending[node_id] = inf
        self.statistics.retire(old)

    def strike(self, node_id: int, probability: float, rng: random.Random, page_bytes: int | None = None) -> None:
        """Corruption strikes each datum at a drone with this probability, by flipping a bit.

        `page_bytes`: it strikes each page of this size with this probability, and a datum is as many pages as it needs;
        None: it strikes each datum.
        """
        store, overheard = self.stores[node_id], self.agents[node_id].node.overheard
        assert isinstance(store, MemoryStore)
        draw, chance = rng.random, probability
        for datum in list(store.data()):
            if page_bytes is not None:
                chance = _chance(probability, datum, page_bytes)
            if draw() < chance:
                store.flip_bit(datum.id, rng.randrange(8 * len(datum.payload)))
        for datum in list(overheard.values()):
            if page_bytes is not None:
                chance = _chance(probability, datum, page_bytes)
            if draw() < chance:
                overheard[datum.id] = flipped(datum, rng.randrange(8 * len(datum.payload)))


def _chance(probability: float, datum: Datum, page_bytes: int) -> float:
    """That a datum is struck, if each of its pages is with this probability."""
    pages = -(-len(datum.payload) // page_bytes)
    return probability if pages == 1 else 1.0 - (1.0 - probability) ** pages
