"""Many nodes that only say beacons, over a bad network.

Whole nodes are used, not bare routing tables: the number of a base and the wait after a restart are theirs.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence

from rass_mav.core.datum import Fate
from rass_mav.core.messages import Beacon
from rass_mav.core.node import Node
from rass_mav.core.routes.table import MAX_HOPS

from .build import make_node
from .durable import DurableStore

NEIGHBOUR_STEPS = 3


class Swarm:
    """Nodes on a graph. They step at different moments of a turn; frames are lost, doubled and delayed."""

    def __init__(
        self,
        rng: random.Random,
        size: int,
        bases: int,
        *,
        seq_period: int = 30,
        policies: Sequence[str] = ("rass",),
        queue_toll: bool = False,
    ) -> None:
        """Nodes follow `policies` in turn."""
        self.rng = rng
        self.policies = policies
        self.queue_toll = queue_toll
        self.risks = dict.fromkeys(range(size), 0.0)
        self.bases = set(range(bases))
        self.seq_period = seq_period
        self.stores = {i: DurableStore(epoch=1000 + i) for i in range(size)}
        self.now = 0.0
        self.lives = 0
        self.nodes: dict[int, Node] = {}
        for i in range(size):
            self.start(i)
        self.phase = {i: rng.choice([0.0, 0.2, 0.5, 0.8]) for i in range(size)}
        self.links: set[frozenset[int]] = set()
        self.air: list[tuple[float, int, Beacon]] = []
        self.loss = self.duplicate = self.late = 0.0

    def start(self, i: int) -> None:
        self.lives += 1
        self.nodes[i] = make_node(
            i,
            store=self.stores[i],
            base=i in self.bases,
            now=self.now,
            seed=self.lives,
            policy=self.policies[i % len(self.policies)],
            risk=self.risks[i],
            seq_period=self.seq_period,
            queue_toll=self.queue_toll,
            neighbour_steps=NEIGHBOUR_STEPS,
            newborn=self.now == 0.0,
        )

    def kill(self, i: int) -> None:
        """kill -9."""
        del self.nodes[i]
        self.stores[i] = self.stores[i].crashed()

    def wipe(self, i: int) -> None:
        self.nodes.pop(i, None)
        self.stores[i] = DurableStore(epoch=self.rng.getrandbits(32))

    def sense(self, spread: float) -> None:
        """Everybody's risk changes a little."""
        for i, risk in self.risks.items():
            self.risks[i] = min(max(risk + self.rng.uniform(-spread, spread), 0.0), 1.0)
            if i in self.nodes:
                self.nodes[i].risk.observe(self.risks[i], self.now)

    def queue(self, i: int, count: int) -> None:
        """From now on this many data wait at a node. (No data are delivered here, so they stay.)"""
        node = self.nodes[i]
        while len(node.holdings.custody) < count:
            node.put(b"waits", self.now)
        for holding in list(node.holdings.custody.values())[count:]:
            node.custody_store.drop(holding, Fate.PASSED_ON)

    def random_links(self, density: float) -> None:
        size = len(self.stores)
        self.links = {frozenset((a, b)) for a in range(size) for b in range(a) if self.rng.random() < density}

    def turn(self) -> None:
        """One step of each node, each at its own moment, with all that is due on the air before it."""
        start = self.now
        for i in sorted(self.phase, key=lambda i: (self.phase[i], i)):
            self.now = start + self.phase[i]
            self._deliver()
            node = self.nodes.get(i)
            if node is not None:
                beacon = node.step(self.now)[0]
                node.store.commit()  # type: ignore[attr-defined]
                assert isinstance(beacon, Beacon)
                self._say(i, beacon)
                self.check()
        self.now = start + 1.0

    def _say(self, sender: int, beacon: Beacon) -> None:
        for hearer in self.stores:
            if frozenset((sender, hearer)) not in self.links:
                continue
            for _ in range(2 if self.rng.random() < self.duplicate else 1):
                if self.rng.random() >= self.loss:
                    delay = self.rng.uniform(0.0, 1.0) if self.rng.random() < self.late else 0.0
                    self.air.append((self.now + delay, hearer, beacon))

    def _deliver(self) -> None:
        due = [frame for frame in self.air if frame[0] <= self.now]
        self.air = [frame for frame in self.air if frame[0] > self.now]
        for at, hearer, beacon in due:
            if hearer in self.nodes:
                self.nodes[hearer].receive(beacon, at)

    def check(self) -> None:
        """No cycle of next hops, and hop counts within their bound."""
        for i, node in self.nodes.items():
            assert node.routing.route is None or node.routing.hops <= MAX_HOPS
            at = i
            seen: set[int] = set()
            while True:
                assert at not in seen, f"cycle of next hops through {sorted(seen)} at {self.now}"
                seen.add(at)
                routing = self.nodes[at].routing
                following = routing.next_hop
                if following is None or following not in self.nodes:
                    break
                at = following

    def distances(self) -> dict[int, int]:
        """Breadth-first hop counts from the nearest base, over nodes that are alive."""
        found = {b: 0 for b in self.bases if b in self.nodes}
        queue = deque(found)
        while queue:
            at = queue.popleft()
            for other in self.nodes:
                if other not in found and frozenset((at, other)) in self.links:
                    found[other] = found[at] + 1
                    queue.append(other)
        return found

    def hops(self) -> dict[int, int]:
        return {i: n.routing.hops for i, n in self.nodes.items() if n.routing.route is not None}


def rough_times(seed: int, policies: Sequence[str] = ("rass",)) -> Swarm:
    """Forty turns of loss, delay, moving links, kills and wipes; then the network is perfect and everybody is up."""
    rng = random.Random(seed)
    size = rng.randint(5, 15)
    swarm = Swarm(rng, size, rng.randint(1, 3), seq_period=rng.choice([0, 2, 10]), policies=policies)
    swarm.loss, swarm.duplicate, swarm.late = rng.choice([0.0, 0.3, 0.7]), 0.2, rng.choice([0.0, 0.5])
    down: dict[int, int] = {}
    noise = 0.0 if policies == ("rass",) else rng.choice([0.0, 0.02, 0.3])
    for turn in range(40):
        if rng.random() < 0.3 or not turn:
            swarm.random_links(rng.choice([0.15, 0.3, 0.6]))
        victim = rng.randrange(size)
        event = rng.choice(["none", "none", "kill", "wipe"])
        if event == "kill" and victim in swarm.nodes:
            swarm.kill(victim)
            down[victim] = turn + rng.choice([0, 0, 2, 6])
        elif event == "wipe" and victim in swarm.nodes:
            swarm.wipe(victim)
            down[victim] = turn + rng.choice([0, 0, 2, 6])
        for i in [i for i, until in down.items() if until <= turn]:
            del down[i]
            swarm.start(i)
        if noise:
            swarm.sense(noise)
        swarm.turn()
    for _ in range(NEIGHBOUR_STEPS + 3):
        swarm.turn()
    for i in down:
        swarm.start(i)
    swarm.loss = swarm.duplicate = swarm.late = 0.0
    return swarm
