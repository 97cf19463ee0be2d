from __future__ import annotations

import random
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import Receipt, ReceiptEntry, ReceiptSpan
from rass_mav.core.news.arrivals import has_arrived, is_told_lost
from rass_mav.core.news.receipts import (
    ENTRY_BYTES,
    MAX_ORIGINS,
    MAX_ROUNDS,
    PATIENCE,
    PAUSE,
    RECEIPT_BYTES,
    SPAN_BYTES,
    Receipts,
)
from rass_mav.wire import encode
from rass_mav.wire.codec import MAX_TUNNEL

from .gossip_net import Net, grid, line

#: Steps in which all rounds that can come are over, for nodes with a turn every `PERIOD` steps and few pairs.
PERIOD = 4
ROUNDS_OVER = PERIOD * (PAUSE << (MAX_ROUNDS + 1))


def ids(origin: int, *sequences: int) -> list[DatumId]:
    return [DatumId(origin, 7, s) for s in sequences]


def truth(net: Net, receipts: Receipts) -> None:
    """What a node believes to have arrived or to be lost is so."""
    for (origin, epoch), known in receipts.known().items():
        for sequence in range(known[0] + 20):
            id = DatumId(origin, epoch, sequence)
            if has_arrived(known, sequence):
                assert any(id in archive for archive in net.archives)
            if is_told_lost(known, sequence):
                assert any(archive.is_lost(id) for archive in net.archives)


def digest_of(receipts: Receipts) -> int:
    """By the words of docs/protocol.md."""
    digest = 1
    for (origin, epoch), (closed, bitmap, lost, floor) in receipts.known().items():
        x = zlib.crc32(struct.pack("<HIIHHI", origin, epoch, closed, bitmap, lost, floor))
        digest ^= x * x >> 16 & 0xFFFFFFFF
    return digest or 1


def test_the_sizes_are_those_on_the_wire() -> None:
    one = len(encode(Receipt(0, 0, (ReceiptEntry(1, 2, 3, 4),)), 0.0)[0])
    two = len(encode(Receipt(0, 0, (ReceiptEntry(1, 2, 3, 4),) * 2), 0.0)[0])
    span = len(encode(Receipt(0, 0, (ReceiptEntry(1, 2, 3, 4),), (ReceiptSpan(1, 2, 3, 4, 5, 0),)), 0.0)[0])
    assert (two - one, span - one) == (ENTRY_BYTES, SPAN_BYTES)
    assert one - ENTRY_BYTES + RECEIPT_BYTES == MAX_TUNNEL


@pytest.mark.parametrize("links", [line(12), grid(6)], ids=["line", "grid"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_all_learn_what_has_arrived_and_then_all_are_silent(links: set[tuple[int, int]], loss: float) -> None:
    net = Net(links, period=PERIOD, loss=loss)
    for origin in range(25):
        net.arrive(*ids(origin, 0, 1, 2, 5))
    net.lose(*ids(3, 3))
    net.run(60 * PERIOD if loss == 0.0 else ROUNDS_OVER)
    assert net.agree()
    for receipts in net.receipts:
        truth(net, receipts)
        assert all(id in receipts for origin in range(25) for id in ids(origin, 0, 1, 2, 5))
        assert receipts.told_lost(*ids(3, 3))
        assert ids(3, 3)[0] not in receipts
    assert net.run(200) == 0


def test_one_arrival_in_a_clique_takes_few_frames() -> None:
    everybody = {(i, j) for i in range(9) for j in range(9) if i != j}
    net = Net(everybody, period=16, seed=3)
    net.arrive(*ids(1, 0))
    # The base says it, and those whose turn comes in one step say it again at most; the others have heard them.
    assert net.run(100) <= 4
    assert net.agree()


def test_a_node_has_its_turn_only_once_in_so_many_steps() -> None:
    net = Net(line(2), period=5)
    for t in range(300):
        net.arrive(*ids(t % 40, t // 40))
        net.step()
    assert 50 < sum(net.frames) <= 2 * 60


def test_a_node_that_was_away_learns_while_news_flows_on() -> None:
    links = grid(4)
    away = 15
    net = Net({link for link in links if away not in link} | {(away, away - 1)}, period=PERIOD)
    net.links = {link for link in links if away not in link}
    for origin in range(60):
        net.arrive(*ids(origin, *range(10)))
    net.run(400)
    assert len(net.receipts[away]) == 0
    net.links = links
    for flow in range(400):
        # Others go on, at a rate that leaves no node without news.
        net.arrive(*ids(100 + flow % 30, flow // 30))
        net.step()
    known = net.receipts[away]
    assert all(id in known for origin in range(60) for id in ids(origin, 0, 9))


def test_a_restarted_node_learns_again_and_a_restarted_base_says_nothing_new() -> None:
    net = Net(line(4), period=PERIOD)
    net.arrive(*ids(1, *range(30)), *ids(2, 0, 1))
    net.run(200)
    net.receipts[3] = net.start(3)
    net.run(40 * PERIOD)
    assert net.agree()
    net.receipts[0] = net.start(0)
    assert net.agree()
    assert net.run(40 * PERIOD) == 0


def test_a_wiped_base_takes_nothing_back_and_learns_what_has_arrived() -> None:
    net = Net(line(4), period=PERIOD)
    net.arrive(*ids(1, *range(30)))
    net.run(200)
    net.archives[0] = type(net.archives[0])()
    net.receipts[0] = Receipts((0, 4711), archive=net.archives[0], period=PERIOD)
    net.arrive(*ids(2, 0))
    net.run(200)
    for receipts in net.receipts:
        assert all(id in receipts for id in [*ids(1, 0, 29), *ids(2, 0)])
    assert net.agree()
    # What is here is another question.
    assert ids(1, 0)[0] not in net.archives[0]


def test_what_arrived_at_one_of_two_bases_has_arrived() -> None:
    net = Net(line(6), bases=2, period=PERIOD)
    net.arrive(*ids(1, *range(0, 20, 2)), base=0)
    net.lose(*ids(1, 1, 3), base=0)
    net.arrive(*ids(1, *range(1, 20, 2)), base=1)
    net.run(300)
    assert net.agree()
    assert all(id in net.receipts[5] for id in ids(1, *range(20)))
    assert not any(net.receipts[5].told_lost(id) for id in ids(1, *range(20)))


def test_who_is_not_heard_is_not_talked_to_for_ever() -> None:
    # Node 1 hears the base's beacons and frames; the base hears node 1 and believes that it knows nothing.
    net = Net({(0, 1), (1, 0)}, period=1)
    net.links = {(0, 1)}
    for origin in range(40):
        net.arrive(*ids(origin, 0))
    rounds = net.run(PAUSE << (MAX_ROUNDS + 1))
    assert rounds <= 4 + MAX_ROUNDS * 5
    assert net.run(2000) == 0
    # A new neighbour is talked to; here: the same one, heard for the first time in a new life.
    net.links = {(0, 1), (1, 0)}
    net.receipts[0]._met = frozenset()
    net.run(10 * PATIENCE)
    assert net.agree()


@given(
    st.lists(st.integers(1, 8), min_size=5, max_size=5),
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([line(5), {(i, j) for i in range(5) for j in range(5) if i != j}]),
)
@settings(max_examples=25)
def test_nodes_that_have_to_forget_do_not_talk_for_ever(
    bounds: list[int], seed: int, loss: float, links: set[tuple[int, int]]
) -> None:
    net = Net(links, period=1, bounds=bounds, loss=loss, seed=seed)
    rng = random.Random(seed)
    for _ in range(60):
        net.arrive(DatumId(rng.randrange(12), 7, rng.randrange(6)))
        net.step()
    net.run(PAUSE << (MAX_ROUNDS + 1))
    assert net.run(300) == 0
    for receipts, bound in list(zip(net.receipts, bounds, strict=True))[1:]:
        assert len(receipts) <= bound
        assert receipts.digest == (0 if receipts.forgetful else digest_of(receipts))
        truth(net, receipts)


def test_the_longest_unchanged_is_forgotten_first() -> None:
    receipts = Receipts(max_origins=3)
    for origin in range(3):
        receipts.learn(Receipt(0, 1, (ReceiptEntry(origin, 7, 1, 0),)))
    receipts.learn(Receipt(0, 1, (ReceiptEntry(0, 7, 2, 0),)))
    receipts.learn(Receipt(0, 1, (ReceiptEntry(9, 7, 1, 0),)))
    assert set(receipts.known()) == {(0, 7), (2, 7), (9, 7)}
    assert receipts.forgetful


def test_what_strangers_say_is_bounded_at_a_base_too() -> None:
    net = Net(line(2), bounds=[10])
    net.arrive(*[DatumId(origin, 7, 0) for origin in range(30)])
    for origin in range(1000, 3000):
        net.receipts[0].learn(Receipt(5, 5, (ReceiptEntry(origin, 8, 1, 0),)))
    assert len(net.receipts[0]) <= 30 + 10
    assert all(DatumId(origin, 7, 0) in net.receipts[0] for origin in range(30))
    assert MAX_ORIGINS >= 1000


entries = st.builds(ReceiptEntry, st.integers(0, 2), st.just(7), st.integers(0, 60), st.integers(0, 0xFFFF))
spans = st.builds(
    ReceiptSpan, st.integers(0, 2), st.just(7), st.integers(30, 60), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF),
    st.integers(0, 30),
)  # fmt: skip
frames = st.builds(Receipt, st.just(0), st.just(1), st.lists(entries, max_size=4), st.lists(spans, max_size=3))


@given(st.lists(frames, max_size=12), st.integers(1, 4))
def test_the_digest_is_that_of_all_that_is_known(said: list[Receipt], bound: int) -> None:
    receipts = Receipts(max_origins=bound)
    for receipt in said:
        changed = receipts.learn(receipt)
        said_of = {(e.origin, e.epoch) for e in receipt.entries} | {(s.origin, s.epoch) for s in receipt.spans}
        assert changed <= said_of
        assert receipts.forgetful or receipts.digest == digest_of(receipts)
        assert len(receipts) <= bound


def test_equal_changes_of_two_entries_do_not_cancel_in_the_digest() -> None:
    receipts = Receipts()
    seen = set()
    for closed in range(1, 200):
        receipts.learn(Receipt(0, 1, (ReceiptEntry(1, 7, closed, 0), ReceiptEntry(2, 7, closed, 0))))
        seen.add(receipts.digest)
    assert len(seen) == 199


def test_to_know_nothing_is_not_the_same_as_not_to_be_compared() -> None:
    assert Receipts().digest != 0
