"""A conversation made of bytes: two drones and a base hear real frames, changed ones and invented ones."""

from __future__ import annotations

from rass_mav.core.messages import BROADCAST
from rass_mav.core.node import Node
from rass_mav.errors import DatumError, MalformedError, StoreFullError
from rass_mav.wire import decode, encode, target_of
from tests.core.books import check_node
from tests.core.build import make_node
from tests.core.durable import DurableStore

#: Deeds in one conversation.
MOST_DEEDS = 120
#: Frames that may be heard again later.
MOST_HEARD = 64
BASE, DRONES = 0, (1, 2)


class _Bytes:
    """The fuzzer's bytes, one after the other; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        return (self.some(1) or b"\0")[0]

    def some(self, count: int) -> bytes:
        taken = self._data[self._at : self._at + count]
        self._at += count
        return taken


class _Nodes:
    def __init__(self) -> None:
        self.now = 1000.0
        self.stores = {id: DurableStore(epoch=0x1000 + id) for id in (BASE, *DRONES)}
        self.nodes = {id: self.start(id) for id in self.stores}
        self.air: list[bytes] = []

    def start(self, id: int) -> Node:
        return make_node(
            id, store=self.stores[id], base=id == BASE, policy="survival", now=self.now, mirror=True, capacity_items=6,
            immediate=True, copies_auto=True, receipt_steps=1, lifetime_s=500.0, max_neighbours=4,
        )  # fmt: skip

    def restart(self, id: int) -> None:
        self.stores[id] = self.stores[id].crashed()
        self.nodes[id] = self.start(id)

    def hear(self, id: int, payload: bytes) -> None:
        try:
            message = decode(payload, self.now)
        except MalformedError:
            return
        node = self.nodes[id]
        self.say(id, [*node.receive(message, self.now), *node.forward(self.now)])

    def say(self, id: int, messages: list) -> None:  # type: ignore[type-arg]
        # Commit, then send.
        self.stores[id].commit()
        for message in messages:
            self.air += encode(message, self.now)
        del self.air[:-MOST_HEARD]

    def step(self, id: int) -> None:
        self.say(id, self.nodes[id].step(self.now))

    def put(self, id: int, size: int) -> None:
        try:
            self.nodes[id].put(bytes(size), self.now)
        except (StoreFullError, DatumError):
            return
        self.say(id, self.nodes[id].forward(self.now))

    def deliver(self) -> None:
        """All that is on the air reaches whom it is for, and so do the answers, up to a bound."""
        for _ in range(MOST_HEARD):
            if not self.air:
                return
            payload = self.air.pop(0)
            for id in self.nodes:
                if target_of(payload) in (id, BROADCAST):
                    self.hear(id, payload)


def play(data: bytes) -> None:
    """Each deed is a byte that says what happens, and to whom; some take more bytes."""
    source, all_nodes = _Bytes(data), _Nodes()
    for _ in range(MOST_DEEDS):
        if not source:
            break
        deed, whom = divmod(source.byte(), 3)
        match_air = all_nodes.air
        if deed % 9 == 0:
            all_nodes.now += 1.0
            for id in all_nodes.nodes:
                all_nodes.step(id)
        elif deed % 9 == 1:
            all_nodes.deliver()
        elif deed % 9 == 2:
            all_nodes.put(whom, source.byte() * 10)
        elif deed % 9 == 3:
            all_nodes.restart(whom)
        elif deed % 9 == 4:
            all_nodes.hear(whom, source.some(source.byte() % 128))
        elif deed % 9 in (5, 6) and match_air:
            # A frame that was said, with some bytes changed.
            payload = bytearray(match_air[source.byte() % len(match_air)])
            for _ in range(source.byte() % 4 if deed % 9 == 6 else 0):
                payload[source.byte() % len(payload)] = source.byte()
            all_nodes.hear(whom, bytes(payload))
        elif deed % 9 == 7 and match_air:
            match_air.pop(source.byte() % len(match_air))
        elif deed % 9 == 8:
            all_nodes.now += source.byte()
    for node in all_nodes.nodes.values():
        if not node.base:
            check_node(node)
