"""What must hold for the routes of many nodes together: over a bad network, with turns of different length, and with
clocks that drift."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.messages import Beacon
from rass_mav.core.routes.announcements import newer
from rass_mav.core.routes.ranks import CHANGE_OVER_HOPS
from tests.extent import examples, seeds
from tests.some import some

from .build import make_node
from .routing_harness import NEIGHBOUR_STEPS, Swarm, rough_times
from .test_cost_routing import cheapest, costs

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


@settings(max_examples=examples(30), deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.integers(0, 1 << 32))
def test_no_cycles_ever_and_the_right_hop_counts_once_the_network_heals(seed: int) -> None:
    swarm = rough_times(seed)
    for _ in range(60):
        swarm.turn()
    swarm.check()
    if swarm.seq_period:
        nearest, found = swarm.distances(), swarm.hops()
        assert set(found) == set(nearest)
        # Between bases a node stays with its own for a detour of less than CHANGE_OVER_HOPS.
        detour = CHANGE_OVER_HOPS - 1 if len(swarm.bases) > 1 else 0
        assert all(nearest[i] <= found[i] <= nearest[i] + detour for i in nearest), (nearest, found)
    else:
        # Without periodical numbers a node asks for one only when it has no route at all, so it may keep a detour.
        assert set(swarm.hops()) == set(swarm.distances())


def line(size: int, **more: Any) -> Swarm:
    """Node 0 is the base; 0 - 1 - 2 - ..."""
    swarm = Swarm(random.Random(1), size, 1, **more)
    swarm.links = {frozenset((i, i + 1)) for i in range(size - 1)}
    for _ in range(2 * size):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(size)}
    return swarm


@pytest.mark.parametrize("size", [3, 12])
def test_routes_to_a_vanished_base_die_out_in_hops_plus_lifetime_steps(size: int) -> None:
    swarm = line(size)
    # A ring at the far end, where Alg. 2 as written would count to infinity.
    swarm.links.add(frozenset((size - 1, 1)))
    swarm.kill(0)
    for _ in range(size + NEIGHBOUR_STEPS + 2):
        swarm.turn()
        assert max(swarm.hops().values(), default=0) <= size
    assert swarm.hops() == {}


def test_a_cut_link_is_routed_around_although_the_way_is_longer() -> None:
    # Without a periodical new number: the request does it.
    swarm = line(6, seq_period=0)
    swarm.links |= {frozenset((0, 5))}
    swarm.links -= {frozenset((0, 1))}
    for _ in range(30):
        swarm.turn()
    assert swarm.hops() == {0: 0, 5: 1, 4: 2, 3: 3, 2: 4, 1: 5}


def test_a_base_killed_and_restarted_goes_on_with_higher_numbers() -> None:
    swarm = line(5)
    before = swarm.nodes[0].routing.number
    swarm.kill(0)
    swarm.start(0)
    swarm.turn()
    assert newer(swarm.nodes[0].routing.number, before)
    for _ in range(10):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(5)}


def test_a_wiped_base_is_another_base() -> None:
    swarm = line(5)
    old = swarm.nodes[0].store.epoch
    swarm.wipe(0)
    for _ in range(NEIGHBOUR_STEPS + 3):
        swarm.turn()
    swarm.start(0)
    for _ in range(12):
        swarm.turn()
    assert swarm.hops() == {i: i for i in range(5)}
    route = some(swarm.nodes[4].routing.route)
    assert route.base_life == swarm.nodes[0].store.epoch != old


# -- turns of different length, which change ---------------------------------------------------------------------------


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


# -- clocks that drift -------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("policy", ["rass", "survival"])
@settings(max_examples=examples(20), deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
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


@settings(max_examples=examples(20), deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
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
