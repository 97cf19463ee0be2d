"""The scheduler of gossip alone: when items leave, who displaces whom, and that nobody keeps a node talking."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.gossip import measure
from rass_mav.core.datum import DatumId
from rass_mav.core.gossip import ENOUGH, IMAX, IMIN, MAX_HOT, NEW, OFFERED_SHARE, Gossip
from tests.extent import examples

from .gossip_net import Net, line

#: Own hash, and that of somebody else.
OWN, OTHER = 5, 6
#: The intervals from `IMIN` to `IMAX`.
INTERVALS = (IMAX // IMIN).bit_length()


def gossip(period: int = 1) -> Gossip[int, str]:
    return Gossip(random.Random(0), period=period)


def left(node: Gossip[int, str], turns: range) -> list[int]:
    return [item[0] for turn in turns if (item := node.leave(turn)) is not None]


@pytest.mark.parametrize("period", [1, 6])
def test_a_new_item_leaves_once_within_the_first_interval(period: int) -> None:
    node = gossip(period)
    node.add(7, "a", "source", 0)
    assert left(node, range(1, NEW * period + 1)) == [7]
    assert not left(node, range(NEW * period + 1, 1000))


def test_what_is_heard_often_enough_does_not_leave() -> None:
    node = gossip()
    for key in (1, 2):
        node.add(key, "a", "source", 0)
    for _ in range(ENOUGH - 1):
        node.hear(1)
    for _ in range(ENOUGH):
        node.hear(2)
    assert left(node, range(1, 9)) == [1]


def test_nobody_silences_a_relay_alone() -> None:
    node = gossip()
    for key in (1, 2):
        node.add(key, "a", "source", 0)
        for _ in range(9):
            node.hear(key, "source")
            node.hear(key, "liar")
    node.hear(2, "third")
    assert left(node, range(1, 9)) == [1]


def test_who_has_sent_an_item_before_it_was_believed_counts_as_well() -> None:
    node = gossip()
    senders = "bringer", "a", "b"
    for key in (1, 2, 3):
        node.add(key, "a", "source", 0, senders[:key])
    for _ in range(9):
        node.hear(1, "bringer")
        node.hear(2, "a")
    assert left(node, range(1, 9)) == [1, 2]


@pytest.mark.no_cover
def test_whoever_brings_much_delays_nobody_for_long() -> None:
    waits = []
    for seed in range(20):
        node: Gossip[int, str] = Gossip(random.Random(seed))
        for turn in range(50):
            for key in range(9):
                node.add(9 * turn + key, "a", "flooder", turn)
            node.leave(turn)
        node.add(300, "a", "other", 50)
        # What both bring counts for the other one.
        node.add(300, "a", "flooder", 50)
        waits.append(left(node, range(50, 200)).index(300))
    assert sum(waits) / len(waits) < 3


@given(st.integers(1, 8), st.lists(st.tuples(st.integers(1, 40), st.integers(0, 5)), max_size=40))
def test_one_item_leaves_in_a_period_on_average(period: int, added: list[tuple[int, int]]) -> None:
    node = gossip(period)
    turns: list[int] = []
    turn = key = 0
    for gap, count in added:
        for _ in range(count):
            node.add(key := key + 1, "a", key % 3, turn)
        for _ in range(gap):
            turn += 1
            turns += [turn] * (node.leave(turn) is not None)
    assert all(len([t for t in turns if a <= t < a + period]) <= 2 for a in turns)
    assert len(turns) <= turn // period + 2


def test_the_source_with_the_most_loses_its_oldest() -> None:
    node = gossip()
    node.add(-1, "a", "one", 0)
    for key in range(2 * MAX_HOT):
        node.add(key, "a", "other", 0)
    assert -1 in node
    assert node.news == MAX_HOT
    assert 0 not in node
    assert 2 * MAX_HOT - 1 in node


def test_items_are_offered_again_in_intervals_that_double_until_the_kind_rests() -> None:
    node = gossip()
    offers = [turn for turn in range(10 * IMAX) if node.differs(turn, OWN, [("a", OTHER)])]
    assert len(offers) == INTERVALS
    for n, (before, after) in enumerate(zip([0, *offers], offers, strict=False)):
        assert (IMIN << n) // 2 <= after - before <= IMIN << n
    # Another neighbour, or other knowledge, is another difference.
    assert any(node.differs(turn, OWN, [("a", OTHER), ("b", OTHER)]) for turn in range(10 * IMAX, 11 * IMAX))
    assert any(node.differs(turn, OWN + 9, [("a", OTHER)]) for turn in range(20 * IMAX, 21 * IMAX))


def test_who_comes_back_is_another_one() -> None:
    node = gossip()
    for turn in range(10 * IMAX):
        node.differs(turn, OWN, [("a", OTHER)])
    node.differs(10 * IMAX, OWN, [("a", OWN)])
    assert any(node.differs(turn, OWN, [("a", OTHER)]) for turn in range(10 * IMAX, 11 * IMAX))


def test_no_liar_keeps_a_node_talking() -> None:
    node, rng = gossip(), random.Random(1)
    offers = 0
    for turn in range(100 * IMAX):
        offers += node.differs(turn, OWN, [(rng.getrandbits(16), rng.getrandbits(32)) for _ in range(5)])
    assert offers <= 101 * INTERVALS


def test_who_had_to_forget_is_not_compared() -> None:
    node = gossip()
    assert not any(node.differs(turn, 0, [("a", OTHER)]) for turn in range(IMAX))
    assert not any(node.differs(turn, OWN, [("a", 0)]) for turn in range(IMAX))


def test_what_is_offered_again_gets_a_share_while_there_are_new_items() -> None:
    node = gossip()
    node.offer([(key, "a") for key in range(100)])
    out = []
    for turn in range(1, 81):
        node.add(1000 + turn, "a", "source", turn - 1)
        out += left(node, range(turn, turn + 1))
    assert sum(key < 1000 for key in out) >= 80 // OFFERED_SHARE
    assert out[OFFERED_SHARE - 1] == 99
    # What a neighbour sends is not offered any more.
    node.hear(50)
    assert 50 not in node


@pytest.mark.no_cover
@given(
    st.lists(st.tuples(st.integers(0, 4), st.sampled_from(["cut", "join", "restart", "arrive"])), max_size=12),
    st.integers(0, 1000), st.sampled_from([0.0, 0.1]), st.sampled_from([1, 3]),
)  # fmt: skip
@settings(max_examples=examples(12, 500))
def test_neighbours_end_with_the_same_knowledge_whatever_happened_before(
    events: list[tuple[int, str]], seed: int, loss: float, bases: int
) -> None:
    net = Net(line(5), bases=bases, period=2, loss=loss, seed=seed)
    number = 0
    for at, event in events:
        if event == "cut":
            net.links -= {(at, at + 1), (at + 1, at)}
        elif event == "join":
            net.links = line(5)
        elif event == "restart":
            net.receipts[at] = net.start(at)
        else:
            net.arrive(DatumId(at, 7, number := number + 1), base=at % bases)
        net.run(net.rng.choice((1, 10, 100)))
    net.links = line(5)
    net.loss = 0.0
    net.run(6 * IMAX * net.period)
    assert net.agree()
    assert net.run(4 * IMAX) == 0


@pytest.mark.no_cover
def test_in_a_crowd_each_node_sends_less_and_nobody_sends_while_all_know_the_same() -> None:
    few, many = (measure(nodes, 120) for nodes in (8, 32))
    assert few.quiet == many.quiet == 0.0
    assert many.for_one < 2 * few.for_one
    assert many.reporting < few.reporting / 2
