"""Nodes on links of different speed: each turns at its own pace, which changes. Routes form no cycle all the same."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest

from rass_mav.core.messages import Beacon
from tests.extent import seeds

from .routing_harness import Swarm


class UnevenSwarm(Swarm):
    """Every node turns only in some of its steps."""

    def __init__(self, rng: random.Random, size: int, bases: int, policies: Sequence[str] = ("rass",)) -> None:
        super().__init__(rng, size, bases, seq_period=rng.choice([0, 2, 10]), policies=policies)
        self.turns = {i: rng.choice([1, 1, 3, 6]) for i in range(size)}
        self.wait = dict.fromkeys(range(size), 0)

    def turn(self) -> None:
        start = self.now
        for i in sorted(self.phase, key=lambda i: (self.phase[i], i)):
            self.now = start + self.phase[i]
            self._deliver()
            node = self.nodes.get(i)
            if node is None:
                self.wait[i] = 0
                continue
            node.keep_pace(float(self.turns[i]), 10, self.now)
            self.wait[i] -= 1
            if self.wait[i] <= 0:
                self.wait[i] = self.turns[i]
                beacon = node.step(self.now)[0]
                assert isinstance(beacon, Beacon)
                self._say(i, beacon)
            node.store.commit()  # type: ignore[attr-defined]
            self.check()
        self.now = start + 1.0


@pytest.mark.no_cover
@pytest.mark.parametrize("policies", [("rass",), ("survival",), ("survival", "rass")])
@pytest.mark.parametrize("seed", seeds(12, 400))
def test_no_cycle_at_any_instant(seed: int, policies: Sequence[str]) -> None:
    rng = random.Random(seed)
    size = rng.randint(4, 10)
    swarm = UnevenSwarm(rng, size, rng.randint(1, 2), policies)
    swarm.loss, swarm.duplicate, swarm.late = rng.choice([0.0, 0.3, 0.6]), 0.2, rng.choice([0.0, 0.5])
    down: dict[int, int] = {}
    for step in range(200):
        if step % 20 == 0 or rng.random() < 0.1:
            swarm.random_links(rng.choice([0.2, 0.4, 0.7]))
        if rng.random() < 0.1:
            swarm.turns[rng.randrange(size)] = rng.choice([1, 2, 6])
        if "survival" in policies:
            swarm.sense(rng.choice([0.0, 0.0, 0.05, 0.5]))
        if rng.random() < 0.05 and len(swarm.nodes) > 2:
            victim = rng.choice(sorted(swarm.nodes))
            swarm.kill(victim)
            down[victim] = step + rng.randint(1, 30)
        for back in [i for i, at in down.items() if at <= step]:
            del down[back]
            swarm.start(back)
        swarm.turn()
    if len(policies) > 1:
        return  # A way does not lead over a node of another policy, so not everybody finds one.
    # Peace: everybody is up, nothing is lost, and everybody finds a way.
    for i in down:
        swarm.start(i)
    swarm.links = {frozenset((i, i + 1)) for i in range(size - 1)}
    swarm.loss = swarm.late = swarm.duplicate = 0.0
    for _ in range(400):
        swarm.turn()
    assert set(swarm.hops()) == set(range(size))


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", seeds(12, 400))
def test_no_cycle_between_shelters_either(seed: int) -> None:
    """No base for most of the time: data gather where it is safest, and this place changes."""
    rng = random.Random(seed)
    size = rng.randint(4, 8)
    swarm = UnevenSwarm(rng, size, 1, ("survival",))
    swarm.loss = rng.choice([0.0, 0.3])
    sheltered = 0
    for step in range(400):
        if step % 40 == 0:
            swarm.random_links(rng.choice([0.4, 0.7]))
        if step % 150 == 5:
            swarm.kill(0)
        elif step % 150 == 145:
            swarm.start(0)
        if rng.random() < 0.1:
            swarm.turns[rng.randrange(size)] = rng.choice([1, 2, 6])
        swarm.sense(rng.choice([0.0, 0.05, 0.3]))
        swarm.turn()
        sheltered += sum(n.routing.route is None and n.routing.next_hop is not None for n in swarm.nodes.values())
    assert sheltered
