"""Large data over a thin link: as fast as it carries them, whatever gets lost, and whoever lies."""

from __future__ import annotations

import random
from typing import Any, NamedTuple

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rass_mav.core.custody.flow import MAX_WINDOW
from rass_mav.core.custody.transfers import MAX_OF_ONE, MAX_TRANSFERS
from rass_mav.core.messages import Accept, Chunk, Committed, Message, Offer, Report, Sack
from tests.extent import examples

from .books import check_node
from .emulated_link import BASE, CUSTODIAN, SHARE, Line, Pair

CHUNK = 123
PART = 32 << 10
TOTAL = 256 << 10
#: Bytes of a chunk on the link.
FRAME = 145


def parts_of(total: int, size: int, seed: int) -> list[bytes]:
    rng = random.Random(f"parts:{seed}")
    return [rng.randbytes(min(size, total - at)) for at in range(0, total, size)]


class Result(NamedTuple):
    goodput: float
    """Share of the bound: what a sender that knows each loss at once would need."""
    known: float
    """The same until the sender knows that all has arrived."""
    sent: float
    """Bytes that the sender put on the link, as a multiple of what the bound needs."""
    chunks: float
    """Chunks sent for each chunk."""


def carry(line: Line, seed: int, *, size: int = PART, total: int = TOTAL) -> Result:
    """Hand data over, one part after the other."""
    pair = Pair(line, seed)
    parts = parts_of(total, size, seed)
    start = pair.now
    ids = pair.put(*parts)
    there: list[float] = []

    def over() -> bool:
        if not there and len(pair.stores[BASE].disk.data) == len(ids):
            there.append(pair.now)
        return pair.is_over()

    assert pair.run(600.0, over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    need = total / SHARE / (1.0 - line.loss)
    least_s = need / line.bytes_s
    chunks = sum(-(-len(part) // CHUNK) for part in parts)
    return Result(
        least_s / (there[0] - start), least_s / (pair.now - start), pair.bytes[CUSTODIAN] / need, pair.chunks / chunks
    )


@pytest.mark.no_cover
@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("bytes_s", [5760.0, 125000.0])
def test_a_link_is_used_up(bytes_s: float, loss: float) -> None:
    results = [carry(Line(bytes_s, loss=loss), seed) for seed in range(6)]
    mean = Result(*(sum(values) / len(results) for values in zip(*results, strict=True)))
    assert mean.goodput >= 0.95
    assert mean.known >= 0.94
    assert max(result.sent for result in results) <= 1.05


@pytest.mark.no_cover
@pytest.mark.parametrize("loss", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("bytes_s", [5760.0, 125000.0])
def test_a_link_is_used_up_though_chunks_let_all_else_go_first(bytes_s: float, loss: float) -> None:
    """Then an offer and its answer take a shorter round trip than chunks do, which wait for each other."""
    results = [carry(Line(bytes_s, loss=loss, chunks_last=True), seed) for seed in range(4)]
    mean = Result(*(sum(values) / len(results) for values in zip(*results, strict=True)))
    assert mean.goodput >= 0.94
    assert max(result.sent for result in results) <= 1.05


def test_a_part_that_waits_for_those_before_it_is_not_offered_anew() -> None:
    """A part takes six seconds of this link, more than the turns in which a transfer must move."""
    pair = Pair(Line(5760.0, chunks_last=True), 1)
    numbers: dict[object, set[int]] = {}

    def note(to: int, message: Message) -> list[Message]:
        if type(message) is Offer:
            numbers.setdefault(message.id, set()).add(message.number)
        return [message]

    pair.tamper = note
    ids = pair.put(*parts_of(TOTAL, PART, 1))
    assert pair.run(600.0, pair.is_over)
    assert {id: len(given) for id, given in numbers.items()} == dict.fromkeys(ids, 1)


@pytest.mark.no_cover
@pytest.mark.parametrize("delay_s", [0.001, 0.02])
def test_no_long_queue_stands_before_the_link(delay_s: float) -> None:
    pair = Pair(Line(125000.0, delay_s), 1)
    pair.put(*parts_of(60 * 125000, PART, 1))
    pair.run(40.0)
    waiting_s = []
    for _ in range(10):
        pair.run(1.0)
        waiting_s.append(pair.backlog_s)
    # Far less than the largest window; and the link is never idle.
    assert max(waiting_s) * 125000.0 / FRAME < 0.6 * MAX_WINDOW
    assert min(waiting_s) > 0.0


@pytest.mark.no_cover
@pytest.mark.parametrize("bytes_s", [125000.0, 1e7])
def test_a_busy_processor_causes_no_chunk_to_be_sent_again(bytes_s: float) -> None:
    for seed in range(3):
        delay_s = 0.02 if bytes_s < 1e6 else 0.0001
        assert carry(Line(bytes_s, delay_s, slow_s=(0.01, 0.1)), seed).chunks <= 1.005


@pytest.mark.no_cover
@pytest.mark.parametrize("late_s", [0.01, 0.05])
def test_chunks_that_overtake_others_are_seldom_sent_again(late_s: float) -> None:
    for seed in range(3):
        assert carry(Line(125000.0, late=0.1, late_s=late_s), seed).chunks <= 1.05


@pytest.mark.no_cover
@settings(max_examples=examples(25), deadline=None)
@given(
    st.integers(98, 80000), st.integers(0, 1 << 32), st.sampled_from([0.0, 0.1, 0.4]), st.sampled_from([0.0, 0.3]),
    st.sampled_from([0.0, 0.3]), st.sampled_from([600.0, 5760.0, 125000.0]),
)  # fmt: skip
def test_whatever_gets_lost_doubled_and_overtaken_it_arrives_whole(
    size: int, seed: int, loss: float, doubled: float, late: float, bytes_s: float
) -> None:
    pair = Pair(Line(bytes_s, loss=loss, doubled=doubled, late=late, late_s=0.1), seed)
    payload = parts_of(size, size, seed)
    [id] = pair.put(*payload)
    assert pair.run(4000.0, lambda: check(pair) or pair.is_over())
    assert pair.arrived() == {id: payload[0]}
    # Each turn in which the link is silent ends nothing, and sends little.
    chunks = -(-size // CHUNK)
    assert pair.chunks <= 40 * chunks + 40 * MAX_WINDOW


def check(pair: Pair) -> bool:
    """The bounds hold at any moment."""
    for node in pair.nodes.values():
        incoming, large = node.incoming, node.holdings.large
        assert len(incoming.receiving) <= MAX_TRANSFERS
        assert sum(map(len, large.values())) <= MAX_TRANSFERS
        for of_neighbour in large.values():
            assert len(of_neighbour) <= MAX_OF_ONE
            sendings = [pending.sending for pending in of_neighbour.values()]
            assert sum(len(sending.flying) for sending in sendings if sending) <= 2 * MAX_WINDOW
    return False


def test_a_break_of_the_link_costs_little_more_than_its_time() -> None:
    pair = Pair(Line(5760.0), 1)
    parts = parts_of(TOTAL // 4, PART, 1)
    ids = pair.put(*parts)
    pair.run(4.0)
    pair.up = False
    pair.run(2.0)
    pair.up = True
    assert pair.run(60.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    # What was on its way when the link broke.
    assert pair.chunks <= sum(-(-len(part) // CHUNK) for part in parts) + MAX_WINDOW


@pytest.mark.no_cover
@pytest.mark.parametrize("away_s", [0.0, 3.0, 60.0])
def test_a_restarted_custodian_sends_what_is_missing(away_s: float) -> None:
    pair = Pair(Line(5760.0), 2)
    parts = parts_of(3 * PART, PART, 2)
    ids = pair.put(*parts)
    # The second part is nearly there.
    pair.run(12.5)
    assert len(pair.arrived()) == 1
    sent = pair.chunks
    pair.stop(CUSTODIAN)
    pair.run(away_s)
    pair.start(CUSTODIAN)
    assert pair.run(60.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    chunks = sum(-(-len(part) // CHUNK) for part in parts)
    assert pair.chunks - sent <= chunks - sent + MAX_WINDOW


def test_committed_may_be_late_or_lost() -> None:
    pair = Pair(Line(125000.0, loss=0.1), 4, disk_s=0.4)
    parts = parts_of(TOTAL, PART, 4)
    ids = pair.put(*parts)
    lost = set[int]()

    def lose_the_first(to: int, message: Message) -> list[Message]:
        if type(message) is Committed:
            number = message.committed[0][0] if message.committed else 0
            if number not in lost:
                lost.add(number)
                return []
        return [message]

    pair.tamper = lose_the_first
    assert pair.run(60.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    assert pair.chunks <= 1.25 * TOTAL / CHUNK


class Liar:
    """Forges answers and chunks between the two, in the name of either."""

    def __init__(self, pair: Pair, seed: int, often: float) -> None:
        self._pair = pair
        self._rng = random.Random(seed)
        self._often = often
        self._handles = [0]
        self._numbers = [0]

    def __call__(self, to: int, message: Message) -> list[Message]:
        if isinstance(message, Accept):
            self._handles.append(message.handle)
        if isinstance(message, Offer):
            self._numbers.append(message.number)
        if self._rng.random() >= self._often:
            return [message]
        return [message, self.lie(to)] if self._rng.random() < 0.5 else [self.lie(to), message]

    def lie(self, to: int) -> Message:
        rng = self._rng
        handle, number, first = rng.choice(self._handles), rng.choice(self._numbers), rng.choice([0, 5, 100, 266, 267])
        bitmap = rng.choice([0, 1, (1 << 256) - 1, rng.getrandbits(256)])
        if to == BASE:
            # With an unknown handle, or one of another transfer; a question, or chunks that do not fit.
            chunks = [
                Chunk(BASE, rng.getrandbits(16), first, True, bytes(CHUNK)),
                Chunk(BASE, handle, first, True, b""),
                Chunk(BASE, handle, first, True, bytes(CHUNK - 1)),
            ]
            return rng.choice(chunks)
        answers: list[Message] = [
            Accept(BASE, CUSTODIAN, number, rng.choice([handle, rng.getrandbits(16)]), first, bitmap),
            Sack(BASE, CUSTODIAN, handle, first, bitmap, rng.getrandbits(14)),
            Sack(BASE, CUSTODIAN, handle, 0, 0, 1, (Report(rng.choice(self._handles), first, bitmap >> 128),)),
        ]
        return rng.choice(answers)


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 1 << 32), st.sampled_from([0.02, 0.2]), st.sampled_from([0.0, 0.1]))
@example(2408784, 0.2, 0.0)
def test_forged_reports_cost_time_and_chunks_but_never_a_datum(seed: int, often: float, loss: float) -> None:
    pair = Pair(Line(125000.0, loss=loss), seed)
    parts = parts_of(3 * PART, PART, seed)
    ids = pair.put(*parts)
    pair.tamper = Liar(pair, seed, often)
    pair.run(10.0, lambda: check(pair) or pair.is_over())
    arrived = pair.arrived()
    held = pair.nodes[CUSTODIAN].holdings.custody
    for id, part in zip(ids, parts, strict=True):
        assert arrived.get(id, part) == part
        assert id in arrived or id in held
    # The link carries no more than this in the time.
    pair.tamper = lambda to, message: [message]
    assert pair.run(300.0, pair.is_over)
    assert pair.arrived() == dict(zip(ids, parts, strict=True))
    check_node(pair.nodes[CUSTODIAN])
    assert pair.chunks <= 40 * sum(-(-len(part) // CHUNK) for part in parts)


def test_a_captured_handle_spoils_no_more_than_the_transfer() -> None:
    """Whoever knows a handle can put a chunk into the transfer: its checksum does not match, and it starts again."""
    pair = Pair(Line(125000.0), 5)
    [part] = parts_of(PART, PART, 5)
    [id] = pair.put(part)
    forged: list[Any] = []

    def forge(to: int, message: Message) -> list[Message]:
        if to == BASE and isinstance(message, Chunk) and not forged:
            forged.append(message._replace(data=bytes(len(message.data))))
            return [forged[0]]
        return [message]

    pair.tamper = forge
    assert pair.run(30.0, pair.is_over)
    assert forged
    assert pair.nodes[BASE].custody_store.corrupt_received == 1
    assert pair.arrived() == {id: part}


class Captured:
    """Puts chunks of its own into a running transfer, before or after the true ones."""

    def __init__(self, seed: int, often: float, until: float, pair: Pair) -> None:
        self._rng = random.Random(seed)
        self._often = often
        self._until = until
        self._pair = pair
        self.forged = 0

    def __call__(self, to: int, message: Message) -> list[Message]:
        if not isinstance(message, Chunk) or self._pair.now > self._until or self._rng.random() >= self._often:
            return [message]
        size = len(message.data)
        false = self._rng.choice(
            [
                message._replace(data=bytes(size)),
                message._replace(position=self._rng.randrange(300)),
                message._replace(position=0x3FFF),
                message._replace(data=message.data[:-1]),
                message._replace(data=message.data + b"x"),
                message._replace(data=b"", poll=True, position=self._rng.randrange(300)),
            ]
        )
        self.forged += 1
        return [false, message] if self._rng.random() < 0.5 else [message, false]


@pytest.mark.no_cover
@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 1 << 32), st.sampled_from([0.002, 0.05, 0.5]), st.sampled_from([0.0, 0.1]))
def test_chunks_with_captured_handles_delay_and_nothing_false_is_committed(
    seed: int, often: float, loss: float
) -> None:
    pair = Pair(Line(125000.0, loss=loss), seed)
    parts = parts_of(4 * PART, PART, seed)
    true = dict(zip(pair.put(*parts), parts, strict=True))
    attacker = pair.tamper = Captured(seed, often, pair.now + 8.0, pair)

    def nothing_false() -> bool:
        check(pair)
        arrived = pair.arrived()
        assert arrived.items() <= true.items()
        # Custody is passed on for what is there, and for nothing else.
        assert true.keys() - pair.nodes[CUSTODIAN].holdings.custody.keys() <= arrived.keys()
        return pair.is_over()

    assert pair.run(120.0, nothing_false)
    assert attacker.forged or often == 0.002
    assert pair.arrived() == true
    check_node(pair.nodes[CUSTODIAN])
    check_node(pair.nodes[BASE])
