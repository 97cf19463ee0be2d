"""Nothing rests for ever: some turns after the last attacker or fault is gone, each datum in custody that has a route
has been offered again. Hypothesis looks for a world in which it is not so."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, NamedTuple, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Data, Offer
from rass_mav.core.settings import Mechanism
from rass_mav.errors import MalformedError
from rass_mav.lab.hostile.kinds import KINDS
from rass_mav.lab.swarm.scenario import load_scenario
from rass_mav.lab.swarm.world import World
from rass_mav.mavlink.tunnel import tunnel_from_datagram
from rass_mav.wire import decode
from tests.extent import examples

#: The turns of docs/explanation/guarantees.md, in which a datum in custody is offered.
TURNS = 600
#: After an attacker has left, its last frames are still believed for some steps.
ECHO = 5


class Visit(NamedTuple):
    """An attacker, and beside which node it is."""

    kind: str
    near: int


class Place(NamedTuple):
    """A small world, until its last attacker and fault are gone."""

    nodes: int
    topology: str
    seed: int
    end: int
    visits: tuple[Visit, ...]
    kills: tuple[tuple[int, int, int], ...]
    """Step, node, and for how many steps it is off."""
    keys: tuple[str, ...]


def key(name: str, *values: Any) -> st.SearchStrategy[str]:
    return st.sampled_from(values).map(lambda value: f"{name}={value}")


@st.composite
def places(draw: st.DrawFn) -> Place:
    nodes, end = draw(st.integers(3, 9)), draw(st.sampled_from([30, 60, 100]))
    node = st.integers(0, nodes - 1)
    visits = draw(st.lists(st.builds(Visit, st.sampled_from(sorted(KINDS)), node), max_size=2))
    kills = draw(st.lists(st.tuples(st.integers(5, end - 1), node, st.sampled_from([1, 5, 15])), max_size=2))
    keys = [
        key("radio.loss", 0, 0.1, 0.2, 0.4), key("policy.name", "survival", "hop-count"),
        key("custody.replicas", "true", "false"), key("node.forward", "immediate", "step"),
        key("store.capacity_items", 50, 100), key("data.interval_steps", 3, 10),
        key("traffic.picture_bytes", 0, 300),
        st.sets(st.sampled_from(get_args(Mechanism)), max_size=3).map(lambda names: f"without={sorted(names)}"),
    ]  # fmt: skip
    return Place(
        nodes, draw(st.sampled_from(["line", "grid"])), draw(st.integers(0, 1 << 16)), end, tuple(visits),
        tuple(kills), tuple(draw(k) for k in keys),
    )  # fmt: skip


class Watched:
    """A world, and who has offered what since `begin`."""

    def __init__(self, place: Place) -> None:
        hostile = ", ".join(f"{{kind: {v.kind}, near: {v.near}, begin: 5, end: {place.end}}}" for v in place.visits)
        keys = [
            f"hostile=[{hostile}]", f"nodes={place.nodes}", f"topology={place.topology}", f"seed={place.seed}",
            f"data.until_step={place.end}", "traffic.picture_interval_steps=17", "failures.wipe_rate=1.0e-12",
        ]  # fmt: skip
        self.offered: defaultdict[int, set[DatumId]] = defaultdict(set)
        self.world = World(load_scenario("hostile", {}, [*keys, *place.keys]), record=self._record)
        for t in range(place.end):
            for step, node, off in place.kills:
                if step == t and node not in self.world.off:
                    self.world.crash(node, min(place.end, t + off))
            self.world.run(1)
        self.world.run(ECHO)

    def _record(self, frame: bytes, step: int) -> None:
        fields = tunnel_from_datagram(frame)
        try:
            message = None if fields is None else decode(fields[5], 0.0)
        except MalformedError:
            # Of an attacker.
            return
        if isinstance(message, Data) and not message.replica:
            self.offered[message.sender].update(datum.id for _, datum in message.handovers)
        elif isinstance(message, Offer):
            self.offered[message.sender].add(message.id)

    def resting(self, turns: int) -> dict[int, set[DatumId]]:
        """By node, what is in its custody all the time and is not offered, until it has had for so many turns a route
        to a base by a neighbour that had space."""
        drones = [agent.node for agent in self.world.agents if not agent.node.base]
        resting = {node.id: set(node.holdings.custody) for node in drones}
        left = dict.fromkeys(resting, turns)
        self.offered.clear()
        for _ in range(2 * turns):
            self.world.run(1)
            for node in drones:
                way = node.routing.neighbours.get(-1 if node.routing.next_hop is None else node.routing.next_hop)
                left[node.id] -= node.routing.route is not None and way is not None and bool(way.beacon.free)
                resting[node.id] &= node.holdings.custody.keys() - self.offered[node.id]
            if not any(resting.values()):
                return {}
            if min(left.values()) < 0:
                break
        return {id: data for id, data in resting.items() if data and left[id] <= 0}


@pytest.mark.no_cover
@settings(max_examples=examples(8), deadline=None)
@given(places())
def test_what_is_in_custody_and_has_a_route_is_offered_again(place: Place) -> None:
    assert not Watched(place).resting(TURNS)
