"""Distant replicas: data that rest have copies out of their custodian's radio range."""

from __future__ import annotations

from typing import Any

import pytest

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BEACON_BASE, CopyStatus, CopyStatusEntry, CopyStatuses, Data, PassedOn, Route
from rass_mav.core.replicas.distant import REST_TURNS

from .build import beacon
from .replica_net import Net

#: Where there is no base, data gather at node 1, the safest; 2 is next to it, and so on.
LINE = {i: 0.1 * i for i in range(1, 7)}
LINKS = [(i, i + 1) for i in range(1, 6)]
ISLAND: dict[str, Any] = {"mirror_until_receipt": True, "distant": True}


def island(links: list[tuple[int, int]] | None = None, **settings: Any) -> tuple[Net, DatumId]:
    """A datum that rests at node 1."""
    net = Net(LINE, LINKS if links is None else links, **{**ISLAND, **settings})
    net.step()
    id = net.put(1)
    net.step()
    assert (net.custody(id), net.active(id)) == ([1], [2])
    return net, id


def chain(net: Net, id: DatumId) -> list[int | None]:
    """The custodian, its holder, the holder of that, ..."""
    [custodian] = net.custody(id)
    found: list[int | None] = [custodian, net.holder(custodian, id)]
    while found[-1] is not None:
        holding = net.nodes[found[-1]].holdings.get(id)
        assert holding is not None
        found.append(None if holding.holder is None else holding.holder.id)
    return found[:-1]


def distant(net: Net) -> list[Data]:
    return [message for message in net.of(Data) if message.distance is not None]


def test_what_rests_gets_a_chain_of_copies_that_leads_away() -> None:
    net, id = island()
    net.step(REST_TURNS - 1)
    assert chain(net, id) == [1, 2]
    net.step(6)
    assert chain(net, id) == [1, 2, 3, 4, 5]
    net.step(30)
    assert net.active(id) == [2, 3, 4, 5]
    assert distant(net) == []


def test_a_neighbour_of_the_custodian_refuses_and_another_is_asked() -> None:
    # 3 is safer than 4, but hears 1.
    net, id = island([*LINKS, (1, 3), (2, 4)])
    net.step(8)
    assert chain(net, id)[:3] == [1, 2, 4]


def test_the_chain_keeps_away_from_the_custodian_and_not_only_from_the_last_node() -> None:
    # 4 hears 1, and 5 does not.
    net, id = island([*LINKS, (3, 5), (1, 4)])
    net.step(10)
    assert chain(net, id)[:4] == [1, 2, 3, 5]


def test_an_enclosed_holder_says_so_and_another_is_chosen() -> None:
    # 2 is the safest neighbour of 1, and hears 3 only, which hears 1.
    net, id = island([(1, 2), (1, 3), (2, 3), (3, 4), (4, 5)])
    told = []
    for _ in range(8):
        net.step()
        told += net.of(CopyStatuses)
    assert CopyStatuses(2, 1, (CopyStatusEntry(id, CopyStatus.ENCLOSED),)) in told
    assert chain(net, id)[:3] == [1, 3, 4]


def test_an_enclosed_holder_stays_if_there_is_no_other() -> None:
    net, id = island([(1, 2), (2, 3), (1, 3)])
    net.step(40)
    assert [len(chain(net, id)), net.custody(id)] == [2, [1]]
    assert sum(node.pace.sent for node in net.nodes.values()) < 20


def test_a_lost_link_of_the_chain_is_replaced() -> None:
    net, id = island()
    net.step(8)
    net.strike(3, id)
    net.step()
    assert chain(net, id)[:2] == [1, 2]
    net.step(3)
    assert chain(net, id) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("dead", [{1}, {1, 2}, {1, 2, 3}, {1, 2, 3, 4}])
def test_what_is_left_of_the_chain_takes_custody(dead: set[int]) -> None:
    net, id = island()
    net.step(8)
    net.off |= dead
    net.step(40)
    [custodian] = set(net.custody(id)) - dead
    assert custodian not in dead
    if len(dead) < 4:
        assert set(net.active(id)) - dead


def test_a_corrupt_custodian_gets_the_datum_back_and_the_chain_stays() -> None:
    net, id = island()
    net.step(8)
    net.strike(1, id)
    sent = []
    for _ in range(4):
        net.step()
        sent += distant(net)
    assert chain(net, id) == [1, 2, 3, 4, 5]
    assert sent == []


def test_a_chain_that_nobody_needs_is_told() -> None:
    net, id = island()
    net.step(8)
    # A safer place has come into range of 1.
    net.nodes[1].custody_store.give_away(net.nodes[1].holdings.custody[id], 9)
    told = []
    for _ in range(5):
        net.step()
        told += [(m.sender, m.target) for m in net.of(PassedOn)]
    assert told == [(1, 2), (2, 3), (3, 4), (4, 5)]
    assert net.active(id) == [1]
    assert net.replicas(id) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    "settings", [{"distant": False}, {"mirror_until_receipt": False}, {"inline_bytes": 11}, {"receipts": False}]
)
def test_without_the_setting_or_for_large_data_there_is_no_chain(settings: dict[str, Any]) -> None:
    net, id = island(**settings)
    net.step(12)
    assert net.active(id) == [2]


def test_with_a_base_in_reach_nothing_distant_is_sent() -> None:
    net = Net({0: 0.0, **LINE}, [(0, 6), *LINKS], base=0, **ISLAND)
    net.step(12)
    net.loses = lambda message: isinstance(message, Data) and message.target == 0
    id = net.put(5)
    for _ in range(10):
        net.step()
        assert distant(net) == []
    assert net.custody(id)
    assert net.active(id)


def test_a_distant_replica_whose_custodian_is_gone_waits_for_the_receipt_where_a_base_is_in_reach() -> None:
    net, id = island()
    net.step(8)
    net.off |= {3}
    for _ in range(40):
        net.step()
        number = int(net.now)
        net.nodes[4].receive(beacon(7, number, Route(7, 9, number, 0), flags=BEACON_BASE, potential=2), net.now)
    assert id in net.nodes[4].holdings.passed_on
    assert net.custody(id) == [1]
