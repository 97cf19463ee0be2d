"""Custody, model-checked: whatever the network does and whoever is killed, no datum is ever on no disk at all.

Real nodes talk over real bytes, and behind the real commit gate. A commit may take as long as it likes, or fail. A kill
takes everything but the last commit; one that was under way may have come to the disk or not. With and without
replicas: a replica counts for nothing here, there must be a copy in custody. Radiation may take any copy of some data;
those may be lost, but of what is left of them the same holds, and all that is left arrives in the end. And while there
are receipts, no loss is forgotten: of a datum of which there is no copy left, a deletion report is on some disk.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Any, get_args

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing, frames_of
from rass_mav.core.datum import USUAL_PRIORITY, DatumId, Terms
from rass_mav.core.messages import BROADCAST, KINDS, Beacon, Committed, CopyStatuses, Message
from rass_mav.core.node import Node
from rass_mav.core.policy import Dispatch, Policy, View
from rass_mav.core.settings import Mechanism
from rass_mav.errors import RassError, StoreError, StoreFullError
from rass_mav.mavlink.frames import FrameWriter
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.policy.settings import PolicySettings
from rass_mav.wire import decode, is_overheard, target_of
from tests.extent import examples, extents
from tests.some import some

from .books import check_node
from .build import make_node, tries
from .durable import DurableStore

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


@pytest.fixture(autouse=True, scope="module")
def soon_given_up() -> Iterator[None]:
    with tries(3):
        yield


NODES = 4
#: What the lab may leave out. These nodes do not move, and their routes are by hops.
LEFT_OUT: list[Mechanism] = sorted({*get_args(Mechanism)} - {"contacts", "queue-toll"})
IDS = st.integers(0, NODES - 1)


class Wander:
    """Everything to a neighbour picked at random: data go round in all cycles there are."""

    name = "wander"
    tag = 7
    replicates = False
    costs = None
    risk_gain = 1.0
    seq_period = 30
    own_share = 0.0

    def potential(self, hops: int, risk: float, free: int) -> int:
        return 1

    def plan(self, view: View) -> list[Dispatch]:
        around = sorted(n.id for n in view.neighbours)
        ids = list(view.data(0xFFFE))[: view.budget] if around else []
        return [Dispatch(id, view.rng.choice(around)) for id in ids]


class Swarm(RuleBasedStateMachine):
    make_gate = CommitGate

    @initialize(
        base=st.booleans(), wander=st.booleans(), replicas=st.booleans(), immediate=st.booleans(),
        broadcast=st.booleans(),
        own_share=st.sampled_from([0.0, 0.2]), without=st.just(frozenset()) | st.frozensets(st.sampled_from(LEFT_OUT)),
    )  # fmt: skip
    def begin(
        self, base: bool, wander: bool, replicas: bool, immediate: bool, broadcast: bool, own_share: float,
        without: frozenset[Mechanism],
    ) -> None:  # fmt: skip
        self.broadcast = broadcast
        self.has_base = base
        self.options: dict[str, Any] = {
            "mirror": replicas, "immediate": immediate, "own_share": own_share,
            "without": tuple(sorted({*without, "contacts"})),
        }  # fmt: skip
        self.struck: set[DatumId] = set()
        self.policy: Policy = Wander() if wander else PolicySettings(name="rass").make()
        self.now = 0.0
        self.lives = 0
        self.payloads = 0
        self.stores = {i: DurableStore(epoch=1000 + i) for i in range(NODES)}
        self.nodes: dict[int, Node] = {}
        self.risks = dict.fromkeys(range(NODES), 0.0)
        self.gates: dict[int, CommitGate] = {}
        self.batches: dict[int, object] = {}
        self.writer = FrameWriter(1, 191)
        self.born: dict[DatumId, bytes] = {}
        self.created: set[DatumId] = set()
        self.air: list[tuple[int, bytes]] = []
        self.cut: set[frozenset[int]] = set()
        for i in range(NODES):
            self._start(i)
        # Everybody knows everybody, and there is something to lose.
        self.turn(random.Random(0), 0.0)
        for i in range(1, NODES):
            self.put(i, 1, USUAL_PRIORITY)
        self.turn(random.Random(0), 0.0)

    def _start(self, i: int) -> None:
        self.gates[i] = self.make_gate(self.stores[i])
        self._take_over(i)

    def _take_over(self, i: int) -> None:
        """A new node over the store."""
        self.lives += 1
        self.nodes[i] = make_node(
            i, store=self.stores[i], policy=self.policy, risk=self.risks[i], now=self.now, seed=self.lives,
            base=self.has_base and i == 0, capacity_items=4,
            **self.options,
        )  # fmt: skip

    def _say(self, i: int, messages: list[Message]) -> None:
        self._send(i, self.gates[i].say(frames_of(messages, self.writer, 33200, self.stores[i], self.now)))

    def _send(self, i: int, frames: Sequence[Outgoing]) -> None:
        hearers = [j for j in range(NODES) if j != i and frozenset((i, j)) not in self.cut]
        for outgoing in frames:
            fields = some(tunnel_from_datagram(outgoing.frame))
            self.air += [(j, fields[5]) for j in hearers]
        del self.air[:-400]

    def _begin_commit(self, i: int) -> None:
        batch = self.gates[i].begin()
        if batch is None:
            self._send(i, self.gates[i].written())
        else:
            self.batches[i] = batch

    def _end_commit(self, i: int) -> None:
        self.stores[i].write(self.batches.pop(i))
        self._send(i, self.gates[i].written())

    def _commit(self, i: int) -> None:
        """All that was said up to now leaves."""
        if i in self.batches:
            self._end_commit(i)
        self._begin_commit(i)
        if i in self.batches:
            self._end_commit(i)

    def _hear(self, i: int, payload: bytes) -> None:
        if i in self.nodes:
            node = self.nodes[i]
            if target_of(payload) in (i, BROADCAST) or (node.overhears and is_overheard(payload)):
                answers = node.receive(decode(payload, self.now), self.now)
                moves = self._forward(i)
                self._say(i, (node.needed(answers, moves) if self.broadcast else answers) + moves)

    def _forward(self, i: int) -> list[Message]:
        return self.nodes[i].forward(self.now) if self.options["immediate"] else []

    @rule(i=IDS, size=st.integers(1, 60), priority=st.sampled_from([USUAL_PRIORITY, 0, 9]))
    def put(self, i: int, size: int, priority: int) -> None:
        if i in self.nodes and len(self.created) < 12:
            self.payloads += 1
            # One frame, or two to twelve chunks.
            payload = self.payloads.to_bytes(2, "big") * (size if size <= 8 else 12 * size)
            try:
                id = self.nodes[i].put(payload, self.now, terms=(terms := Terms(priority)))
            except StoreFullError:
                return
            self.born[id] = terms.pack() + payload

            def tell(error: RassError | None) -> None:
                if error is None:
                    assert id in self.stores[i].disk.data, "accepted, and in custody on no disk"
                    self.created.add(id)
                elif id in self.stores[i].ids():
                    self.gates[i].ask(tell)

            self.gates[i].ask(tell)
            self._say(i, self._forward(i))

    @rule(i=IDS)
    def step(self, i: int) -> None:
        self.now += 0.3
        if i in self.nodes:
            self._say(i, self.nodes[i].step(self.now))

    @rule(i=IDS)
    def commit(self, i: int) -> None:
        """The disk is done with one commit, and the next one begins."""
        if i in self.batches:
            self._end_commit(i)
        elif i in self.nodes:
            self._begin_commit(i)

    @rule(i=IDS)
    def disk_fails(self, i: int) -> None:
        if self.batches.pop(i, None) is not None:
            self.gates[i].failed(StoreError("I/O error"))

    @rule(order=st.randoms(use_true_random=False), loss=st.sampled_from([0.0, 0.0, 0.3]))
    def turn(self, order: random.Random, loss: float) -> None:
        """A whole step of everybody, in any order; what is said arrives or is lost, and is answered."""
        self.now += 1.0
        up = list(self.nodes)
        order.shuffle(up)
        for i in up:
            self._say(i, self.nodes[i].step(self.now))
        self._settle(up, order, loss)

    def _settle(self, up: list[int], order: random.Random, loss: float) -> None:
        for _ in range(12):
            for i in up:
                self._commit(i)
            frames, self.air = self.air, []
            for to, payload in frames:
                if order.random() >= loss:
                    self._hear(to, payload)
            if not self.air and not any(gate.waiting for gate in self.gates.values()):
                break

    @rule(seed=st.integers(0, 1 << 32))
    def storm(self, seed: int) -> None:
        """Many small events: deep histories that single rules reach too seldom."""
        rng = random.Random(seed)
        # No two storms are alike: slow disks, much radiation, long silence show what an average of all does not.
        likely = {
            "step": 25, "frame": 35, "frames": 5, "commit": 50, "reboot": 2, "radiation": 2, "disk fails": 1
        }  # fmt: skip
        for event in rng.choices([*likely], [often * rng.choice((0.1, 1, 5)) for often in likely.values()], k=60):
            i = rng.randrange(NODES)
            if event == "step":
                self.step(i)
            elif event == "frames":
                self.deliver_some(rng.randrange(1, 30))
            elif event == "commit":
                self.commit(i)
            elif event == "reboot":
                self.kill(i, rng.random() < 0.5)
                self.restart(i)
            elif event == "radiation":
                self.radiation(i, rng.randrange(100))
            elif event == "disk fails":
                self.disk_fails(i)
            elif self.air:
                self.frame(rng.randrange(400), rng.choice(["deliver"] * 5 + ["double", "double", "lose"]))
            self.nothing_is_lost()
            self.no_loss_is_forgotten()

    @precondition(lambda self: self.air)
    @rule(pick=st.integers(0, 399), what=st.sampled_from(["deliver", "deliver", "double", "lose"]))
    def frame(self, pick: int, what: str) -> None:
        """Any frame on the air, the newest or one long delayed."""
        to, payload = self.air[pick % len(self.air)] if what == "double" else self.air.pop(pick % len(self.air))
        if what != "lose":
            self._hear(to, payload)

    @precondition(lambda self: self.air)
    @rule(count=st.integers(1, 30))
    def deliver_some(self, count: int) -> None:
        frames, self.air = self.air[:count], self.air[count:]
        for to, payload in frames:
            self._hear(to, payload)

    @rule(i=IDS, written=st.booleans())
    def kill(self, i: int, written: bool) -> None:
        """`written`: a commit that was under way had come to the disk, but nobody knew."""
        if i in self.nodes:
            batch = self.batches.pop(i, None)
            if batch is not None and written:
                self.stores[i].write(batch)
            del self.nodes[i], self.gates[i]
            self.stores[i] = self.stores[i].crashed()

    @rule(i=IDS)
    def restart(self, i: int) -> None:
        if i not in self.nodes:
            self._start(i)

    @rule(i=IDS)
    def fault(self, i: int) -> None:
        """A frame has hit a fault: what has changed since the last commit began is forgotten, a new node takes over."""
        if i in self.nodes:
            self.gates[i].roll_back(StoreError("dropped"))
            self._take_over(i)

    @rule(i=IDS, risk=st.floats(0.0, 1.0))
    def danger_moves(self, i: int, risk: float) -> None:
        self.risks[i] = risk
        if i in self.nodes:
            self.nodes[i].risk.observe(risk, self.now)

    @rule(i=IDS, pick=st.integers(0, 99))
    def radiation(self, i: int, pick: int) -> None:
        """A copy rots, of few data, so that the others still show that nothing is lost."""
        stored = sorted(self.stores[i].ids())
        id = stored[pick % len(stored)] if stored else None
        if id in self.created and len(self.struck | {id}) <= 3 and not (self.has_base and i == 0):
            self.struck.add(id)
            self.stores[i].flip_bit(id)

    @rule(a=IDS, b=IDS)
    def toggle_link(self, a: int, b: int) -> None:
        if a != b:
            self.cut ^= {frozenset((a, b))}

    def _in_custody(self) -> dict[DatumId, bytes]:
        """Good copies on disks that are no replicas. After a restart there are none."""
        found: dict[DatumId, bytes] = {}
        for i, store in self.stores.items():
            node = self.nodes.get(i)
            for id, d in store.disk.data.items():
                replica = node is not None and not node.sink and id not in node.holdings.custody
                if d.intact and not replica:
                    assert found.setdefault(id, d.payload) == d.payload
        return found

    @invariant()
    def nothing_is_lost(self) -> None:
        if not hasattr(self, "stores"):
            return
        found = self._in_custody()
        assert self.created - self.struck <= found.keys(), "a datum is in custody on no disk"
        # The ledger: created = delivered + held, and nothing comes from nowhere.
        assert found == {id: self.born[id] for id in found}

    @invariant()
    def no_loss_is_forgotten(self) -> None:
        if "receipts" in getattr(self, "options", {"without": ["receipts"]})["without"]:
            return
        disks = [store.disk for store in self.stores.values()]
        for id in self.struck:
            assert any(id in disk.data or id in disk.losses for disk in disks), "nobody knows that a datum is lost"

    @invariant()
    def memory_agrees_with_itself(self) -> None:
        for node in getattr(self, "nodes", {}).values():
            check_node(node)

    def teardown(self) -> None:
        """Liveness: once the network is perfect and a base can be reached, everything arrives."""
        if not getattr(self, "has_base", False):
            return
        for i in range(NODES):
            self.restart(i)
        self.cut.clear()
        rng = random.Random(1)
        for _ in range(300):
            self.turn(rng, 0.0)
            self.nothing_is_lost()
            if self._left() <= self.stores[0].disk.data.keys():
                break
        assert self._left() <= self.stores[0].disk.data.keys(), "not all that is left has arrived"

    def _left(self) -> set[DatumId]:
        """Of what there are good copies, replicas too, while all are up: of removed ones traces lie on the disks."""
        return {d.id for s in self.stores.values() for id in s.ids() if (d := s.get(id)) is not None and d.intact}


assert BROADCAST not in range(NODES)
Swarm.TestCase.settings = settings(max_examples=examples(50), stateful_step_count=30, deadline=None)
TestCustody = Swarm.TestCase


#: In parts, so that they can run at the same time.
STORM_PARTS = 4


def weather(seed: int, swarm: Swarm) -> None:
    """Storms over a swarm, and calm in the end."""
    rng = random.Random(seed)
    base, wander, receipts, replicas, lasting, immediate, shared = (
        rng.random() < chance for chance in (0.3, 0.8, 0.5, 0.7, 0.5, 0.3, 0.5)
    )
    left_out: dict[Mechanism, bool] = {
        "receipts": not receipts, "lasting-replicas": not lasting, "overhearing": seed % 2 == 0,
        "distant-replicas": seed % 4 >= 2, "measured-retries": seed % 8 == 0,
    }  # fmt: skip
    swarm.begin(
        base, wander, replicas, immediate, seed % 3 > 0, 0.2 * shared,
        frozenset(name for name, out in left_out.items() if out),
    )  # fmt: skip
    for _ in range(6):
        swarm.storm(rng.getrandbits(32))
        swarm.put(rng.randrange(NODES), rng.randrange(1, 50), USUAL_PRIORITY)
        swarm.memory_agrees_with_itself()
    swarm.teardown()


@pytest.mark.parametrize("part", range(STORM_PARTS))
@pytest.mark.parametrize("storms", extents(280, 30_000))
def test_storms(storms: int, part: int) -> None:
    """The same, many times deeper and from fixed seeds: finds a hand-over not cancelled when data come round."""
    for seed in range(part, storms, STORM_PARTS):
        weather(seed, Swarm())


@pytest.mark.parametrize("seed", [102_474, 207_445])
def test_storms_in_which_two_custodians_left_the_search_to_each_other(seed: int) -> None:
    weather(seed, Swarm())


class FaultySwarm(Swarm):
    """Where a node would be killed and start again, a frame hits a fault: the gate and what is under way stay."""

    def kill(self, i: int, written: bool) -> None:
        self.fault(i)


@pytest.mark.parametrize("storms", extents(50, 5_000))
def test_storms_of_faults(storms: int) -> None:
    for seed in range(storms):
        weather(seed, FaultySwarm())


class Ungated(CommitGate):
    """Lets everything leave at once."""

    def say(self, frames: Sequence[Outgoing]) -> Sequence[Outgoing]:
        return frames


class UngatedSwarm(Swarm):
    make_gate = Ungated


def test_without_the_gate_the_storms_find_data_that_are_on_no_disk() -> None:
    with pytest.raises(AssertionError, match="in custody on no disk"):  # noqa: PT012
        for seed in range(200):
            weather(seed, UngatedSwarm())


def test_if_taken_left_before_the_commit_the_storms_would_find_a_loss_that_nobody_knows_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node whose replica is not on disk yet is asked to take the datum back, says so, and crashes. (Seed 430.)"""
    monkeypatch.setitem(KINDS, CopyStatuses, KINDS[CopyStatuses]._replace(rests=KINDS[Beacon].rests))
    with pytest.raises(AssertionError, match="nobody knows"):  # noqa: PT012
        for seed in range(425, 3000):
            weather(seed, Swarm())


def test_if_beacons_repeated_answers_before_the_commit_the_storms_would_find_a_loss(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No beacon waits for the disk."""
    repeat = Node._answers_again

    def at_once(node: Node) -> tuple[Committed, ...]:
        with monkeypatch.context() as patched:
            patched.setattr(DurableStore, "durable", lambda store, id: True)
            return repeat(node)

    monkeypatch.setattr(Node, "_answers_again", at_once)
    with pytest.raises(AssertionError, match="in custody on no disk"):  # noqa: PT012
        for seed in range(1000):
            weather(seed, Swarm())
