"""What was handed on and brings no receipt goes out again by another way: nobody's word alone ends a datum."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from rass_mav.core.custody.custody_store import STATED_TURNS
from rass_mav.core.custody.journal import PATIENCE_TURNS
from rass_mav.core.datum import DatumId
from rass_mav.core.messages import (
    BEACON_BASE,
    UNBOUNDED_FREE,
    Beacon,
    Committed,
    CopyStatus,
    CopyStatuses,
    Data,
    Handover,
    Message,
    ReceiptEntry,
    Route,
)
from rass_mav.core.news.statements import make_receipt
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.core.replicas.unconfirmed import LOOK_TURNS

from .books import check_node
from .build import beacon, datum, make_node, of, passed_on
from .replica_net import Net

LIAR = 9


class Liar:
    """Says that it is the best way there is, takes all data, and drops them."""

    def __init__(self, *, base: bool, passes_on: bool, potential: int) -> None:
        """`base`: it says that it is one. `passes_on`: it says at once that it has passed the datum on."""
        self._potential = potential
        self._base = base
        self._passes_on = passes_on
        self._number = 0

    def beacon(self, route: Route, tag: int) -> Beacon:
        self._number += 1
        return beacon(
            LIAR, self._number, route._replace(hops=0 if self._base else 1), flags=BEACON_BASE if self._base else 0,
            free=UNBOUNDED_FREE, policy=tag, potential=self._potential,
        )  # fmt: skip

    def receive(self, message: Message) -> list[Message]:
        if isinstance(message, Data) and message.target == LIAR:
            taken = tuple((number, datum.crc) for number, datum in message.handovers)
            said: list[Message] = [Committed(LIAR, message.sender, taken, ())]
            if self._passes_on:
                said.append(passed_on(LIAR, message.sender, *[h.datum.id for h in message.handovers]))
            return said
        if isinstance(message, CopyStatuses) and message.target == LIAR:
            asked = [entry.id for entry in message.entries if entry.status == CopyStatus.STILL]
            return [passed_on(LIAR, message.sender, *asked)] if asked else []
        return []


class HostileNet(Net):
    """A net with somebody in it whom nobody made."""

    def __init__(self, *args: Any, liar: Liar | None, near: tuple[int, ...] = (), **settings: Any) -> None:
        super().__init__(*args, mirror_until_receipt=True, receipts=True, **settings)
        self.liar = liar
        self.near = near
        self.forged = False
        """COMMITTED is forged for each hand-over that somebody hears, before it arrives; and it does not arrive."""

    def deliver(self, messages: list[tuple[int, Message]]) -> None:
        queue = list(messages)
        if self.liar is not None:
            base = self.nodes[self.base]
            assert base.routing.route is not None
            shown = self.liar.beacon(base.routing.route, base.policy.tag)
            for i in self.near:
                self.nodes[i].receive(shown, self.now)
        while queue:
            sender, message = queue.pop(0)
            if self.forged and isinstance(message, Data):
                taken = tuple((number, datum.crc) for number, datum in message.handovers)
                queue += [(sender, a) for a in self.nodes[sender].receive(
                    Committed(message.target, sender, taken, ()), self.now
                )]  # fmt: skip
                continue
            if self.liar is not None and sender in self.near:
                for answer in self.liar.receive(message):
                    to = answer.target  # type: ignore[union-attr]
                    queue += [(to, more) for more in self.nodes[to].receive(answer, self.now)]
            for i, node in self.nodes.items():
                if i in self.off or frozenset((i, sender)) not in self.links:
                    continue
                if getattr(message, "target", 0xFFFF) in (i, 0xFFFF):
                    queue += [(i, answer) for answer in node.receive(message, self.now)]
                    queue += [(i, more) for more in self.forwarded(node)]

    @property
    def sent_again(self) -> int:
        return sum(node.figures().get("sent_again_unconfirmed", 0) for node in self.nodes.values())

    def make_data(self, steps: int, makers: tuple[int, ...]) -> list[DatumId]:
        ids = []
        for turn in range(steps):
            self.step()
            if turn % 5 == 0:
                ids += [self.put(i) for i in makers]
        return ids

    def missing(self, ids: list[DatumId]) -> list[DatumId]:
        return [id for id in ids if id not in self.nodes[self.base].custody_store.arrived]


#: The base is 0; from 4 there are two ways, over 1 and 2, and over 5 and 6.
RISKS = {0: 0.0, 1: 0.2, 2: 0.3, 3: 0.4, 4: 0.5, 5: 0.2, 6: 0.3}
LINKS = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (6, 4)]


@pytest.mark.no_cover
@pytest.mark.parametrize("immediate", [False, True])
@pytest.mark.parametrize("policy", ["rass", "survival"])
@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("passes_on", [False, True])
def test_what_a_sinkhole_has_swallowed_arrives_after_it_has_left(
    base: bool, passes_on: bool, policy: str, immediate: bool
) -> None:
    best = 1 if policy == "survival" and not base else POTENTIAL_BASE - 1
    net = HostileNet(
        RISKS, LINKS, base=0, liar=Liar(base=base, passes_on=passes_on, potential=best), near=(2, 3, 4),
        policy=policy, immediate=immediate, capacity_items=500,
    )  # fmt: skip
    ids = net.make_data(100, (3, 4))
    assert net.missing(ids), "the liar has done no harm"
    net.liar = None
    net.step(200)
    assert not net.missing(ids)


@pytest.mark.no_cover
@pytest.mark.parametrize("immediate", [False, True])
def test_what_a_forged_answer_has_ended_arrives_all_the_same(immediate: bool) -> None:
    """Somebody hears every hand-over, keeps it from its receiver, and answers in the receiver's name."""
    net = HostileNet(RISKS, LINKS, base=0, liar=None, immediate=immediate, capacity_items=500)
    net.step(10)
    net.forged = True
    ids = net.make_data(100, (2, 4))
    assert len(net.missing(ids)) == len(ids)
    net.forged = False
    net.step(200)
    assert not net.missing(ids)


@pytest.mark.no_cover
@pytest.mark.parametrize("immediate", [False, True])
def test_among_honest_nodes_hardly_anything_is_sent_again(immediate: bool) -> None:
    net = HostileNet(RISKS, LINKS, base=0, liar=None, immediate=immediate)
    ids = net.make_data(300, (2, 4))
    net.step(20)
    assert not net.missing(ids)
    assert net.sent_again == 0


# -- one node ----------------------------------------------------------------------------------------------------------


class Alone:
    """A node with a replica, whose neighbours 3, 4, 5 have ways; 3 has the datum."""

    def __init__(self, *, ways: dict[int, int], data: int = 1, **settings: Any) -> None:
        """`ways`: hops of the neighbours."""
        self.ways = ways
        self.now = 0.0
        self.ids: list[DatumId] = []
        self.node: Node = make_node(2, mirror=True, **settings)
        self.turn()
        self.turn()
        self.ids = [self.node.put(b"x", self.now) for _ in range(data)]

    def turn(self) -> list[Data]:
        """A step; data handed over are taken. Returns them."""
        self.now += 1.0
        for id, hops in self.ways.items():
            way, tag = Route(1, 1, 1, hops), self.node.policy.tag
            self.node.receive(beacon(id, int(self.now), way, policy=tag, potential=1 << 24), self.now)
        sent = [d for d in of(Data, self.node.step(self.now)) if not d.replica]
        for d in sent:
            self.node.receive(
                Committed(d.target, 2, tuple((n, datum.crc) for n, datum in d.handovers), ()), self.now
            )  # fmt: skip
        for id in self.ways if self.ids else ():
            self.node.receive(passed_on(id, 2, *self.ids), self.now)
        check_node(self.node)
        return sent

    def times(self, turns: int) -> list[tuple[int, int]]:
        """When something was sent, and to whom."""
        return [(turn, d.target) for turn in range(turns) for d in self.turn()]


@pytest.mark.no_cover
def test_the_patience_doubles_and_another_neighbour_is_asked_each_time() -> None:
    alone = Alone(ways={3: 1, 4: 2, 5: 3})
    sent = alone.times(2000)
    assert [to for _, to in sent] == [3, 4, 3, 4, 3]
    gaps = [b - a for (a, _), (b, _) in pairwise(sent)]
    for n, gap in enumerate(gaps):
        assert 0 <= gap - (PATIENCE_TURNS << n) <= 10


def test_where_there_is_no_other_way_the_same_neighbour_gets_it_again() -> None:
    assert [to for _, to in Alone(ways={3: 1}).times(450)] == [3, 3, 3]


@pytest.mark.parametrize(
    ("settings", "sent"), [({"receipts": False}, 1), ({"mirror_until_receipt": False}, 1), ({}, 2)]
)
def test_only_where_replicas_wait_for_receipts_anything_is_sent_again(settings: dict[str, bool], sent: int) -> None:
    assert len(Alone(ways={3: 1}, **settings).times(150)) == sent


def test_while_no_base_is_in_reach_nothing_is_sent_again_nor_before_receipts_could_come() -> None:
    alone = Alone(ways={3: 1})
    assert len(alone.times(5)) == 1
    alone.ways = {3: 255}
    assert alone.times(200) == []
    alone.ways = {3: 1}
    # The announcement is newer.
    assert len(alone.times(STATED_TURNS - 10)) == 0
    assert len(alone.times(30)) == 1


@pytest.mark.no_cover
def test_it_has_a_tenth_of_the_bandwidth() -> None:
    for bandwidth, most in ((1, 1), (10, 10), (50, 50)):
        alone = Alone(ways={3: 1}, data=40, bandwidth_items=bandwidth)
        while alone.node.holdings.custody:
            alone.turn()
        again = [0]
        while sum(again) < 40 and len(again) < 2000:
            before = alone.node.figures()["sent_again_unconfirmed"]
            alone.turn()
            again.append(alone.node.figures()["sent_again_unconfirmed"] - before)
        assert all(sum(again[i : i + 10]) <= most for i in range(len(again)))


def test_data_that_take_long_are_waited_for_longer() -> None:
    alone = Alone(ways={3: 1}, data=30)
    alone.times(100)
    id = alone.ids[0]
    alone.node.receive(make_receipt(1, 1, 1, [ReceiptEntry(id.origin, id.epoch, 0, 30, 0, False)]), alone.now)
    assert len(alone.node.holdings) == 0
    alone.ids = [alone.node.put(b"x", alone.now)]
    [first, second] = alone.times(400)
    assert 2.5 * 100 <= second[0] - first[0] <= 3 * 100 + LOOK_TURNS


def test_what_takes_long_because_of_a_liar_does_not_make_it_wait_longer_for_what_it_has_given_already() -> None:
    alone = Alone(ways={3: 1}, data=30)
    alone.times(50)
    id = alone.ids[0]
    alone.node.receive(make_receipt(1, 1, 1, [ReceiptEntry(id.origin, id.epoch, 0, 29, 0, False)]), alone.now)
    assert list(alone.node.holdings) == [alone.ids[29]]
    [(turn, _)] = alone.times(100)
    assert turn <= PATIENCE_TURNS - 50 + 10


@pytest.mark.parametrize("reachable", [False, True])
def test_a_replica_whose_custodian_has_gone_waits_for_the_receipt_where_a_base_can_be_reached(reachable: bool) -> None:
    """In a moving swarm most custodians that go out of range have passed the datum on."""
    node = make_node(2, mirror=True, mirror_until_receipt=True, receipts=True, newborn=True)
    node.receive(beacon(3, 1, free=50), 0.0)
    replica = datum()
    node.receive(Data(3, 2, (Handover(7, replica),), True), 0.0)
    taken_back = None
    for turn in range(1, 2 * PATIENCE_TURNS):
        if reachable:
            node.receive(beacon(4, turn, Route(0, 1, turn, 1), free=50), float(turn))
        node.step(float(turn))
        if replica.id in node.holdings.custody or node.exchange.open:
            taken_back = turn
            break
    assert taken_back is not None
    if reachable:
        assert PATIENCE_TURNS <= taken_back <= PATIENCE_TURNS + 2 * LOOK_TURNS
    else:
        assert 28 <= taken_back <= 30
