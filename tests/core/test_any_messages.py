"""Whatever the neighbours say, honest or not, and in whatever order: the node goes on, and its books are right.

Ids, numbers, senders and handles come from small pools, and half of the time from what the node is busy with, so that
lies meet what they are about. All that the node says has to fit the wire.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.messages import (
    BEACON_BASE,
    NO_ROUTE,
    Accept,
    Beacon,
    Chunk,
    Committed,
    CopyStatusEntry,
    CopyStatuses,
    Data,
    DeletionEntry,
    DeletionReport,
    Handover,
    Message,
    Offer,
    Put,
    Query,
    Receipt,
    ReceiptEntry,
    Route,
    Sack,
    SequenceMark,
)
from rass_mav.core.news.statements import make_receipt, make_sequence_mark, note_crc
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE
from rass_mav.errors import StoreFullError
from rass_mav.wire import encode
from tests.extent import examples
from tests.some import some

from .books import check_node
from .build import beacon, make_node, tries
from .durable import DurableStore

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover


@pytest.fixture(autouse=True, scope="module")
def soon_given_up() -> Iterator[None]:
    with tries(3):
        yield


ME = 2
EPOCH = 1000 + ME
SENDERS = (1, 3, 4, ME)
IDS = [DatumId(ME, EPOCH, n) for n in range(4)] + [DatumId(9, 77, n) for n in range(3)] + [DatumId(3, 5, 0)]
SIZES = (1, 7, 97, 98, 250, 2000)


class World:
    """A node, its store, and the time."""

    def __init__(self, **options: Any) -> None:
        self.options = options
        self.store = DurableStore(epoch=EPOCH)
        self.now = 0.0
        self.lives = 0
        self.beacons = 0
        self.handles = [0]
        """Of transfers that the node has accepted."""
        self.node = self._start()

    def _start(self) -> Node:
        self.lives += 1
        return make_node(
            ME, store=self.store, now=self.now, seed=self.lives, risk=0.5,
            **{"capacity_items": 4, **self.options},
        )  # fmt: skip

    def meet(self) -> None:
        """Two neighbours that data may go to, and something that may."""
        for sender, hops in ((3, 2), (4, 4)):
            way, tag = Route(1, 1, 0, hops), self.node.policy.tag
            self.hear(beacon(sender, 0, way, policy=tag, potential=POTENTIAL_BASE - 1))
        for size in (7, 300):
            self.put(size)
        self.step(1.0)

    def hear(self, message: Message) -> None:
        self.say(self.node.receive(message, self.now))

    def forward(self) -> None:
        self.say(self.node.forward(self.now))

    def say(self, messages: list[Message]) -> None:
        for message in messages:
            encode(message, self.now)
            if type(message) is Accept:
                self.handles = [*self.handles[-3:], message.handle]
        check_node(self.node)

    def step(self, seconds: float) -> None:
        self.now += seconds
        self.say(self.node.step(self.now))

    def put(self, size: int) -> None:
        with suppress(StoreFullError):
            self.node.put(bytes([self.lives & 0xFF]) * size, self.now)

    def restart(self, committed: bool) -> None:
        if committed:
            self.store.commit()
        self.store = self.store.crashed()
        self.node = self._start()
        check_node(self.node)

    def strike(self, pick: int) -> None:
        stored = list(self.store.ids())
        if stored:
            self.store.flip_bit(stored[pick % len(stored)])

    def number(self, pick: int) -> int:
        """A number: one in use here, or any."""
        busy = [key for key in self.node.exchange.open if isinstance(key, int)]
        return busy[pick // 2 % len(busy)] if busy and pick % 2 else pick // 2 + 1

    def crc(self, number: int, pick: int) -> int:
        question = self.node.exchange.open.get(number)
        holding = None if question is None else self.node.holdings.get(question.id)
        return holding.crc if holding is not None and pick % 4 else 5


class Event(NamedTuple):
    """Something that happens; it knows the world only when it does."""

    name: str
    happens: Callable[[World], None]

    def __repr__(self) -> str:
        return self.name


def event(function: Callable[..., None]) -> Callable[..., st.SearchStrategy[Event]]:
    """A strategy of events, from a function of the world and of what is drawn."""

    def strategy(**drawn: st.SearchStrategy[Any]) -> st.SearchStrategy[Event]:
        return st.fixed_dictionaries(drawn).map(
            lambda values: Event(f"{function.__name__}({values})", lambda world: function(world, **values))
        )

    return strategy


def message(make: Callable[..., Message]) -> Callable[..., st.SearchStrategy[Event]]:
    def hear(world: World, **drawn: Any) -> None:
        world.hear(make(world, **drawn))

    hear.__name__ = make.__name__
    return event(hear)


def content(id: DatumId, size: int, kind: int, rotten: bool) -> Datum:
    d = make_datum(id, kind, 0.0, b"x" * size)
    return d._replace(crc=d.crc ^ 1) if rotten else d


@message
def hears_beacon(
    world: World, sender: int, base: bool, hops: int, free: int, potential: int, life: int, ahead: int, risk: int
) -> Beacon:
    world.beacons += ahead
    said = beacon(
        sender, world.beacons & 0xFFFF, None if hops == NO_ROUTE else Route(1, 1, world.beacons >> 4 & 0xFFFF, hops),
        life=life, flags=BEACON_BASE if base else 0, free=free, policy=world.node.policy.tag, potential=potential,
    )  # fmt: skip
    return said._replace(risk=risk)


@message
def hears_data(
    world: World, sender: int, target: int, what: list[tuple[int, tuple[DatumId, int, int, bool]]], replica: bool
) -> Data:
    return Data(sender, target, tuple(Handover(n, content(*of)) for n, of in what), replica)


@message
def hears_committed(world: World, sender: int, taken: list[int], refused: list[int], pick: int) -> Committed:
    numbers = [world.number(n) for n in taken]
    question = world.node.exchange.open.get(numbers[0]) if numbers else None
    if question is not None and pick % 8:
        sender = question.to
    return Committed(
        sender, ME, tuple((n, world.crc(n, pick)) for n in numbers), tuple(world.number(n) for n in refused)
    )


@message
def hears_offer(
    world: World, sender: int, number: int, of: tuple[DatumId, int, int, bool], size: int, chunk: int
) -> Offer:
    d = content(*of)
    return Offer(sender, ME, number, d.id, d.kind, d.created, 1, d.crc, size or len(d.payload), chunk)


@message
def hears_accept(world: World, sender: int, number: int, handle: int, next_index: int, aimed: bool) -> Accept:
    large = world.node.holdings.large
    if aimed and large:
        sender = sorted(large)[number % len(large)]
        pending = next(iter(large[sender].values()))
        return Accept(sender, ME, pending.number, handle, next_index)
    return Accept(sender, ME, world.number(number), handle, next_index)


@message
def hears_chunk(world: World, handle: int, position: int, poll: bool, size: int, aimed: bool) -> Chunk:
    handle = world.handles[handle % len(world.handles)]
    transfer = world.node.incoming.receiving.get(handle)
    if aimed and transfer is not None:
        position %= transfer.count
        size = transfer.length(position)
    return Chunk(ME, handle, position, poll, b"x" * size)


@message
def hears_sack(world: World, sender: int, handle: int, next_index: int, bitmap: int, aimed: bool) -> Sack:
    large = world.node.holdings.large
    if aimed and large:
        sender = sorted(large)[handle % len(large)]
        pending = next(iter(large[sender].values()))
        assert pending.sending is not None
        handle = handle if pending.sending.handle is None else pending.sending.handle
    return Sack(sender, ME, handle, next_index, bitmap)


@message
def hears_copy_statuses(world: World, sender: int, entries: list[tuple[DatumId, int]]) -> CopyStatuses:
    return CopyStatuses(sender, ME, tuple(CopyStatusEntry(*entry) for entry in entries))


@message
def hears_query(world: World, sender: int, ids: list[DatumId]) -> Query:
    return Query(sender, ME, tuple(ids))


@message
def hears_put(world: World, sender: int, of: tuple[DatumId, int, int, bool]) -> Put:
    return Put(sender, 1, sender, content(*of))


@message
def hears_receipt(world: World, of: DatumId, base: int, serial: int, run: int, bitmap: int, lost: bool) -> Receipt:
    entry = ReceiptEntry(of.origin, of.epoch, of.sequence, min(run, (1 << 32) - of.sequence), bitmap & ~1, lost)
    return make_receipt(base, 1, serial, [entry])


@message
def hears_sequence_mark(world: World, of: DatumId) -> SequenceMark:
    return make_sequence_mark(*of)


@message
def hears_deletion_report(world: World, sender: int, entries: list[tuple[int, DatumId, int]]) -> DeletionReport:
    return DeletionReport(
        sender, ME, tuple(DeletionEntry(number, id, why, note_crc(id, why)) for number, id, why in entries)
    )


@event
def steps(world: World, seconds: float) -> None:
    world.step(seconds)


@event
def forwards(world: World) -> None:
    world.forward()


@event
def puts(world: World, size: int) -> None:
    world.put(size)


@event
def restarts(world: World, committed: bool) -> None:
    world.restart(committed)


@event
def strikes(world: World, pick: int) -> None:
    world.strike(pick)


any_sender, any_id, any_number = st.sampled_from(SENDERS), st.sampled_from(IDS), st.integers(0, 9)
any_flag, any_size = st.booleans(), st.sampled_from(SIZES)
some_ids = st.lists(any_id, min_size=1, max_size=4)
seldom = st.integers(0, 9).map(lambda n: n == 9)
any_content = st.tuples(any_id, any_size, st.integers(0, 1), seldom)
small_content = st.tuples(any_id, st.sampled_from([1, 7, 97]), st.integers(0, 1), seldom)
any_event = st.one_of(
    hears_beacon(
        sender=any_sender, base=any_flag, hops=st.sampled_from([0, 1, 5, 254, NO_ROUTE]),
        free=st.sampled_from([0, 1, 50, 0xFFFF]), potential=st.sampled_from([0, 1, 1 << 20, POTENTIAL_BASE]),
        life=st.integers(1, 2), ahead=st.integers(0, 3), risk=st.sampled_from([0, 30000, 65535]),
    ),
    hears_data(
        sender=any_sender, target=st.sampled_from([ME, ME, 7]), replica=any_flag,
        what=st.lists(st.tuples(any_number, small_content), min_size=1, max_size=3),
    ),
    hears_copy_statuses(
        sender=any_sender, entries=st.lists(st.tuples(any_id, st.integers(0, 8)), min_size=1, max_size=6)
    ),
    hears_committed(
        sender=any_sender, taken=st.lists(st.integers(0, 19), max_size=3),
        refused=st.lists(st.integers(0, 19), max_size=2), pick=st.integers(0, 31),
    ),
    hears_offer(
        sender=any_sender, number=any_number, of=any_content,
        size=st.sampled_from([0, 0, 1, 300, 1 << 20, (1 << 32) - 1]), chunk=st.sampled_from([1, 100, 123]),
    ),
    hears_accept(
        sender=any_sender, number=st.integers(0, 19), handle=st.integers(0, 2), next_index=st.integers(0, 30),
        aimed=any_flag,
    ),
    hears_chunk(
        handle=st.integers(0, 3), position=st.integers(0, 20), poll=any_flag, size=st.sampled_from([1, 50, 100, 123]),
        aimed=any_flag,
    ),
    hears_sack(
        sender=any_sender, handle=st.integers(0, 2), next_index=st.integers(0, 30), bitmap=st.integers(0, 1 << 20),
        aimed=any_flag,
    ),
    hears_query(sender=any_sender, ids=some_ids),
    hears_put(sender=any_sender, of=small_content),
    hears_receipt(
        of=any_id, base=st.integers(0, 2), serial=st.integers(0, 3), run=st.sampled_from([1, 2, 3, 1 << 32]),
        bitmap=st.sampled_from([0, 2, 0xFFFE]), lost=any_flag,
    ),
    hears_sequence_mark(of=any_id),
    hears_deletion_report(
        sender=any_sender, entries=st.lists(st.tuples(any_number, any_id, st.integers(1, 7)), max_size=3)
    ),
    steps(seconds=st.sampled_from([0.3, 1.0, 1.0, 1.0, 4.0, 40.0])),
    forwards(),
    puts(size=any_size),
    restarts(committed=any_flag),
    strikes(pick=st.integers(0, 9)),
)  # fmt: skip
any_options = st.fixed_dictionaries(
    {
        "mirror": st.sampled_from([True, True, True, False]),
        "base": st.integers(0, 9).map(lambda n: n == 0),
        "overhear": any_flag,
        "immediate": any_flag,
        "mirror_until_receipt": any_flag,
        "receipts": any_flag,
        "policy": st.sampled_from(["rass", "hop-count", "survival"]),
        "capacity_items": st.sampled_from([1, 4, 50]),
        "capacity_bytes": st.sampled_from([None, 3000]),
        "drop_oldest": any_flag,
    }
)
#: A long hunt shows what it finds as it is: to shrink it takes minutes.
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


def id_conflict(sequence: int = 0, size: int = 7) -> Datum:
    return make_datum(DatumId(ME, EPOCH, sequence), 0, 0.0, b"x" * size)


def test_own_data_that_come_round_and_those_of_an_earlier_epoch_are_taken() -> None:
    node = make_node(ME)
    node.put(b"own", 0.0)
    own = some(node.store.get(DatumId(ME, EPOCH, 0)))
    earlier = make_datum(DatumId(ME, EPOCH - 1, 7), 0, 0.0, b"before the wipe")
    for number, d in enumerate((own, earlier), 1):
        assert node.receive(Data(4, ME, (Handover(number, d),)), 0.0) == [Committed(ME, 4, ((number, d.crc),), ())]
    assert not node.alarms.counts


def test_a_large_datum_made_under_a_number_that_a_neighbour_gave_away_is_never_sent_whole() -> None:
    world = World(mirror=True)
    world.meet()
    # The next number of ours, before the node has looked at what came in.
    world.hear(Data(3, ME, (Handover(5, id_conflict(2)),)))
    world.put(2000)
    for _ in range(5):
        world.forward()
        world.step(1.0)


@settings(max_examples=examples(60), phases=PHASES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(any_options, st.integers(1, 100).flatmap(lambda n: st.lists(any_event, min_size=n, max_size=n)))
def test_any_messages_in_any_order_leave_a_node_with_right_books(options: dict[str, Any], events: list[Event]) -> None:
    world = World(**options)
    world.meet()
    for happening in events:
        happening.happens(world)
