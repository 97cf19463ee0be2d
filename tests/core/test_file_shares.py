"""Shares of redundant files: no drone keeps a replica of one, and those of a file take different ways."""

from __future__ import annotations

from collections import Counter

import pytest

from rass_mav.core.datum import Kind
from rass_mav.core.messages import Data, Receipt, Summary

from .replica_net import CHAIN, RISKS, Net

#: Node 1 hears three others, each of which hears the base.
STAR = [(1, 2), (1, 3), (1, 4), (2, 0), (3, 0), (4, 0)]


def taken(net: Net, kind: int, count: int, by: int) -> Counter[int]:
    """Who gets how many of the data that a node creates."""
    ids = {net.put(by, b"%d" % number, kind) for number in range(count)}
    took: Counter[int] = Counter()
    for _ in range(6):
        net.step()
        for message in net.said:
            if type(message) is Data and message.sender == by and not message.replica:
                took.update([message.target] * sum(h.datum.id in ids for h in message.handovers))
    assert net.replicas(next(iter(ids))) == [] or kind != Kind.SHARE
    return took


def test_of_a_share_nobody_keeps_a_replica() -> None:
    net = Net(RISKS, CHAIN, copies_auto=True)
    net.step(12)
    share, part = net.put(1, b"share", Kind.SHARE), net.put(1, b"part", Kind.PART)
    for _ in range(6):
        net.step()
        assert net.replicas(share) == []
        assert net.custody(share) == net.custody(part)
    assert net.replicas(part) != []
    assert net.book.copies[share] == 1


@pytest.mark.parametrize("policy", ["survival", "rass"])
def test_shares_of_one_file_take_different_ways(policy: str) -> None:
    net = Net(dict.fromkeys(range(5), 0.0), STAR, base=0, policy=policy)
    net.step(20)
    assert len(taken(net, Kind.PART, 9, 1)) == 1
    assert sorted(taken(net, Kind.SHARE, 9, 1).items()) == [(2, 3), (3, 3), (4, 3)]


def test_shares_that_a_base_took_stay_until_its_receipt() -> None:
    net = Net({0: 0.0, 1: 0.5}, [(0, 1)], base=0, mirror_until_receipt=True)
    net.step(12)
    net.loses = lambda message: type(message) in (Receipt, Summary)
    id = net.put(1, b"share", Kind.SHARE)
    net.step(2)
    assert id in net.nodes[0].custody_store.arrived
    assert net.replicas(id) == [1], "anybody can claim to be a base"


def test_where_no_base_is_reached_shares_do_not_rest_on_one_drone() -> None:
    net = Net(dict.fromkeys(range(1, 5), 0.0), [(1, 2), (1, 3), (1, 4), (2, 3)], policy="survival")
    net.step(4)
    shares = [net.put(1, b"%d" % number, Kind.SHARE) for number in range(16)]
    part = net.put(1, b"part", Kind.PART)
    net.step(8)
    held = Counter(tuple(net.custody(id)) for id in shares)
    assert held == {(1,): 4, (2,): 4, (3,): 4, (4,): 4}
    assert net.custody(part) == [1]
    # They stay where they are.
    places = {id: net.custody(id) for id in shares}
    net.step(8)
    assert {id: net.custody(id) for id in shares} == places
