"""The gossip of statements: all come to know what bases have said, and then all are silent."""

from __future__ import annotations

import itertools
import random
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.alarms import Alarm
from rass_mav.core.custody.flow import Flow
from rass_mav.core.custody.sending import Sending
from rass_mav.core.datum import DatumId, make_datum
from rass_mav.core.gossip import IMAX, IMIN
from rass_mav.core.messages import Accept, Committed, DeletionReport, Receipt, ReceiptEntry, Route
from rass_mav.core.news.archive import LISTEN_TURNS, RECEIPT_BYTES, SERIALS_CLAIMED, Archive, Serials
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.news.statements import covers, make_receipt, make_sequence_mark
from rass_mav.core.news.table import MAX_BASES, MAX_STATEMENTS
from rass_mav.core.routes.neighbours import Neighbour
from rass_mav.core.store import MAX_APART_OF_ONE
from rass_mav.wire import decode, encode
from rass_mav.wire.codec import MAX_TUNNEL
from tests.extent import examples

from .build import beacon, data, datum, loss, make_node, of, statement
from .durable import DurableStore
from .gossip_net import Net, all_known, grid, line

#: Turns in which an item leaves at most, and turns in which all intervals are over, for nodes with few statements.
PERIOD = 4
OVER = 4 * IMAX


def ids(origin: int, *sequences: int) -> list[DatumId]:
    return [DatumId(origin, 7, s) for s in sequences]


def receipts_of(max_statements: int = MAX_STATEMENTS) -> Receipts:
    """Of a drone that may send in every turn."""
    return Receipts(random.Random(0), max_statements=max_statements)


def truth(net: Net, receipts: Receipts) -> None:
    """What a node believes to have arrived or to be lost is so."""
    assert receipts.disagreement() == ""
    for (origin, epoch), (arrived, lost) in all_known(receipts).items():
        for first, end in arrived:
            for sequence in range(first, end):
                assert any(DatumId(origin, epoch, sequence) in archive for archive in net.archives)
        for first, end in lost:
            for sequence in range(first, end):
                id = DatumId(origin, epoch, sequence)
                assert any(archive.is_lost(id) or id in archive for archive in net.archives)


def hash_of(receipts: Receipts) -> int:
    """By the words of docs/reference/protocol.md."""
    found = 1
    for base, life, serial, crc in receipts.statements.of:
        x = zlib.crc32(struct.pack("<HIII", base, life, serial, crc))
        found ^= x * x >> 16 & 0xFFFFFFFF
    return found or 1


def test_a_statement_fills_a_frame_at_most() -> None:
    whole = make_receipt(0, 0, 0, [ReceiptEntry(1, 2, 1 << 31, 1 << 28, (1 << 128) - 2, False)] * 3)
    [payload] = encode(whole, 0.0)
    assert MAX_TUNNEL - 16 == RECEIPT_BYTES >= len(payload) - 16


@pytest.mark.no_cover
@pytest.mark.parametrize("links", [line(12), grid(6)], ids=["line", "grid"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_all_learn_what_has_arrived_and_then_all_are_silent(links: set[tuple[int, int]], loss: float) -> None:
    net = Net(links, period=PERIOD, loss=loss)
    for origin in range(25):
        net.arrive(*ids(origin, 0, 1, 2, 5))
    net.lose(*ids(3, 3))
    for _ in range(0, 80 * PERIOD if loss == 0.0 else PERIOD * OVER, 80):
        if net.run(80) == 0 and net.agree():
            break
    assert net.agree()
    for receipts in net.receipts:
        truth(net, receipts)
        assert all(id in receipts for origin in range(25) for id in ids(origin, 0, 1, 2, 5))
        assert receipts.is_reported_lost(*ids(3, 3))
        assert ids(3, 3)[0] not in receipts
    assert net.run(200) == 0


def test_one_arrival_in_a_clique_takes_few_frames() -> None:
    everybody = {(i, j) for i in range(9) for j in range(9) if i != j}
    net = Net(everybody, period=16, seed=3)
    net.arrive(*ids(1, 0))
    # The base says it, and those whose turn comes in one step say it again at most; the others have heard them.
    assert net.run(100) <= 4
    assert net.agree()


def test_nobody_keeps_a_node_from_relaying_a_statement_by_sending_it_again_and_again() -> None:
    for others, relayed in ((), True), (("a",), True), (("a", "b"), False):
        receipts, receipt = receipts_of(), statement(*ids(1, 0))
        for sender in ("bringer", *others, "bringer", "bringer"):
            receipts.learn(receipt._replace(senders=(sender,)))
        assert (receipt in [message for turn in range(9) for message in receipts.turn(turn, ())]) is relayed


def test_a_node_has_its_turn_only_once_in_so_many_steps() -> None:
    net = Net(line(2), period=5)
    for t in range(300):
        net.arrive(*ids(t % 40, t // 40))
        net.step()
    assert 50 < sum(net.frames) <= 2 * 60


@pytest.mark.no_cover
def test_a_node_that_was_away_learns_while_news_flows_on() -> None:
    links = grid(4)
    away = 15
    net = Net(links, period=PERIOD)
    net.links = {link for link in links if away not in link}
    for origin in range(60):
        net.arrive(*ids(origin, *range(10)))
    net.run(400)
    assert not net.receipts[away].statements.of
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
    net.run(2 * LISTEN_TURNS * PERIOD)
    assert net.agree()
    assert max(serial for _, _, serial, _ in net.receipts[3].statements.of) < SERIALS_CLAIMED
    assert net.run(40 * PERIOD) == 0


def test_a_restarted_base_says_what_it_did_not_come_to_say() -> None:
    net = Net(line(4), period=PERIOD)
    net.arrive(*ids(1, *range(30)))
    net.receipts[0] = net.start(0)
    net.run(2 * LISTEN_TURNS * PERIOD)
    assert all(id in net.receipts[3] for id in ids(1, *range(30)))


def test_serials_are_not_used_twice() -> None:
    store = DurableStore(1)
    drawn = []
    for _ in range(3):
        serials = Serials(store)
        drawn += [serials.draw() for _ in range(SERIALS_CLAIMED + 10)]
        store.commit()
        store = store.crashed()
    assert drawn == sorted(set(drawn))


def test_a_wiped_base_takes_nothing_back_and_does_not_say_what_it_has_not() -> None:
    net = Net(line(4), period=PERIOD)
    net.arrive(*ids(1, *range(30)))
    net.run(200)
    net.archives[0] = Archive()
    serials = Serials(DurableStore(4711))
    net.receipts[0] = Receipts(net.rng, (0, 4711), archive=net.archives[0], serials=serials, period=PERIOD)
    net.arrive(*ids(2, 0))
    net.run(300)
    for receipts in net.receipts:
        assert all(id in receipts for id in [*ids(1, 0, 29), *ids(2, 0)])
        assert not any(identity[1] == 4711 and kept.receipt.entries[0].origin == 1
                       for identity, kept in receipts.statements.of.items())  # fmt: skip
    assert net.agree()
    # What is here is another question.
    assert ids(1, 0)[0] not in net.archives[0]


@pytest.mark.no_cover
@pytest.mark.parametrize("bases", [2, 3, 10])
@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_scattered_parts_at_several_bases_are_known_to_all_in_the_end(bases: int, loss: float) -> None:
    net = Net(line(bases + 3), bases=bases, period=1, loss=loss)
    rng = random.Random(bases)
    for sequence in range(300):
        for origin in (20, 21, 22):
            net.arrive(*ids(origin, sequence), base=rng.randrange(bases))
        net.step()
    net.lose(*ids(20, 300), base=bases - 1)
    net.run(OVER)
    assert net.agree()
    assert net.run(300) == 0
    for receipts in net.receipts:
        assert {pair: list(arrived) for pair, (arrived, _) in all_known(receipts).items()} == {
            (origin, 7): [(0, 300)] for origin in (20, 21, 22)
        }
        assert receipts.is_reported_lost(*ids(20, 300))
    # Each speaks for itself only.
    for base, archive in enumerate(net.archives):
        for kept in net.receipts[-1].statements.by((base, 1000 + base)):
            for entry in kept.receipt.entries:
                assert all(
                    first <= entry.first and entry.first + entry.run <= end
                    for first, end in archive.ranges((entry.origin, 7), lost=entry.lost)
                    if first <= entry.first < end
                )


@pytest.mark.no_cover
def test_light_statements_are_said_again_and_die() -> None:
    net = Net(line(3), period=1)
    for origin in range(300):
        net.arrive(*ids(origin, 0))
        net.run(3)
    net.run(100)
    assert net.agree()
    assert len(net.receipts[2].statements.of) <= 300 // 5 + 1


def test_who_is_not_heard_is_not_talked_to_for_ever() -> None:
    # Node 1 hears the base's beacons and frames; the base hears node 1 and believes that it knows nothing.
    net = Net({(0, 1), (1, 0)}, period=1)
    net.links = {(0, 1)}
    for origin in range(40):
        net.arrive(*ids(origin, 0))
    # Five statements, and again in each interval, `IMIN` to `IMAX`; twice because it has stated more meanwhile.
    assert net.run(OVER) <= 5 + 2 * 5 * 5
    assert net.run(2000) == 0
    # A new neighbour is talked to.
    other = Neighbour(beacon(9, 1)._replace(statements_hash=5), 0.0)
    assert any(net.receipts[0].turn(net.t + t, [other]) for t in range(IMIN + 1))


@pytest.mark.no_cover
@given(
    st.lists(st.integers(1, 8), min_size=5, max_size=5),
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([line(5), {(i, j) for i in range(5) for j in range(5) if i != j}]),
    st.sampled_from([1, 3]),
)
@settings(max_examples=examples(12, 1000))
def test_nodes_that_have_to_forget_do_not_talk_for_ever(
    bounds: list[int], seed: int, loss: float, links: set[tuple[int, int]], bases: int
) -> None:
    net = Net(links, bases=bases, period=1, bounds=bounds, loss=loss, seed=seed)
    rng = random.Random(seed)
    for _ in range(60):
        net.arrive(DatumId(rng.randrange(12), 7, rng.randrange(300)), base=rng.randrange(bases))
        net.step()
    net.run(OVER)
    assert net.run(300) == 0
    for receipts, bound in zip(net.receipts, bounds, strict=True):
        assert len(receipts.statements.of) <= bound
        assert receipts.statements_hash == (0 if receipts.statements.forgetful else hash_of(receipts))
        truth(net, receipts)


# -- what lives depends on what was heard, not on the order ------------------------------------------------------------

entries = st.builds(
    ReceiptEntry, st.integers(0, 1), st.just(7), st.integers(0, 6), st.integers(1, 6),
    st.integers(0, 7).map(lambda bits: bits << 1), st.booleans(),
)  # fmt: skip
said_frames = st.builds(
    make_receipt, st.integers(0, 1), st.just(1), st.integers(0, 3), st.lists(entries, min_size=1, max_size=4)
)


def living(receipts: Receipts) -> dict[tuple[int, ...], set[ReceiptEntry]]:
    return {identity: kept.live for identity, kept in receipts.statements.of.items()}


@pytest.mark.no_cover
@given(st.lists(said_frames, max_size=8, unique_by=lambda receipt: receipt[:4]), st.randoms())
def test_what_lives_does_not_depend_on_the_order(said: list[Receipt], rng: random.Random) -> None:
    one, other = receipts_of(), receipts_of()
    for receipt in said:
        changed = one.learn(receipt)
        assert changed <= {(e.origin, e.epoch) for e in receipt.entries}
        assert one.disagreement() == ""
        assert one.statements_hash == hash_of(one)
    for receipt in rng.sample(said + said, 2 * len(said)):
        other.learn(receipt)
    assert living(one) == living(other)
    assert one.statements_hash == other.statements_hash
    assert all_known(one) == all_known(other)
    # By the words of docs/reference/protocol.md.
    every = {(receipt[:4], entry) for receipt in said for entry in receipt.entries}
    alive = {
        (identity, entry)
        for identity, entry in every
        if not any(
            (base[:2], other_entry[:2], other_entry.lost) == (identity[:2], entry[:2], entry.lost)
            and covers(other_entry, entry)
            and (other_entry != entry or base > identity)
            for base, other_entry in every
        )
    }
    assert {(identity, entry) for identity, live in living(one).items() for entry in live} == alive


def test_the_base_with_the_most_statements_forgets_its_oldest() -> None:
    receipts = receipts_of(max_statements=6)
    for base, serial in [(1, 0), (1, 1), (2, 0), (2, 1), (2, 2), (2, 3), (2, 4)]:
        receipts.learn(statement(*ids(serial, base), base=base, serial=serial))
    assert {identity[:1] + identity[2:3] for identity in receipts.statements.of} == {
        (1, 0), (1, 1), (2, 1), (2, 2), (2, 3), (2, 4)
    }  # fmt: skip
    assert receipts.statements.forgetful
    assert receipts.disagreement() == ""


@pytest.mark.no_cover
def test_a_flood_of_invented_bases_leaves_the_named_one_alone() -> None:
    receipts = receipts_of()
    named = Neighbour(beacon(5, 1, Route(1, 9, 1, 0)), 0.0)
    receipts.learn(statement(*ids(1, 0), base=1, life=9))
    receipts.turn(1, [named])
    for base in range(100, 100 + 10 * MAX_BASES):
        receipts.learn(statement(*ids(1, 0), base=base, life=base))
    assert ids(1, 0)[0] in receipts
    assert len({identity[:2] for identity in receipts.statements.of}) == MAX_BASES
    # One that is named takes the place of an invented one.
    receipts.turn(2, [named, Neighbour(beacon(6, 1, Route(2, 9, 1, 0)), 0.0)])
    receipts.learn(statement(*ids(1, 5), base=2, life=9))
    assert ids(1, 5)[0] in receipts
    assert any(identity[:2] == (1, 9) for identity in receipts.statements.of)
    # Nor does a base that says very much push out another one.
    for serial in range(MAX_STATEMENTS + 100):
        receipts.learn(statement(DatumId(serial, 8, 0), base=2, serial=serial, life=9))
    assert len(receipts.statements.of) == MAX_STATEMENTS
    assert any(identity[:2] == (1, 9) for identity in receipts.statements.of)


@pytest.mark.no_cover
def test_a_node_knows_what_several_bases_have_of_thousands_of_origins() -> None:
    receipts = receipts_of()
    for base in range(4):
        for first in range(0, 2500, 8):
            some = [id for origin in range(first, min(first + 8, 2500)) for id in ids(origin, base)]
            receipts.learn(statement(*some, base=base, serial=first))
    assert len(receipts.statements.of) == 4 * 313
    assert receipts.statements_hash == hash_of(receipts)
    assert receipts.statements_hash != 0, "it can be compared"
    assert all(id in receipts for origin in range(0, 2500, 99) for id in ids(origin, 0, 1, 2, 3))


def test_equal_changes_of_two_entries_do_not_cancel_in_the_hash() -> None:
    receipts = receipts_of()
    seen = set()
    for serial in range(1, 200):
        receipts.learn(statement(*ids(1, *range(serial)), *ids(2, *range(serial)), serial=serial))
        seen.add(receipts.statements_hash)
    assert len(seen) == 199
    assert len(receipts.statements.of) == 1


def test_to_know_nothing_is_not_the_same_as_not_to_be_compared() -> None:
    assert receipts_of().statements_hash != 0


# -- flipped bits ------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
def test_a_flipped_bit_in_one_table_does_not_spread() -> None:
    for place in range(6):
        net = Net(line(5), period=1)
        net.arrive(*ids(1, *range(20)), *ids(2, 0, 5))
        net.run(60)
        assert net.agree()
        kept = next(iter(net.receipts[2].statements.of.values()))
        entry = kept.receipt.entries[0]
        struck = ReceiptEntry._make([*entry[:place], entry[place] ^ 1 if place == 5 else entry[place] ^ 16,
                                     *entry[place + 1 :]])  # fmt: skip
        kept.receipt = kept.receipt._replace(entries=(struck, *kept.receipt.entries[1:]))
        # Nobody needs what node 2 has at first; then all do.
        for asking in ([4], [0, 1, 3, 4]):
            for node in asking:
                net.receipts[node] = net.start(node)
            net.run(400)
            for receipts in net.receipts if len(asking) > 1 else net.receipts[:2] + net.receipts[3:]:
                truth(net, receipts)
            assert net.agree()


def test_a_flipped_bit_in_what_bases_say_together_is_found_before_it_decides() -> None:
    receipts = receipts_of()
    receipts.learn(statement(*ids(1, *range(20))))
    assert ids(1, 19)[0] in receipts
    receipts.statements.sum((1, 7)).arrived.add(20, 6000)
    assert ids(1, 5000)[0] not in receipts
    assert ids(1, 19)[0] in receipts
    receipts.statements.sum((1, 7)).arrived.add(20, 6000)
    receipts.learn(statement(*ids(1, 30), serial=1))
    assert ids(1, 5000)[0] not in receipts
    assert {ids(1, 19)[0] in receipts, ids(1, 30)[0] in receipts} == {True}


# -- denials -----------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("links", [line(9), grid(5)], ids=["line", "grid"])
def test_a_denial_reaches_who_believes_it_not_and_dies_out(links: set[tuple[int, int]]) -> None:
    net = Net(links, period=2)
    net.arrive(*ids(1, *range(10)), *ids(2, *range(10)))
    net.run(200)
    forged = statement(*ids(1, 5000), *ids(2, 0), base=0, life=1000, serial=99)
    net.receipts[4].learn(forged)
    net.run(200)
    assert all(ids(1, 5000)[0] in receipts for receipts in net.receipts)
    assert net.receipts[3].deny(make_sequence_mark(1, 7, 10))
    net.run(200)
    assert not any(ids(1, 5000)[0] in receipts for receipts in net.receipts)
    assert all(id in receipts for receipts in net.receipts for id in [*ids(1, 9), *ids(2, 0)])
    assert len({receipts.statements_hash for receipts in net.receipts}) == 1
    assert net.run(300) == 0
    # Who has not heard of it is told as soon as it says it.
    net.receipts[2] = net.start(2)
    net.receipts[2].learn(forged)
    net.run(100)
    assert not any(ids(1, 5000)[0] in receipts for receipts in net.receipts)


def test_a_denial_that_concerns_nobody_is_not_told_on() -> None:
    receipts = receipts_of()
    receipts.learn(statement(*ids(1, 0, 1)))
    assert not receipts.deny(make_sequence_mark(1, 7, 2))
    assert not receipts.deny(make_sequence_mark(9, 7, 0))
    assert not receipts.marks.keys()
    # A forged one costs replicas their end, and nothing else; the base's next word is believed again.
    assert receipts.deny(make_sequence_mark(1, 7, 1))
    assert ids(1, 1)[0] not in receipts
    receipts.learn(statement(*ids(1, 0, 1, 2), serial=1))
    assert ids(1, 1)[0] in receipts


@pytest.mark.no_cover
def test_a_forged_denial_is_answered_by_the_base_and_dies_out() -> None:
    net = Net(grid(3), period=2)
    net.arrive(*ids(1, *range(10)), *ids(2, *range(10)))
    net.run(200)
    for hearer in (8, 0):
        # An old word of the origin, said again: it names fewer numbers than it has given by now.
        assert net.receipts[hearer].deny(make_sequence_mark(1, 7, 4))
        net.run(100)
    net.run(2 * OVER)
    assert all(id in receipts for receipts in net.receipts for id in ids(1, *range(10)))
    assert net.run(300) == 0


def test_a_base_knows_what_it_has_not_said() -> None:
    net = Net(line(2))
    net.arrive(*ids(1, *range(10)))
    [base, drone] = net.receipts
    for said, forged in (
        (statement(*ids(1, *range(11)), life=1000, serial=9), True),
        (statement(*ids(2, 0), life=1000, serial=9), True),
        (statement(*ids(1, *range(9)), life=1000, serial=9), False),
        # It may have forgotten what it was told is lost, and what another base has it cannot know.
        (statement(*ids(2, 0), life=1000, serial=9, lost=True), False),
        (statement(*ids(2, 0), life=999, serial=9), False),
    ):
        assert base.contradicts(said) is forged
        assert not drone.contradicts(said)


def test_denials_are_bounded() -> None:
    receipts = receipts_of()
    for origin, serial in itertools.product(range(50), range(20)):
        receipts.learn(statement(*ids(origin, 100 + 200 * serial), serial=serial))
        receipts.deny(make_sequence_mark(origin, 7, serial))
        assert receipts.disagreement() == ""


@pytest.mark.parametrize("flood_lost", [True, False])
def test_a_flood_of_losses_does_not_keep_back_what_has_arrived_nor_the_other_way_round(flood_lost: bool) -> None:
    """Anybody can hand over deletion reports about nodes that do not exist, and junk."""
    base = make_node(0, base=True, receipt_steps=1)
    flood = [DatumId(1000 + i, i, 5) for i in range(600)]
    for i, id in enumerate(flood):
        if flood_lost:
            base.receive(DeletionReport(7, 0, (loss(i + 1, id, 1),)), 0.0)
        else:
            base.receive(data(7, 0, (i + 1, make_datum(id, 0, 0.0, b"junk"))), 0.0)
    own = datum()
    if flood_lost:
        base.receive(data(8, 0, (9, own)), 0.0)
    else:
        base.receive(DeletionReport(8, 0, (loss(9, own.id, 1),)), 0.0)
    drone = make_node(1, mirror=True)
    for t in range(1, 5):
        for receipt in of(Receipt, base.step(float(t))):
            drone.receive(receipt, float(t))
    assert (own.id in drone.custody_store.arrived) == flood_lost
    assert drone.receipts.is_reported_lost(own.id) != flood_lost


# -- what a node does with them ---------------------------------------------------------------------------------------


def test_a_receipt_near_the_end_of_all_numbers_does_no_harm() -> None:
    last = (1 << 32) - 1
    base = make_node(0, base=True, receipt_steps=1)
    handed = [datum(sequence=last - n) for n in range(17)]
    base.receive(data(7, 0, *[(n + 1, d) for n, d in enumerate(handed)]), 0.0)
    drone = make_node(1, mirror=True)
    for t in range(4):
        for receipt in of(Receipt, base.step(float(t))):
            [payload] = encode(receipt, 0.0)
            heard = decode(payload, 0.0)
            drone.receive(heard, float(t))
            base.receive(heard, float(t))
    assert all(d.id in drone.custody_store.arrived for d in handed)
    assert datum(sequence=0).id not in drone.custody_store.arrived
    base.receive(statement(*[d.id for d in handed], base=3), 5.0)
    base.step(6.0)
    base.store.commit()  # type: ignore[attr-defined]
    again = make_node(0, base=True, store=base.store.crashed(), now=7.0, receipt_steps=1)  # type: ignore[attr-defined]
    assert all(d.id in again.custody_store.arrived for d in handed)
    again.step(8.0)


def test_second_contents_are_bounded_and_refused_beyond() -> None:
    base = make_node(0, base=True)
    base.receive(data(7, 0, (5, datum())), 0.0)
    answers = [base.receive(data(8, 0, (n + 1, datum(payload=b"%d" % n))), 0.0) for n in range(MAX_APART_OF_ONE + 2)]
    refused = [answer.refused for [answer] in answers if isinstance(answer, Committed)]
    assert refused[:MAX_APART_OF_ONE] == [()] * MAX_APART_OF_ONE
    assert refused[MAX_APART_OF_ONE:] == [(MAX_APART_OF_ONE + 1,), (MAX_APART_OF_ONE + 2,)]


def test_a_large_second_content_is_taken_too() -> None:
    base = make_node(0, base=True)
    d, other = datum(payload=b"a" * 300), datum(payload=b"b" * 300)
    for sender, content in ((7, d), (8, other)):
        base.receive(beacon(sender), 0.0)
        sending = Sending(content, 0, 5, 123)
        [accept] = base.receive(sending.offer(sender, 0.0), 0.0)
        assert isinstance(accept, Accept)
        assert sending.open(accept.handle, 0, 0.0)
        chunks = [sending.chunk(position, Flow(0.0), 0.0) for position in sending.due(fresh=True)]
        answers = [answer for chunk in chunks for answer in base.receive(chunk, 0.0)]
        assert Committed(0, sender, ((5, content.crc),), ()) in answers
    assert base.alarms.counts == {Alarm.TWO_CONTENTS: 1}
