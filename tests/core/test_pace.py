"""A node on a slow link turns less often; its neighbours, and its own routes, wait accordingly."""

from __future__ import annotations

from rass_mav.core.messages import Beacon, Data, Route
from rass_mav.core.routing import HOLD_LIFETIMES

from .build import beacon, make_node, of
from .durable import DurableStore

BASE = Route(1, 11, 5, 0)


def test_the_beacon_says_the_turn_only_when_it_is_longer_than_a_step() -> None:
    node = make_node(2, newborn=True)
    [usual] = of(Beacon, node.step(0.0))
    assert usual.turn == 0
    node.pace(9.0, 3, 1.0)
    [slow] = of(Beacon, node.step(9.0))
    assert slow.turn == 90
    node.pace(0.2, 3, 10.0)
    assert (node.turn_s, of(Beacon, node.step(10.0))[0].turn) == (1.0, 0)


def test_a_neighbour_lives_as_long_as_its_own_turn_says() -> None:
    node = make_node(2, newborn=True)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.receive(beacon(3, 1)._replace(turn=90), 0.0)
    node.step(3.4)
    assert set(node.routing.neighbours) == {1, 3}
    node.step(4.0)
    assert set(node.routing.neighbours) == {3}
    node.step(31.0)
    assert set(node.routing.neighbours) == {3}
    node.step(32.0)
    assert not node.routing.neighbours
    # It comes back faster: the shorter lifetime counts again.
    node.receive(beacon(3, 2)._replace(turn=90), 40.0)
    node.receive(beacon(3, 3), 41.0)
    node.step(45.0)
    assert not node.routing.neighbours


def test_a_route_is_held_for_as_long_as_the_slowest_neighbour_remembers_it() -> None:
    node = make_node(2, newborn=True)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.receive(beacon(3, 1)._replace(turn=90), 0.0)
    node.step(0.5)
    assert node.routing.hops == 1
    announced = 0.5
    hold = HOLD_LIFETIMES * 3.5 * 9.0
    other = Route(7, 77, 1, 0)
    number = 1
    changed = None
    for t in range(1, 90):
        # The base has vanished, another one is near.
        number += 1
        node.receive(beacon(7, number, other), t)
        node.receive(beacon(3, number)._replace(turn=90), t)
        node.step(t + 0.5)
        if node.routing.route is not None and node.routing.route.base == 7 and changed is None:
            changed = t + 0.5
        if node.routing.route is not None and node.routing.route.base == 1:
            announced = t + 0.5
    assert changed is not None
    assert changed >= announced + hold


def test_hand_overs_are_within_what_the_link_bears_and_repeated_once_a_turn() -> None:
    node = make_node(2, newborn=True)
    for n in range(5):
        node.put(bytes([n + 1]), 0.0)
    node.pace(5.0, 2, 0.0)
    node.receive(beacon(1, 1, BASE, flags=1, potential=0xFFFFFFFF), 0.0)
    [first] = of(Data, node.step(0.0))
    assert len(first.handovers) == 2
    node.receive(beacon(1, 2, BASE, flags=1, potential=0xFFFFFFFF), 5.0)
    [again] = of(Data, node.step(5.0))
    assert [h.number for h in again.handovers] == [h.number for h in first.handovers]


def test_after_a_restart_the_old_turn_decides_how_long_to_wait() -> None:
    store = DurableStore(epoch=5)
    node = make_node(2, store=store, newborn=True)
    node.pace(9.0, 2, 0.0)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.step(0.0)
    assert node.routing.hops == 1
    store.commit()
    again = make_node(2, store=store, now=1.0, newborn=False)
    hold = HOLD_LIFETIMES * 3.5 * 9.0
    takes = None
    kept = []
    for t in range(1, 100):
        again.pace(1.0, 2, t)
        kept.append(store.get_meta("turn"))
        again.receive(beacon(1, t + 1, BASE), t)
        again.step(t)
        if again.routing.route is not None:
            takes = t
            break
    assert takes is not None
    assert takes >= 1.0 + hold
    # Fast for long enough: the store has forgotten the old turn, so that the next restart is quick. Not before.
    assert kept[-1] == 0
    assert set(kept[: int(hold)]) == {90}
