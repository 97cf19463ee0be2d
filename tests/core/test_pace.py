"""A node on a slow link turns less often; its neighbours, and its own routes, wait accordingly."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.core.messages import Beacon, Committed, CopyStatus, CopyStatuses, Data, Handover, Route
from rass_mav.core.routes.costs import COST_ONE, NO_COST
from rass_mav.core.routes.table import HOLD_LIFETIMES

from .books import holders
from .build import beacon, datum, make_node, of
from .durable import DurableStore

BASE = Route(1, 11, 5, 0)


def test_the_beacon_says_the_turn_only_when_it_is_longer_than_a_step() -> None:
    node = make_node(2, newborn=True)
    [usual] = of(Beacon, node.step(0.0))
    assert usual.turn == 0
    node.keep_pace(9.0, 3, 1.0)
    [slow] = of(Beacon, node.step(9.0))
    assert slow.turn == 90
    node.keep_pace(0.2, 3, 10.0)
    assert (node.pace.turn_s, of(Beacon, node.step(10.0))[0].turn) == (1.0, 0)


def test_a_neighbour_lives_as_long_as_its_own_turn_says() -> None:
    node = make_node(2, newborn=True)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.receive(beacon(3, 0)._replace(turn=90), -9.0)
    node.receive(beacon(3, 1)._replace(turn=90), 0.0)
    node.step(3.4)
    assert set(node.routing.neighbours) == {1, 3}
    node.step(4.0)
    assert set(node.routing.neighbours) == {3}
    node.step(31.0)
    assert set(node.routing.neighbours) == {3}
    node.step(32.0)
    assert not node.routing.neighbours
    # It comes back. What it said once of its turn does not count yet, but it is known when it is heard again.
    node.receive(beacon(3, 2)._replace(turn=90), 40.0)
    node.step(44.0)
    assert not node.routing.neighbours
    node.receive(beacon(3, 3)._replace(turn=90), 49.0)
    node.step(60.0)
    assert set(node.routing.neighbours) == {3}
    # It becomes faster: the shorter lifetime counts again.
    node.receive(beacon(3, 4), 61.0)
    node.step(65.0)
    assert not node.routing.neighbours


def test_a_route_is_held_for_as_long_as_the_slowest_neighbour_remembers_it() -> None:
    node = make_node(2, newborn=True)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.receive(beacon(3, 0)._replace(turn=90), -9.0)
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
        if t % 9 == 0:
            node.receive(beacon(3, number)._replace(turn=90), t)
        node.step(t + 0.5)
        if node.routing.route is not None and node.routing.route.base == 7 and changed is None:
            changed = t + 0.5
        if node.routing.route is not None and node.routing.route.base == 1:
            announced = t + 0.5
    assert changed is not None
    assert changed >= announced + hold


def test_hand_overs_are_within_what_the_link_bears_and_repeated_after_two_turns() -> None:
    node = make_node(2, newborn=True)
    for n in range(5):
        node.put(bytes([n + 1]), 0.0)
    node.keep_pace(5.0, 2, 0.0)
    node.receive(beacon(1, 1, BASE, flags=1, potential=0xFFFFFFFF), 0.0)
    [first] = of(Data, node.step(0.0))
    assert len(first.handovers) == 2
    node.receive(beacon(1, 2, BASE, flags=1, potential=0xFFFFFFFF), 5.0)
    [others] = of(Data, node.step(5.0))
    assert len(others.handovers) == 2
    node.receive(beacon(1, 3, BASE, flags=1, potential=0xFFFFFFFF), 10.0)
    [again] = of(Data, node.step(10.0))
    assert [h.number for h in again.handovers] == [h.number for h in first.handovers]


def test_after_a_restart_the_old_turn_decides_how_long_to_wait() -> None:
    store = DurableStore(epoch=5)
    node = make_node(2, store=store, newborn=True)
    node.keep_pace(9.0, 2, 0.0)
    node.receive(beacon(1, 1, BASE), 0.0)
    node.step(0.0)
    assert node.routing.hops == 1
    store.commit()
    again = make_node(2, store=store, now=1.0, newborn=False)
    hold = HOLD_LIFETIMES * 3.5 * 9.0
    takes = None
    kept = []
    for t in range(1, 100):
        again.keep_pace(1.0, 2, t)
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


def test_a_cost_table_waits_for_a_slow_neighbour_and_holds_for_it() -> None:
    node = make_node(2, policy="survival", newborn=True)
    base: dict[str, Any] = {"flags": 1, "policy": node.policy.tag, "potential": 0xFFFFFFFF}
    node.receive(beacon(1, 0, BASE, **base)._replace(turn=90), -9.0)
    node.receive(beacon(1, 1, BASE, **base)._replace(turn=90), 0.0)
    node.step(0.0)
    assert node.routing.next_hop == 1
    # Nine seconds to its next beacon, and three of them may be missing.
    node.step(31.0)
    assert node.routing.next_hop == 1
    node.step(32.0)
    assert node.routing.next_hop is None
    assert not node.routing.neighbours
    # Whoever counts on the route that it lost may remember it for long: until then this is no shelter for others.
    hold = HOLD_LIFETIMES * 3.5 * 9.0
    [early] = of(Beacon, node.step(31.0 + hold - 1.0))
    assert early.potential == NO_COST
    [late] = of(Beacon, node.step(31.0 + hold + 1.0))
    assert late.potential < NO_COST


def test_a_slow_neighbour_is_as_recent_as_a_fast_one() -> None:
    node = make_node(2, policy="survival", newborn=True)
    near: dict[str, Any] = {"policy": node.policy.tag, "potential": 1000}
    node.receive(beacon(3, 0, Route(1, 11, 5, 1), **near)._replace(turn=90), -9.0)
    node.receive(beacon(3, 1, Route(1, 11, 5, 1), **near)._replace(turn=90), 0.0)
    for number in range(1, 12):
        node.receive(beacon(4, number, Route(1, 11, 5, 1), policy=node.policy.tag, potential=5000), number)
    node.step(11.0)
    assert node.routing.next_hop == 3, "the cheaper one; its next beacon is hardly late"
    node.receive(beacon(4, 12, Route(1, 11, 5, 1), policy=node.policy.tag, potential=5000), 14.0)
    node.step(14.0)
    assert node.routing.next_hop == 4, "half a turn late"


@pytest.mark.parametrize("turn_s", [1.0, 9.0])
def test_replicas_have_the_patience_of_the_slowest(turn_s: float) -> None:
    """Asking after a replica, offering it again, and giving a custodian up."""
    node = make_node(2, mirror=True, newborn=True)
    node.keep_pace(turn_s, 3, 0.0)
    number = 0

    def hear(now: float) -> None:
        nonlocal number
        number += 1
        about = beacon(3, number, free=50)
        node.receive(about._replace(turn=round(turn_s * 10) if turn_s > 1 else 0), now)

    hear(0.0)
    id = node.put(b"x", 0.0)
    [offer] = [m for m in of(Data, node.step(0.0)) if m.replica]
    hear(turn_s)
    assert not [m for m in of(Data, node.step(turn_s)) if m.replica], "offered, and not answered yet"
    hear(2 * turn_s)
    [again] = [m for m in of(Data, node.step(2 * turn_s)) if m.replica]
    assert again.handovers[0].number != offer.handovers[0].number
    node.receive(Committed(3, 2, ((again.handovers[0].number, again.handovers[0].datum.crc),), ()), 2 * turn_s)
    assert holders(node) == {id: 3}
    # A replica of somebody else's: asked after in time, and taken back when its custodian is gone.
    node.receive(Data(3, 2, (Handover(7, datum()),), True), 2 * turn_s)
    asked, gone = [], None
    for turn in range(3, 40):
        now = turn * turn_s
        said = node.step(now)
        asked += [now for m in of(CopyStatuses, said) if m.entries[0].status == CopyStatus.STILL]
        if gone is None and datum().id in node.holdings.custody:
            gone = now
    assert asked[0] == 22 * turn_s
    assert gone == (2 + 29) * turn_s, "eight lifetimes of three and a half turns after its last beacon"


def test_what_a_slow_node_announced_is_remembered_when_it_has_become_fast() -> None:
    """Somebody may shelter with it because of what it said at that time; it must not shelter with them."""
    node = make_node(2, policy="survival", newborn=True)
    node.keep_pace(9.0, 3, 0.0)
    [safe] = of(Beacon, node.step(0.0))
    node.risk.observe(0.9, 1.0)
    moved = None
    for t in range(1, 200):
        node.keep_pace(1.0, 3, t)
        dearer = beacon(3, t, policy=node.policy.tag, potential=safe.potential + COST_ONE // 2)
        node.receive(dearer, t)
        node.step(t)
        if node.routing.next_hop == 3:
            moved = t
            break
    assert moved is not None
    assert moved >= HOLD_LIFETIMES * 3.5 * 9.0
