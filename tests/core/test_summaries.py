"""Summaries: what they match, how they travel, and what they may end."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.alarms import Alarm
from rass_mav.core.datum import DatumId, Fate
from rass_mav.core.gossip import ENOUGH
from rass_mav.core.messages import Data, Message, Route, Summary
from rass_mav.core.news.archive import Serials
from rass_mav.core.news.own_numbers import CONFIRMED_TURNS, MATCHED_TURNS, MOST_LOOKED_AT
from rass_mav.core.news.statements import (
    MARK_BYTES,
    MAX_BITS,
    MAX_MARKS,
    MIN_BITS,
    bits_for,
    make_summary,
    marks_of,
    pack_marks,
    unpack_marks,
)
from rass_mav.core.news.summaries import (
    MAX_BASES,
    MAX_FRESH,
    MAX_SEEN,
    MAX_WAITING,
    WAITING_PERIODS,
    WELL_FILLED,
    Fresh,
    Summaries,
    matched,
)
from rass_mav.core.news.table import Statements
from rass_mav.wire import decode, encode
from rass_mav.wire.codec import SUMMARY_BYTES
from tests.extent import examples

from .build import beacon, data, datum, make_node, of, statement
from .durable import DurableStore
from .replica_net import CHAIN, RISKS, Net

any_id = st.builds(DatumId, st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF), st.integers(0, 0xFFFFFFFF))
#: A base and its life.
BASE = (0, 9)


def summary_of(ids: Iterable[DatumId], *, base: int = 0, life: int = 9, serial: int = 0) -> Summary:
    ids = list(ids)
    bits = bits_for(len(ids))
    return make_summary(base, life, serial, bits, marks_of(ids, base, life, serial, len(ids) << bits))


def some_ids(count: int, start: int = 0) -> list[DatumId]:
    """As a swarm's are: many nodes with a few numbers each."""
    return [DatumId(n % 250, 1000 + n % 250, n // 250) for n in range(start, start + count)]


# -- marks -------------------------------------------------------------------------------------------------------------


@given(st.lists(any_id, min_size=1, max_size=MAX_MARKS), st.integers(0, 0xFFFFFFFF))
def test_a_summary_matches_all_that_it_was_made_of_in_any_order_and_fits_its_bytes(
    ids: list[DatumId], serial: int
) -> None:
    summary = summary_of(ids, serial=serial)
    assert matched(summary, ids) == ids
    assert summary_of(reversed(ids), serial=serial) == summary
    [payload] = encode(summary, 0.0)
    assert len(payload) <= SUMMARY_BYTES == 108
    assert decode(payload, 0.0) == summary


@pytest.mark.parametrize("count", [1, 25, WELL_FILLED, MAX_MARKS])
def test_so_many_marks_fit_whatever_they_are(count: int) -> None:
    bits = bits_for(count)
    assert MIN_BITS <= bits <= MAX_BITS
    last = (count << bits) - 1
    for marks in ([last] * count, [0] * count, [0] * (count - 1) + [last]):
        assert len(pack_marks(marks, bits)) <= MARK_BYTES
        assert unpack_marks(pack_marks(marks, bits), count, bits) == tuple(marks)


def test_well_filled_summaries_have_twelve_bits() -> None:
    assert bits_for(WELL_FILLED) == 12
    assert bits_for(MAX_MARKS) == MIN_BITS


@pytest.mark.parametrize("count", [20, WELL_FILLED, MAX_MARKS])
def test_other_data_are_matched_as_seldom_as_promised(count: int) -> None:
    bits = bits_for(count)
    others = some_ids(5000, start=10_000)
    rounds = min(200, (100 << bits) // len(others))
    wrong = sum(
        len(matched(summary_of(some_ids(count, start=count * serial), serial=serial), others))
        for serial in range(rounds)
    )
    expected = rounds * len(others) / (1 << bits)
    # Four standard deviations.
    assert wrong <= expected + 4 * expected**0.5 + 1


def test_a_wrong_match_does_not_come_again_with_the_next_summary() -> None:
    ids, others = some_ids(MAX_MARKS), some_ids(5000, start=10_000)
    wrong = [set(matched(summary_of(ids, serial=serial), others)) for serial in range(40)]
    assert sum(map(len, wrong)) > 400
    # Of 20 wrong matches by one, the next has 20 / 256.
    again = sum(len(one & other) for one, other in pairwise(wrong))
    assert again < 20


@given(st.binary(max_size=MARK_BYTES), st.integers(1, 255), st.integers(MIN_BITS, MAX_BITS))
def test_each_set_of_marks_has_one_encoding(packed: bytes, count: int, bits: int) -> None:
    try:
        marks = unpack_marks(packed, count, bits)
    except ValueError:
        return
    assert pack_marks(marks, bits) == packed
    assert len(marks) == count
    assert list(marks) == sorted(marks)
    assert marks[-1] < count << bits


# -- a base ------------------------------------------------------------------------------------------------------------


def fresh(period: int = 6) -> Fresh:
    return Fresh(BASE, Serials(DurableStore(1)), period)


@pytest.mark.parametrize(
    ("a_step", "steps", "most"), [(0.2, 6, 2), (8, 6, 50), (12, 5, 50), (16, 4, 50), (20, 3, 71), (36, 2, 71)]
)
def test_the_more_arrives_the_sooner_the_next_summary_comes(a_step: float, steps: int, most: int) -> None:
    one = fresh()
    said: list[tuple[int, int]] = []
    arrived = 0
    for t in range(1, 300):
        while arrived < a_step * t:
            one.arrived(DatumId(1, 1, arrived))
            arrived += 1
        if (summary := one.turn()) is not None:
            said.append((t, len(summary.marks)))
            assert summary.bits >= (12 if a_step <= 16 else MIN_BITS)
    gaps = [b - a for (a, _), (b, _) in pairwise(said)]
    assert max(gaps) <= steps
    assert max(count for _, count in said) <= most
    # Nothing waits for long.
    assert arrived - sum(count for _, count in said) <= 6 * a_step + 1


def test_each_datum_is_in_one_summary() -> None:
    one = fresh()
    ids = some_ids(300)
    for id in ids:
        one.arrived(id)
    said = [summary for _ in range(60) if (summary := one.turn()) is not None]
    assert sum(len(summary.marks) for summary in said) == len(ids)
    assert len({summary.serial for summary in said}) == len(said)
    for summary in said:
        assert set(matched(summary, ids)) >= set(ids[: len(summary.marks)])
        del ids[: len(summary.marks)]


def test_what_waits_at_a_base_is_bounded() -> None:
    one = fresh()
    for id in some_ids(3 * MAX_FRESH):
        one.arrived(id)
    assert sum(len(summary.marks) for _ in range(200) if (summary := one.turn()) is not None) == MAX_FRESH


def test_a_base_knows_its_own_summaries() -> None:
    base = make_node(0, base=True, summary=True, receipt_steps=1)
    forged = summary_of([datum().id], life=base.store.life)
    base.receive(forged, 0.0)
    assert base.alarms.counts == {Alarm.FORGED: 1}
    base.receive(data(7, 0, (5, datum())), 0.0)
    [own] = of(Summary, base.step(1.0))
    assert matched(own, [datum().id]) == [datum().id]
    base.receive(own, 1.0)
    base.receive(summary_of([datum().id], life=base.store.life + 1), 1.0)
    assert base.alarms.counts == {Alarm.FORGED: 1}, "its own, and that of another life"
    base.receive(summary_of([datum(sequence=1).id], life=base.store.life, serial=own.serial + 1), 1.0)
    assert base.alarms.counts == {Alarm.FORGED: 2}
    # After a restart it does not know what it sent before, so it accuses nobody of that.
    base.store.commit()  # type: ignore[attr-defined]
    again = make_node(0, base=True, summary=True, store=base.store.crashed())  # type: ignore[attr-defined]
    again.receive(own, 2.0)
    assert not again.alarms.counts


# -- relaying ----------------------------------------------------------------------------------------------------------


def relay(*bases: tuple[int, int], period: int = 1) -> Summaries:
    """A node whose neighbours' beacons name these bases."""
    statements = Statements()
    statements.named = bases
    return Summaries(random.Random(3), statements, period=period)


def sent(node: Summaries, turns: range) -> list[Summary]:
    return [summary for turn in turns if (summary := node.turn(turn)) is not None]


def test_a_summary_is_applied_once_and_relayed_once() -> None:
    node = relay(BASE)
    summary = summary_of(some_ids(5))
    assert node.hear(summary)
    assert not node.hear(summary)
    assert sent(node, range(1, 4)) == [summary]
    assert not node.hear(summary)
    assert not sent(node, range(4, 9))


def test_what_was_heard_often_is_not_relayed() -> None:
    node = relay(BASE)
    often, once = (summary_of(some_ids(5), serial=n) for n in range(2))
    for summary in [*[often] * (1 + ENOUGH), once]:
        node.hear(summary)
    assert sent(node, range(1, 9)) == [once]


def test_summaries_of_bases_that_no_neighbour_has_a_route_to_are_applied_and_not_relayed() -> None:
    node = relay((1, 9))
    assert node.hear(summary_of(some_ids(5)))
    assert not sent(node, range(1, 9))


def test_a_summary_that_has_waited_too_long_is_not_relayed() -> None:
    node = relay(BASE)
    for serial in range(MAX_WAITING):
        node.hear(summary_of(some_ids(5), serial=serial))
    assert len(sent(node, range(1, 2 * MAX_WAITING))) < WAITING_PERIODS + 1


def test_a_node_relays_at_most_one_in_so_many_turns() -> None:
    node = relay(BASE, period=6)
    relayed = 0
    for turn in range(120):
        node.hear(summary_of(some_ids(5), serial=turn))
        relayed += node.turn(turn) is not None
    assert 120 // 6 - 1 <= relayed <= 120 // 6 + 1


def test_a_flood_is_bounded() -> None:
    bases = [(n, 9) for n in range(3 * MAX_BASES)]
    node = relay(*bases)
    for serial in range(2 * MAX_SEEN):
        for base, life in bases:
            node.hear(summary_of(some_ids(1), base=base, life=life, serial=serial))
    assert node.gossip.news == MAX_WAITING
    assert len(node.seen) == MAX_BASES
    assert max(map(len, node.seen.values())) == MAX_SEEN
    # A base that is there again is relayed again.
    node = relay((1000, 9))
    node.seen = {(n, 9): {} for n in range(MAX_BASES)}
    summary = summary_of(some_ids(2), base=1000)
    assert node.hear(summary)
    assert summary[:4] in node.gossip
    assert list(node.seen) == [(1000, 9)]


def test_a_flipped_bit_in_memory_does_not_spread() -> None:
    node = relay(BASE)
    node.hear(summary_of(some_ids(5)))
    [waiting] = [hot.value for hot in node.gossip._hot.values()]
    first, *others = waiting.summary.marks
    waiting.summary = waiting.summary._replace(marks=(first ^ 1 << 40, *others))
    assert not sent(node, range(1, 9))


# -- what a summary ends -----------------------------------------------------------------------------------------------


@given(st.lists(st.lists(st.integers(0, 5), min_size=1, max_size=4), max_size=6), st.integers(0, 99))
@settings(max_examples=examples(25))
def test_forged_summaries_end_no_custody(lies: list[list[int]], seed: int) -> None:
    rng = random.Random(seed)
    net = Net({**RISKS, 0: 0.0}, [*CHAIN, (3, 0)], base=0, mirror_until_receipt=True, summary=True, immediate=True)
    ids = [net.put(1, bytes([n + 1])) for n in range(6)]
    for serial, lie in enumerate(lies):
        for node in net.nodes.values():
            held = set(node.holdings.custody), set(node.holdings.replica)
            forged = summary_of([ids[n] for n in lie], serial=serial, base=rng.choice([0, 5]))
            node.receive(forged, net.now)
            assert (set(node.holdings.custody), set(node.holdings.replica)) == held
        net.step()
    net.step(80)
    base = net.nodes[0]
    assert base.archive is not None
    assert all(id in base.archive for id in ids)


@pytest.mark.parametrize("told", [summary_of, statement])
def test_while_the_air_is_full_data_that_have_probably_arrived_wait_for_others(told: Callable[..., Message]) -> None:
    node = make_node(1, mirror=True, summary=True, receipts=True, newborn=True)
    arrived, other = (node.put(payload, 0.0) for payload in (b"arrived", b"other"))
    node.receive(told([arrived]) if told is summary_of else told(arrived), 0.0)

    def sent(t: int) -> list[DatumId]:
        node.receive(beacon(3, t, Route(0, 1, t, 0), free=50), float(t))
        return [handover.datum.id for data in of(Data, node.step(float(t))) for handover in data.handovers]

    node.pace.queue = 1
    assert sent(1) == [other]
    node.pace.queue = 0
    assert arrived in sent(2)
    assert arrived in node.holdings.custody


@pytest.mark.parametrize("summary", [False, True])
@pytest.mark.parametrize("stated", [False, True])
def test_an_origin_waits_longer_for_a_statement_about_what_a_summary_matches(summary: bool, stated: bool) -> None:
    node = make_node(1, mirror=True, summary=True)
    assert node.own is not None
    id = node.put(b"x", 0.0)
    node.custody_store.drop(node.holdings.custody[id], Fate.PASSED_ON)
    if summary:
        node.receive(summary_of([id]), 0.0)
    rang = []
    for t in range(2 * MATCHED_TURNS):
        if stated and t == CONFIRMED_TURNS - 10:
            node.receive(statement(id), 0.0)
        node.own.turn(node.holdings)
        if Alarm.UNCONFIRMED in node.alarms.counts:
            rang.append(t + 1)
    if stated:
        assert not rang
    else:
        assert (MATCHED_TURNS if summary else CONFIRMED_TURNS) <= rang[0] <= (1300 if summary else 400)
    # It is told once, and nothing is remembered of what is settled.
    assert node.alarms.counts.get(Alarm.UNCONFIRMED, 0) == (not stated)
    assert not node.own.matched


def test_what_an_origin_remembers_of_summaries_is_bounded() -> None:
    node = make_node(1, mirror=True, summary=True, capacity_items=None)
    assert node.own is not None
    ids = [node.put(b"x", 0.0) for _ in range(2 * MOST_LOOKED_AT)]
    for serial in range(0, len(ids), MAX_MARKS):
        node.receive(summary_of(ids[serial : serial + MAX_MARKS], serial=serial), 0.0)
    assert len(node.own.matched) == MOST_LOOKED_AT
