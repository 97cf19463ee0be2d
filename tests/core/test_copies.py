"""`copies_auto`: as many replicas as the risk asks for. And room for a node's own measurements."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.core.messages import BEACON_BASE, Beacon, Committed, Data, Message, Route
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.core.replicas.offers import TARGET
from rass_mav.errors import StoreFullError

from .books import check_node, holders, replicas_of
from .build import beacon, data, datum, make_node, of

#: The neighbours of node 1: 2 is a base, the others are drones with these risks.
NEAR = {3: 0.01, 4: 0.1, 5: 0.2}


def heard(risks: dict[int, float], number: int, *, base: bool = True) -> list[Beacon]:
    """Beacons of the drones with these risks, and of the base 2."""
    beacons = [beacon(id, number, life=id)._replace(risk=int(risk * 65535)) for id, risk in risks.items()]
    route = Route(2, 1, number // 30, 0)
    return beacons + (
        [beacon(2, number, route, flags=BEACON_BASE, free=0xFFFF, potential=POTENTIAL_BASE)] if base else []
    )


def surrounded(risk: float, *, gone: bool, base: bool = True, **settings: Any) -> tuple[Node, float]:
    """Node 1 at this risk amid `NEAR`. `gone`: other neighbours come and go all the time."""
    node = make_node(1, risk=risk, **{"mirror": True, "immediate": True, "copies_auto": True, **settings})
    now = 0.0
    for number in range(60):
        now = float(number)
        near = {**NEAR, **({50 + number % 7: 0.9} if gone else {})}
        for said in heard(near, number, base=base):
            node.receive(said, now)
        now += 0.5
        node.step(now)
    return node, now


def put(node: Node, now: float) -> tuple[list[Data], list[Data]]:
    """Make a datum: what is handed over, and what is sent as a replica."""
    node.put(b"reading", now)
    frames = of(Data, node.forward(now))
    return [f for f in frames if not f.replica], [f for f in frames if f.replica]


def test_where_nobody_moves_away_a_datum_that_moves_on_gets_no_replica() -> None:
    node, now = surrounded(0.9, gone=False)
    moved, replicas = put(node, now)
    assert [f.target for f in moved] == [2]
    assert replicas == []


def slow(node: Node, now: float, trip: float) -> float:
    """Hand data over to the base, which answers each after a `trip`, turns; returns when the last is answered."""
    turn_s = node.pace.turn_s
    for number in range(60, 80):
        for said in heard(NEAR, number):
            node.receive(said, now)
        moved, _ = put(node, now)
        for frame in moved:
            [(number, held)] = frame.handovers
            node.receive(Committed(2, 1, ((number, held.crc),), ()), now + trip * turn_s)
        now += turn_s
        node.step(now)
    return now


@pytest.mark.parametrize("trip", [0.0, 0.25, 0.9])
@pytest.mark.parametrize("risk", [0.0, 0.05, 0.9])
def test_where_frames_wait_for_the_air_in_danger_they_do_not_wait_alone(risk: float, trip: float) -> None:
    node, now = surrounded(risk, gone=False)
    now = slow(node, now, trip)
    assert replicas_of(node)._offers.gone == 0.0
    struck = risk * trip / 2
    loss, expected = risk * struck, []
    for id, near in sorted(NEAR.items(), key=lambda item: item[1]):
        if loss > 1.0 - TARGET:
            expected.append(id)
            loss *= struck + (1.0 - struck) * near
    moved, replicas = put(node, now)
    assert [f.target for f in moved] == [2]
    assert [f.target for f in replicas] == expected
    assert bool(expected) == (risk * struck > 1.0 - TARGET)


def enough(node: Node, risk: float) -> list[int]:
    """Which of `NEAR` a datum should have replicas on, by the rule of `core.replicas`."""
    gone = replicas_of(node)._offers.gone
    assert 0.05 < gone < 0.5
    loss, chosen = risk, []
    for id, near in sorted(NEAR.items(), key=lambda item: item[1]):
        if loss <= 1.0 - TARGET:
            break
        chosen.append(id)
        loss *= gone + (1.0 - gone) * near
    return chosen


@pytest.mark.parametrize("risk", [0.0, 0.01, 0.05, 0.9])
def test_where_neighbours_come_and_go_new_data_are_not_exposed_alone(risk: float) -> None:
    node, now = surrounded(risk, gone=True)
    expected = enough(node, risk * replicas_of(node)._offers.gone)
    moved, replicas = put(node, now)
    assert [f.target for f in moved] == [2]
    # The safest ones, one after the other until it is safe enough.
    assert [f.target for f in replicas][: len(NEAR)] == expected


def test_the_higher_the_risk_the_more_replicas() -> None:
    counts = [len(put(*surrounded(risk, gone=True))[1]) for risk in (0.0, 0.02, 0.1, 0.9)]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] >= 2


def test_what_rests_alone_gets_one_replica_however_safe_it_is() -> None:
    _, replicas = put(*surrounded(0.0, gone=True, base=False))
    assert [f.target for f in replicas] == [3]


def test_with_one_copy_only_what_rests_gets_a_replica() -> None:
    _, replicas = put(*surrounded(0.9, gone=True, base=False, copies_auto=False))
    assert [f.target for f in replicas] == [3]
    moved, replicas = put(*surrounded(0.9, gone=True, copies_auto=False))
    assert [f.target for f in moved] == [2]
    assert replicas == []


def test_one_more_copy_does_no_harm_when_all_answer() -> None:
    node, now = surrounded(0.9, gone=True, base=False)
    id = node.put(b"reading", now)
    answers: list[Message] = []
    for frame in of(Data, node.forward(now)):
        [(number, held)] = frame.handovers
        answers += node.receive(Committed(frame.target, 1, ((number, held.crc),), ()), now)
    assert answers == []
    assert holders(node)[id] in NEAR
    check_node(node)


def test_offers_that_nobody_answers_are_made_anew_and_stay_bounded() -> None:
    node, now = surrounded(0.9, gone=True, base=False)
    node.put(b"reading", now)
    offers = node.forward(now)
    for number in range(60, 70):
        for said in heard(NEAR, number, base=False):
            node.receive(said, now)
        now += 1.0
        offers += node.step(now)
        check_node(node)
    assert len({f.handovers[0].number for f in of(Data, offers)}) == len(of(Data, offers)) >= 9


# -- bandwidth and room for own measurements ---------------------------------------------------------------------------


def test_a_part_of_the_bandwidth_is_left_for_new_data() -> None:
    node, now = surrounded(0.5, gone=False, bandwidth_items=10, capacity_items=None)
    for s in range(20):
        node.receive(data(3, 1, (s + 1, datum(sequence=s))), now)
    relayed = of(Data, node.forward(now))
    assert sum(len(f.handovers) for f in relayed) == 9
    # What waits has a holder, its sender.
    assert len(node.holdings.custody) == 20
    _, replicas = put(node, now)
    assert [len(f.handovers) for f in replicas] == [1]
    assert replicas[0].handovers[0].datum.id.origin == 1


def test_others_data_leave_room_for_own_measurements() -> None:
    node = make_node(1, capacity_items=5, own_share=0.4)
    assert node.holdings.free() == 5 - 2
    for s in range(4):
        node.receive(data(3, 1, (s + 1, datum(sequence=s))), 0.0)
    assert len(node.holdings.custody) == 3
    assert node.custody_store.refused == 1
    assert of(Beacon, node.step(1.0))[0].free == 0
    own = [node.put(b"own", 1.0) for _ in range(2)]
    assert set(own) < set(node.holdings.custody)
    with pytest.raises(StoreFullError):
        node.put(b"own", 1.0)


def test_the_same_with_bytes() -> None:
    node = make_node(1, capacity_items=None, capacity_bytes=100, own_share=0.4)
    node.receive(data(3, 1, (1, datum(payload=bytes(61)))), 0.0)
    assert len(node.holdings.custody) == 0
    node.receive(data(3, 1, (2, datum(payload=bytes(60)))), 0.0)
    assert len(node.holdings.custody) == 1
    assert node.holdings.free() == 0
    node.put(bytes(40), 0.0)
    assert node.holdings.custody_bytes == 100
