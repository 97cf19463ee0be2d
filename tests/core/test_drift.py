"""Clocks that drift: every node's clock runs at a rate of its own, so who turns before whom changes all the time."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import Beacon
from tests.extent import examples

from .build import make_node
from .routing_harness import NEIGHBOUR_STEPS, Swarm
from .test_cost_routing import cheapest, costs

ONLY = [Phase.explicit, Phase.reuse, Phase.generate]


class Drifting(Swarm):
    """`now` is true time; a node knows only its own clock, which shows rate x true time."""

    def __init__(self, rng: random.Random, size: int, bases: int, *, drift: float, policies: Sequence[str]) -> None:
        """`drift`: rates lie in 1 - drift .. 1 + drift."""
        self.rates = {i: rng.uniform(1.0 - drift, 1.0 + drift) for i in range(size)}
        super().__init__(rng, size, bases, seq_period=2, policies=policies)
        self.due = dict(self.phase)

    def start(self, i: int) -> None:
        super().start(i)
        self.nodes[i] = make_node(
            i, store=self.stores[i], base=i in self.bases, now=self.now * self.rates[i], seed=self.lives,
            policy=self.policies[i % len(self.policies)], risk=self.risks[i], seq_period=self.seq_period,
            neighbour_steps=NEIGHBOUR_STEPS, newborn=self.now == 0.0,
        )  # fmt: skip

    def turn(self) -> None:
        """One second of true time."""
        end = self.now + 1.0
        while min(self.due.values()) < end:
            i = min(self.due, key=lambda i: (self.due[i], i))
            self.now = self.due[i]
            self._deliver()
            node = self.nodes.get(i)
            if node is not None:
                beacon = node.step(self.now * self.rates[i])[0]
                node.store.commit()  # type: ignore[attr-defined]
                assert isinstance(beacon, Beacon)
                self._say(i, beacon)
                self.check()
            self.due[i] += 1.0 / self.rates[i]
        self.now = end

    def _deliver(self) -> None:
        due = [frame for frame in self.air if frame[0] <= self.now]
        self.air = [frame for frame in self.air if frame[0] > self.now]
        for at, hearer, beacon in due:
            if hearer in self.nodes:
                self.nodes[hearer].receive(beacon, at * self.rates[hearer])


@pytest.mark.no_cover
@pytest.mark.parametrize("policy", ["rass", "survival"])
@settings(max_examples=examples(20), deadline=None, phases=ONLY)
@given(seed=st.integers(0, 1 << 32))
def test_no_cycles_with_drifting_clocks_lost_beacons_and_bases_that_come_and_go(policy: str, seed: int) -> None:
    rng = random.Random(seed)
    size = rng.randint(5, 12)
    # A crystal drifts by 0.01 %, so this is a swarm over months.
    swarm = Drifting(rng, size, rng.randint(1, 2), drift=rng.choice([0.001, 0.02]), policies=(policy,))
    swarm.random_links(rng.choice([0.3, 0.6]))
    swarm.loss = 0.3
    for turn in range(100):
        base = rng.choice(sorted(swarm.bases))
        if turn % 20 == 10 and base in swarm.nodes:
            swarm.wipe(base) if rng.random() < 0.5 else swarm.kill(base)
        elif turn % 20 == 0:
            for i in swarm.bases - swarm.nodes.keys():
                swarm.start(i)
        swarm.sense(rng.choice([0.0, 0.05, 0.5]))
        if rng.random() < 0.05:
            swarm.random_links(rng.choice([0.3, 0.6]))
        swarm.turn()


@settings(max_examples=examples(20), deadline=None, phases=ONLY)
@given(seed=st.integers(0, 1 << 32))
def test_costs_become_right_with_drifting_clocks(seed: int) -> None:
    rng = random.Random(seed)
    swarm = Drifting(rng, rng.randint(4, 9), 1, drift=0.02, policies=("survival",))
    swarm.risks = {i: rng.random() for i in swarm.risks}
    swarm.sense(0.0)
    swarm.random_links(0.5)
    for _ in range(60):
        swarm.turn()
    assert costs(swarm) == cheapest(swarm)
