"""Large data of which a part has come: they go on from there, whoever restarts and whoever brings the rest."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.flow import MAX_WINDOW
from rass_mav.core.custody.incoming import LEAST_KEPT_S
from rass_mav.core.custody.receiving import Receiving
from rass_mav.core.custody.transfers import MAX_OF_ONE
from rass_mav.core.datum import Datum
from rass_mav.core.messages import REPORT_BITS, Accept, Chunk, Committed, Message, Offer
from rass_mav.core.node import Node
from rass_mav.core.store import key_of
from tests.extent import examples
from tests.some import some

from .build import beacon, datum, make_node, of
from .durable import DurableStore
from .emulated_link import BASE, Line, Pair
from .test_large_data import CHUNK, FRAME, PART, parts_of
from .test_transfers import custodian_of, fit, noise

BYTES_S = 5760.0
#: Chunks that the link carries in a turn, which may not be saved yet, and those that were on their way.
A_TURN = int(BYTES_S / FRAME) + 1
SIZE = 100 * CHUNK


def receiver_over(store: DurableStore, now: float = 0.0) -> Node:
    """A node that has just started, and hears its neighbours."""
    node = make_node(2, store=store, now=now, seed=int(now))
    for custodian in range(3, 20):
        node.receive(beacon(custodian), now)
    return node


def offer_of(one: Datum, custodian: int, number: int = 1, chunk: int = CHUNK) -> Offer:
    return Offer(custodian, 2, number, one.id, one.kind, 0.0, 0, one.crc, len(one.payload), chunk)


def chunks_of(one: Datum, accept: Accept, positions: range, chunk: int = CHUNK) -> list[Chunk]:
    return [Chunk(2, accept.handle, at, False, one.payload[at * chunk : (at + 1) * chunk]) for at in positions]


def begin(node: Node, offer: Offer, now: float = 0.0) -> Accept:
    [accept] = node.receive(offer, now)
    assert isinstance(accept, Accept)
    return accept


def hear(node: Node, chunks: list[Chunk], now: float = 0.0) -> list[Message]:
    return [answer for chunk in chunks for answer in node.receive(chunk, now)]


# -- over a link -------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("away_s", [0.0, 1.0, 10.0, 2 * LEAST_KEPT_S])
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_a_restarted_receiver_gets_what_is_missing(away_s: float, loss: float) -> None:
    pair = Pair(Line(BYTES_S, loss=loss), 3)
    parts = parts_of(3 * PART, PART, 3)
    ids = pair.put(*parts)
    # The second part is nearly there.
    pair.run(12.5 / (1.0 - loss))
    assert list(pair.arrived()) == ids[:1]
    sent = pair.chunks
    pair.stop(BASE)
    pair.run(away_s)
    pair.start(BASE)
    assert pair.run(120.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    chunks = sum(-(-len(part) // CHUNK) for part in parts)
    assert sent > 0.55 * chunks
    # What was lost with the memory, and what was sent to a node that was off.
    assert pair.chunks <= chunks / (1.0 - 1.5 * loss) + A_TURN + MAX_WINDOW


def test_a_receiver_that_restarts_again_and_again_gets_it_all_the_same() -> None:
    """A part takes more than six seconds of this link, and the receiver lives for five."""
    pair = Pair(Line(BYTES_S), 4)
    parts = parts_of(4 * PART, PART, 4)
    ids = pair.put(*parts)
    for _ in range(40):
        pair.run(5.0)
        pair.stop(BASE)
        pair.start(BASE)
        if pair.is_over():
            break
    assert pair.run(10.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))


@pytest.mark.no_cover
def test_on_a_fast_link_no_part_is_saved_in_pieces_except_at_the_turns() -> None:
    pair = Pair(Line(1e6), 5)
    parts = parts_of(60 * PART, PART, 5)
    pieces = 0
    store = pair.stores[BASE]
    keep = store.keep_partial

    def count(key, offset, data):  # type: ignore[no-untyped-def]
        nonlocal pieces
        pieces += 1
        keep(key, offset, data)

    store.keep_partial = count  # type: ignore[method-assign]
    pair.put(*parts)
    assert pair.run(20.0, pair.is_over)
    assert 0 < pieces <= 10
    assert not store.partials


# -- whoever brings it -------------------------------------------------------------------------------------------------


def test_a_custodian_sends_only_what_is_missing_to_a_receiver_that_it_never_met() -> None:
    custodian, store = custodian_of(noise(SIZE)), DurableStore(epoch=1002)
    [id] = custodian.holdings.custody
    one = some(custodian.store.get(id))
    missing = {3, 50, 51, 99}
    for at in set(range(100)) - missing:
        store.keep_partial(key_of(one), at * CHUNK, one.payload[at * CHUNK : (at + 1) * CHUNK])
    receiver = make_node(2, store=store)
    fit(custodian, receiver, 0.0)
    [offer] = of(Offer, custodian.step(0.0))
    [accept] = receiver.receive(offer, 0.0)
    sent = of(Chunk, custodian.receive(accept, 0.0))
    assert {chunk.position for chunk in sent if chunk.data} == missing
    assert of(Committed, hear(receiver, sent))


def test_all_had_come_before_the_restart_and_nothing_is_sent_again() -> None:
    one, store = datum(payload=noise(SIZE)), DurableStore(epoch=1002)
    store.keep_partial(key_of(one), 0, one.payload)
    node = receiver_over(store)
    [answer] = node.receive(offer_of(one, 3), 0.0)
    assert isinstance(answer, Committed)
    assert len(answer.committed) == 1
    assert list(node.holdings.custody) == [one.id]


def test_other_chunks_of_the_same_content_count_where_they_are_whole() -> None:
    one, store = datum(payload=noise(SIZE)), DurableStore(epoch=1002)
    node = receiver_over(store)
    hear(node, chunks_of(one, begin(node, offer_of(one, 3)), range(10)))
    accept = begin(node, offer_of(one, 3, number=2, chunk=100))
    assert accept[-2:] == (10 * CHUNK // 100, 0)
    hear(node, chunks_of(one, accept, range(12, SIZE // 100), 100))
    assert list(node.holdings.custody) == [one.id]


def test_what_gives_way_to_others_is_not_forgotten() -> None:
    data = [datum(origin=9 + number, payload=noise(SIZE + number)) for number in range(9)]
    node = receiver_over(DurableStore(epoch=1002))
    for number, one in enumerate(data[:8]):
        hear(node, chunks_of(one, begin(node, offer_of(one, 3 + number)), range(10)))
    begin(node, offer_of(data[8], 12), 5.0)
    assert [begin(node, offer_of(one, 3 + number), 9.0).next_index for number, one in enumerate(data[:8])] == [10] * 8


def test_a_content_that_is_refused_for_lack_of_space_stays_for_another_time() -> None:
    one, store = datum(payload=noise(SIZE)), DurableStore(epoch=1002)
    node = receiver_over(store)
    accept = begin(node, offer_of(one, 3))
    hear(node, chunks_of(one, accept, range(99)))
    store.quota_bytes = SIZE - 1
    [answer] = hear(node, chunks_of(one, accept, range(99, 100)))
    assert isinstance(answer, Committed)
    assert answer.refused == (1,)
    store.quota_bytes = None
    [answer] = node.receive(offer_of(one, 3, number=2), 1.0)
    assert isinstance(answer, Committed)
    assert answer.committed


def test_a_custodian_that_offers_another_content_under_an_id_gives_up_that_transfer_and_no_other() -> None:
    data = [datum(origin=9 + number, payload=noise(SIZE)) for number in range(MAX_OF_ONE)]
    node = receiver_over(DurableStore(epoch=1002))
    accepts = [begin(node, offer_of(one, 3, number)) for number, one in enumerate(data)]
    other = datum(origin=9, payload=bytes(SIZE))
    accept = begin(node, offer_of(other, 3, 10))
    for number, one in list(enumerate(data))[1:]:
        assert begin(node, offer_of(one, 3, number)).handle == accepts[number].handle
    assert of(Committed, hear(node, chunks_of(other, accept, range(100))))
    assert list(node.holdings.custody) == [other.id]


def test_an_offer_of_the_same_bytes_as_another_kind_costs_no_chunk_that_has_come() -> None:
    one = datum(payload=noise(SIZE))
    node = receiver_over(DurableStore(epoch=1002))
    accept = begin(node, offer_of(one, 3))
    hear(node, chunks_of(one, accept, range(60)))
    begin(node, offer_of(one, 3, 2)._replace(kind=one.kind + 1))
    hear(node, chunks_of(one, accept, range(60, 100)))
    accept = begin(node, offer_of(one, 3))
    assert accept.next_index == 60
    assert of(Committed, hear(node, chunks_of(one, accept, range(60, 100))))
    assert list(node.holdings.custody) == [one.id]


# -- wrong chunks ------------------------------------------------------------------------------------------------------


def test_who_brings_wrong_chunks_again_and_again_spoils_one_attempt_of_another() -> None:
    one = datum(payload=noise(SIZE))
    node = receiver_over(DurableStore(epoch=1002))
    for turn in range(4):
        now = float(turn)
        node.receive(beacon(3, turn), now)
        node.receive(beacon(4, turn), now)
        liar = begin(node, offer_of(one, 4), now)
        hear(node, [Chunk(2, liar.handle, at, False, bytes(CHUNK)) for at in range(90)], now)
        node.step(now)
        accept = begin(node, offer_of(one, 3, number=turn), now)
        hear(node, chunks_of(one, accept, range(100)), now)
        if node.holdings.custody:
            break
    assert turn == 1


# -- one transfer ------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@settings(max_examples=examples(100), deadline=None)
@given(
    st.integers(1, 3000), st.integers(1, 123), st.lists(st.tuples(st.integers(0, 2999), st.integers(0, 700))),
    st.integers(1, 123),
)  # fmt: skip
def test_whatever_pieces_there_are_whole_chunks_are_taken_and_come_out_again(
    size: int, chunk: int, ranges: list[tuple[int, int]], other: int
) -> None:
    one = datum(payload=noise(size))
    pieces = [(at, one.payload[at : at + length]) for at, length in ranges if at < size]
    covered = {index for at, data in pieces for index in range(at, at + len(data))}
    transfer = Receiving(offer_of(one, 3, chunk=chunk), 7, 0.0)
    stored = transfer.whole(pieces)
    transfer.begin_with(stored, stored)
    starts = range(0, size, chunk)
    whole = [all(at in covered for at in range(start, min(start + chunk, size))) for start in starts]
    assert stored.keys() == {index for index, here in enumerate(whole) if here}
    # An Accept can name no others.
    first = whole.index(False) if False in whole else len(whole)
    whole = [here and index <= first + REPORT_BITS for index, here in enumerate(whole)]
    report = transfer.report(1 << 12).chunks
    assert [bool(report >> index & 1) for index in range(len(starts))] == whole
    # The store has them.
    assert transfer.unsaved() == []
    assert transfer.helped == any(whole)
    for index, here in enumerate(whole):
        if not here:
            start = index * chunk
            assert transfer.take(Chunk(2, 7, index, False, one.payload[start : start + chunk]), 1.0)
    pieces += transfer.unsaved()
    assert transfer.complete
    assert transfer.datum() is not None
    again = Receiving(offer_of(one, 4, chunk=other), 8, 0.0)
    again.begin_with(again.whole(pieces))
    assert again.complete
    assert again.datum() is not None
