"""A conversation made of bytes: two drones and a base hear real frames, changed ones and invented ones."""

from __future__ import annotations

import struct
from collections.abc import Callable

from rass_mav.core.datum import Datum, DatumId
from rass_mav.core.messages import BROADCAST, Message
from rass_mav.core.news.receipts import Receipts
from rass_mav.core.node import Node
from rass_mav.core.participant import Participant
from rass_mav.core.store import MAX_APART
from rass_mav.errors import DatumError, MalformedError, StoreFullError
from rass_mav.wire import decode, encode, is_overheard, target_of
from tests.core.books import check_node
from tests.core.build import make_node, make_stigmergy_node
from tests.core.durable import DurableStore

from .forging import Liar, changed, sealed
from .source import Source

#: Deeds in one conversation.
MOST_DEEDS = 120
#: Frames that may be heard again later.
MOST_HEARD = 64
BASE, DRONES = 0, (1, 2)


class Conversation:
    """What the nodes say and hear, and what must hold whatever it is."""

    def __init__(self, source: Source) -> None:
        self.source = source
        world = source.byte()
        self.policy = ("survival", "rass")[world & 1]
        self.risk = 0.5 if world & 2 else 0.0
        self.cut = {BASE, DRONES[1]} if world & 4 else set[int]()
        """Two that do not hear each other: what the second drone has goes through the first."""
        self.stigmergy = bool(world & 8)
        self.now = 1000.0
        self.lives = 0
        self.stores = {id: DurableStore(epoch=0x1000 + id) for id in (BASE, *DRONES)}
        self.nodes = {id: self.start(id) for id in self.stores}
        self.air: list[tuple[int, bytes]] = []
        """Who said it, and the frame."""
        self.arrived: dict[DatumId, Datum] = {}
        """What the base had on its disk."""

    def start(self, id: int) -> Participant:
        self.lives += 1
        if self.stigmergy:
            return make_stigmergy_node(id, store=self.stores[id], capacity_items=6, lifetime_s=500.0, max_neighbours=4)
        return make_node(
            id, store=self.stores[id], base=id == BASE, policy=self.policy, risk=self.risk, now=self.now, mirror=True,
            overhear=True, capacity_items=6, immediate=True, receipt_steps=1, lifetime_s=500.0,
            max_neighbours=4, seed=self.lives,
        )  # fmt: skip

    def receive(self, id: int, payload: bytes) -> list[Message]:
        try:
            message = decode(payload, self.now)
        except MalformedError:
            return []
        node = self.nodes[id]
        return [*node.receive(message, self.now), *node.forward(self.now)]

    def hear(self, id: int, payload: bytes) -> None:
        self.say(id, self.receive(id, payload))

    def say(self, id: int, messages: list[Message]) -> None:
        # Commit, then send.
        self.stores[id].commit()
        for message in messages:
            self.air += [(id, payload) for payload in encode(message, self.now)]
        del self.air[:-MOST_HEARD]

    def lie(self, make: Callable[[], Message]) -> bytes:
        """The frame of a message that no node says; empty: it cannot be said."""
        try:
            return self.source.pick(encode(sealed(make()), self.now))
        except (ValueError, OverflowError, struct.error):
            return b""

    def check(self) -> None:
        """The books of all nodes are right, and what has once arrived stays as it is."""
        for id, node in self.nodes.items():
            store = self.stores[id]
            assert len(list(store.apart())) <= MAX_APART
            if not isinstance(node, Node):
                assert set(node.holdings) == set(store.ids())
                continue
            assert isinstance(node.receipts, Receipts)
            assert not node.receipts.disagreement()
            if id == BASE:
                now_there = store.disk.data
                assert all(now_there.get(id) == datum for id, datum in self.arrived.items())
                self.arrived = dict(now_there)
            else:
                check_node(node)
                assert set(node.holdings) == set(store.ids())


# -- deeds: what may happen, to whom -----------------------------------------------------------------------------------


def _turn(talk: Conversation, whom: int) -> None:
    talk.now += 1.0
    for id, node in talk.nodes.items():
        talk.say(id, node.step(talk.now))


def _deliver(talk: Conversation, whom: int) -> None:
    """All that is on the air reaches whom it is for, and so do the answers, up to a bound."""
    for _ in range(MOST_HEARD):
        if not talk.air:
            return
        sender, payload = talk.air.pop(0)
        for id, node in talk.nodes.items():
            if (
                (target_of(payload) in (id, BROADCAST) or (node.overhears and is_overheard(payload)))
                and id != sender
                and {id, sender} != talk.cut
            ):
                talk.hear(id, payload)


def _put(talk: Conversation, whom: int) -> None:
    payload = bytes(talk.source.byte() * 10)
    try:
        talk.nodes[whom].put(payload, talk.now)
    except (StoreFullError, DatumError):
        return
    talk.say(whom, talk.nodes[whom].forward(talk.now))


def _restart(talk: Conversation, whom: int) -> None:
    talk.stores[whom] = talk.stores[whom].crashed()
    talk.nodes[whom] = talk.start(whom)


def _hear_bytes(talk: Conversation, whom: int) -> None:
    talk.hear(whom, talk.source.some(talk.source.byte() % 128))


def _hear_again(talk: Conversation, whom: int) -> None:
    """A frame that was said, also by somebody whom it is not for."""
    if talk.air:
        talk.hear(whom, talk.source.pick(talk.air)[1])


def _hear_noise(talk: Conversation, whom: int) -> None:
    """A frame that was said, with some bytes changed."""
    if talk.air:
        payload = bytearray(talk.source.pick(talk.air)[1])
        for _ in range(talk.source.byte() % 4):
            payload[talk.source.byte() % len(payload)] = talk.source.byte()
        talk.hear(whom, bytes(payload))


def _changed_frame(talk: Conversation) -> bytes:
    if not talk.air:
        return b""
    message = decode(talk.source.pick(talk.air)[1], talk.now)
    return talk.lie(lambda: changed(message, talk.source))


def _hear_changed(talk: Conversation, whom: int) -> None:
    """A message that was said, with fields changed and right checksums."""
    talk.hear(whom, _changed_frame(talk))


def _hear_invented(talk: Conversation, whom: int) -> None:
    """A message that somebody makes up for this node."""
    known = [datum for store in talk.stores.values() for datum in store.disk.data.values()]
    liar = Liar(talk.source, talk.nodes[whom], known, talk.now)
    talk.hear(whom, talk.lie(liar.message))


def _roll_back(talk: Conversation, whom: int) -> None:
    """A frame that hits a fault: what it changed is dropped, and a new node takes over."""
    talk.receive(whom, _changed_frame(talk))
    talk.stores[whom].roll_back()
    talk.nodes[whom] = talk.start(whom)


def _strike(talk: Conversation, whom: int) -> None:
    """Radiation hits a copy in a drone."""
    stored = list(talk.stores[whom].ids())
    if stored and whom != BASE:
        talk.stores[whom].flip_bit(talk.source.pick(stored))


def _lose(talk: Conversation, whom: int) -> None:
    if talk.air:
        talk.air.pop(talk.source.byte() % len(talk.air))


def _wait(talk: Conversation, whom: int) -> None:
    talk.now += talk.source.byte()


DEEDS: tuple[Callable[[Conversation, int], None], ...] = (
    _turn, _deliver, _put, _restart, _hear_bytes, _hear_again, _hear_noise, _hear_changed, _hear_invented, _roll_back,
    _strike, _lose, _wait,
)  # fmt: skip


def play(data: bytes) -> None:
    """The first byte says what world it is. Each deed is a byte, what happens and to whom; some take more bytes."""
    source = Source(data)
    talk = Conversation(source)
    for _ in range(MOST_DEEDS):
        if not source:
            break
        deed, whom = divmod(source.byte(), len(talk.nodes))
        DEEDS[deed % len(DEEDS)](talk, whom)
        talk.check()
