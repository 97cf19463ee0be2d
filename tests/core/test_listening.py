"""Large data that neighbours hand over to others: what a node that hears their chunks does with them."""

from __future__ import annotations

import random
from typing import Any

import pytest

from rass_mav.core.custody.listening import MAX_BYTES, MAX_PARTS, SHARE
from rass_mav.core.custody.overheard import KEPT_TURNS, PART
from rass_mav.core.custody.overheard import MAX_BYTES as MAX_OVERHEARD_BYTES
from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import Accept, Chunk, Message, Offer
from rass_mav.core.node import Node

from .build import beacon, data, datum, make_node, statement

CUSTODIAN, FORWARDER, OTHER = 5, 6, 7
SIZE = 123


def picture(sequence: int = 0, chunks: int = 40, origin: int = 9) -> Datum:
    payload = random.Random(f"{origin}:{sequence}").randbytes(chunks * SIZE - 1)
    return make_datum(DatumId(origin, 1, sequence), 0, 0.0, payload)


def listener(**settings: Any) -> Node:
    """A drone that hears nodes 5, 6 and 7."""
    node = make_node(1, **{"mirror": True, "overhear": True, "capacity_items": 1000, **settings})
    for sender in (CUSTODIAN, FORWARDER, OTHER):
        node.receive(beacon(sender), 0.0)
    return node


def offer_of(item: Datum, custodian: int, target: int, number: int) -> Offer:
    d = item
    return Offer(custodian, target, number, d.id, d.kind, d.created, d.hops, d.crc, len(d.payload), SIZE)


def chunk_of(item: Datum, handle: int, index: int, *, poll: bool = False) -> Chunk:
    return Chunk(0xFFFF, handle, index, poll, item.payload[index * SIZE : (index + 1) * SIZE])


def announce(
    node: Node,
    item: Datum,
    *,
    custodian: int = CUSTODIAN,
    forwarder: int = FORWARDER,
    handle: int = 700,
    now: float = 0.5,
) -> None:
    """The node hears an offer to another node, and its answer. It never answers."""
    number = handle
    assert node.receive(offer_of(item, custodian, forwarder, number), now) == []
    assert node.receive(Accept(forwarder, custodian, number, handle, 0), now) == []


def pass_by(
    node: Node,
    item: Datum,
    *missing: int,
    custodian: int = CUSTODIAN,
    forwarder: int = FORWARDER,
    handle: int = 700,
    now: float = 0.5,
) -> None:
    """The node hears a transfer, except some chunks."""
    announce(node, item, custodian=custodian, forwarder=forwarder, handle=handle, now=now)
    lacking = set(missing)
    for index in range(-(-len(item.payload) // SIZE)):
        if index not in lacking:
            assert node.receive(chunk_of(item, handle, index, poll=True), now) == []


def offered(node: Node, item: Datum, *, custodian: int = FORWARDER, number: int = 80, now: float = 1.0) -> Message:
    """The answer to an offer to this node."""
    [answer] = node.receive(offer_of(item, custodian, node.id, number), now)
    return answer


def named(answer: Message) -> set[int]:
    """The chunks that need not be sent."""
    assert isinstance(answer, Accept)
    beyond = {answer.next_index + 1 + i for i in range(256) if answer.bitmap >> i & 1}
    return set(range(answer.next_index)) | beyond


def hand_over(node: Node, item: Datum, answer: Message, *, now: float = 1.0) -> list[Message]:
    """Send the node what it says it lacks. Returns its last answers."""
    assert isinstance(answer, Accept)
    out: list[Message] = []
    for index in sorted(set(range(-(-len(item.payload) // SIZE))) - named(answer)):
        out = node.receive(chunk_of(item, answer.handle, index), now)
    return out


def test_the_answer_names_no_chunk_that_the_custodian_would_not_believe() -> None:
    """It reaches 256 chunks beyond the first missing one; a sender ignores reports of others that it has not
    sent."""
    node, item = listener(), picture(chunks=500)
    pass_by(node, item, 5)
    answer = offered(node, item)
    assert named(answer) == set(range(262)) - {5}
    assert isinstance(answer, Accept)
    node.receive(chunk_of(item, answer.handle, 5), 1.0)
    [report] = node.receive(chunk_of(item, answer.handle, 262, poll=True), 1.0)
    assert (report.next_index, report.bitmap) == (263, 0)  # type: ignore[union-attr]


def test_one_neighbour_displaces_only_what_it_hands_over_itself() -> None:
    node, item = listener(), picture()
    pass_by(node, item, 3)
    big = 1000
    most = 3 * MAX_BYTES // SHARE // (big * SIZE)
    for sequence in range(most):
        pass_by(
            node,
            picture(sequence, big, origin=8),
            0,
            *range(2, big),
            custodian=FORWARDER,
            forwarder=OTHER,
            handle=sequence,
        )
    for sequence in range(3 * MAX_PARTS):
        announce(node, picture(sequence, 2, origin=7), custodian=OTHER, forwarder=FORWARDER, handle=2000 + sequence)
    assert named(offered(node, item)) == set(range(40)) - {3}
    latest = picture(most - 1, big, origin=8)
    assert named(offered(node, latest, number=81)) == {1}
    assert named(offered(node, picture(0, big, origin=8), number=82)) == set()


@pytest.mark.no_cover
def test_what_was_not_heard_for_longest_is_forgotten_first() -> None:
    node = listener()
    senders = range(100, 101 + SHARE)
    items = [picture(sender, MAX_BYTES // SHARE // SIZE, origin=8) for sender in senders]
    for at, (sender, item) in enumerate(zip(senders, items, strict=True)):
        node.receive(beacon(sender), 0.0)
        pass_by(node, item, *range(1, len(item.payload)), custodian=sender, handle=sender, now=at / 10)
    assert named(offered(node, items[0], number=200)) == set()
    assert named(offered(node, items[1], number=201)) == {0}


def test_it_is_forgotten_in_the_end_and_when_it_has_arrived() -> None:
    for change in ("time", "receipt", None):
        node, item = listener(), picture()
        pass_by(node, item, 3)
        if change == "receipt":
            node.receive(statement(item.id), 0.6)
        last = KEPT_TURNS + 1 if change == "time" else 2
        for turn in range(1, last + 1):
            node.step(float(turn))
            node.receive(beacon(FORWARDER, turn), float(turn))
        answer = offered(node, item, now=last + 0.5)
        assert named(answer) == (set() if change else set(range(40)) - {3})


@pytest.mark.no_cover
def test_one_neighbour_and_one_origin_get_a_part_of_the_memory() -> None:
    node = listener()
    big = 4000
    most = MAX_OVERHEARD_BYTES // PART // (big * SIZE)
    for sequence in range(most + 2):
        pass_by(node, picture(sequence, big, origin=20 + sequence), handle=sequence)
    assert len(node.overheard) == most
    for sequence in range(most + 2):
        custodian = (FORWARDER, OTHER)[sequence % 2]
        pass_by(node, picture(sequence, big, origin=8), custodian=custodian, forwarder=CUSTODIAN, handle=sequence)
    assert sum(id.origin == 8 for id in node.overheard) == most
    # Small data find room beside them.
    small = datum(origin=8, sequence=999)
    node.receive(data(CUSTODIAN, FORWARDER, (77, small)), 0.6)
    assert small.id in node.overheard
