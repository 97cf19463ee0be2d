"""Two nodes and a thin link between them in virtual time: a rate, a delay, and frames that get lost.

Each direction has its own capacity and its own queue without end. Everything is drawn from one seed.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from heapq import heappop, heappush
from typing import NamedTuple

from rass_mav.core.datum import DatumId
from rass_mav.core.messages import BROADCAST, Chunk, Committed, Message
from rass_mav.core.node import Node
from rass_mav.wire import decode, encode

from .build import make_node
from .durable import DurableStore

#: What MAVLink adds to a TUNNEL payload on the air, bytes.
AROUND = 17
#: The part of a full frame that is a datum's.
SHARE = 123 / 145
STEP_S = 1.0
CUSTODIAN, BASE = 1, 0


class Line(NamedTuple):
    """A link, the same in both directions."""

    bytes_s: float
    delay_s: float = 0.02
    loss: float = 0.0
    """Of each frame by itself, 0..1."""
    doubled: float = 0.0
    late: float = 0.0
    """The share of the frames that others overtake,"""
    late_s: float = 0.0
    """and how much longer they take at most, seconds."""
    slow_s: tuple[float, float] = (0.0, 0.0)
    """How long a node takes to handle a frame, seconds, from and to; frames stay in order."""
    chunks_last: bool = False
    """Whether all else goes before the chunks that wait, as in the pacer of a link."""


class Pair:
    """A sender with data and a base. `run` lets time pass."""

    def __init__(self, line: Line, seed: int, *, disk_s: float = 0.0) -> None:
        """`disk_s`: how long COMMITTED waits for the disk, seconds."""
        self.line = line
        self.now = 0.0
        self._rng = random.Random(seed)
        self._seed = seed
        self._disk_s = disk_s
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self.lives = 0
        self.stores = {id: DurableStore(epoch=1000 + id) for id in (CUSTODIAN, BASE)}
        self.nodes: dict[int, Node] = {}
        self._free_at = dict.fromkeys((CUSTODIAN, BASE), 0.0)
        self._handled_at = dict.fromkeys((CUSTODIAN, BASE), 0.0)
        self._tending = dict.fromkeys((CUSTODIAN, BASE), float("inf"))
        self.up = True
        """Whether the link carries anything."""
        self.bytes = Counter[int]()
        """Bytes put on the link by each node."""
        self.chunks = 0
        """Chunks with data that the sender has sent."""
        self.frames = Counter[type]()
        """By kind."""
        self.tamper: Callable[[int, Message], list[Message]] = lambda to, message: [message]
        """What arrives in place of a message."""
        for id in (BASE, CUSTODIAN):
            self.start(id)
        # They hear each other before there are data.
        self.run(2.6 * STEP_S)
        self.bytes.clear()

    def start(self, id: int) -> None:
        """Switch a node on, over what is on its disk."""
        self.lives += 1
        store = self.stores[id] = self.stores[id].crashed()
        node = self.nodes[id] = make_node(
            id, store=store, base=id == BASE, immediate=True, now=self.now, seed=self._seed * 100 + self.lives,
            newborn=True, capacity_items=None,
        )  # fmt: skip
        life = self.lives

        def step() -> None:
            if self.nodes.get(id) is node:
                self._say(id, node.step(self.now))
                self._at(STEP_S, step)

        self._at(STEP_S * (0.1 + 0.3 * id) if life <= 2 else 0.01, step)

    def stop(self, id: int) -> None:
        """A node goes off: its memory is gone, and what it has not written."""
        del self.nodes[id]

    def put(self, *payloads: bytes) -> list[DatumId]:
        """Data of the sender."""
        custodian = self.nodes[CUSTODIAN]
        ids = [custodian.put(payload, self.now) for payload in payloads]
        self.stores[CUSTODIAN].commit()
        self._say(CUSTODIAN, custodian.forward(self.now))
        return ids

    def _at(self, delay_s: float, event: Callable[[], None]) -> None:
        self._count += 1
        heappush(self._events, (self.now + delay_s, self._count, event))

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass until something is true. False: it is not."""
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, event = heappop(self._events)
            event()
            if until():
                return True
        self.now = end
        return until()

    def _say(self, id: int, messages: list[Message]) -> None:
        self.stores[id].commit()
        to = BASE if id == CUSTODIAN else CUSTODIAN
        for message in messages:
            if type(message) is Committed and self._disk_s:
                self._at(self._disk_s, lambda message=message: self._send(id, to, message))  # type: ignore[misc]
            else:
                self._send(id, to, message)
        self._tend_later(id)

    def _send(self, id: int, to: int, message: Message) -> None:
        line, rng = self.line, self._rng
        for payload in encode(message, self.now):
            size = len(payload) + AROUND
            self.bytes[id] += size
            self.frames[type(message)] += 1
            self.chunks += type(message) is Chunk and bool(message.data)
            self._free_at[id] = max(self._free_at[id], self.now) + size / line.bytes_s
            first = line.chunks_last and type(message) is not Chunk
            leaves = self.now + size / line.bytes_s if first else self._free_at[id]
            if not self.up or rng.random() < line.loss:
                continue
            for _ in range(2 if rng.random() < line.doubled else 1):
                delay_s = leaves - self.now + line.delay_s
                if rng.random() < line.late:
                    delay_s += rng.random() * line.late_s
                self._at(delay_s, lambda payload=payload: self._arrive(to, payload))  # type: ignore[misc]

    def _arrive(self, to: int, payload: bytes) -> None:
        low, high = self.line.slow_s
        if not high:
            self._hear(to, payload)
            return
        # A processor that is busy handles what came meanwhile at once, later.
        at = self._handled_at[to] = (
            self.now + self._rng.uniform(low, high) if self._handled_at[to] <= self.now else self._handled_at[to]
        )
        self._at(at - self.now, lambda: self._hear(to, payload))

    def _hear(self, to: int, payload: bytes) -> None:
        for message in self.tamper(to, decode(payload, self.now)):
            node = self.nodes.get(to)
            if node is None or getattr(message, "target", to) not in (to, BROADCAST):
                return
            answers = node.receive(message, self.now)
            self._say(to, answers + node.forward(self.now))

    def _tend_later(self, id: int) -> None:
        node = self.nodes[id]
        due = node.exchange.due
        if due == self._tending[id]:
            return
        self._tending[id] = due

        def tend() -> None:
            if self.nodes.get(id) is node:
                self._say(id, node.tend(self.now))

        if due < float("inf"):
            self._at(max(0.0, due - self.now), tend)

    # -- what came of it -----------------------------------------------------------------------------------------------

    @property
    def backlog_s(self) -> float:
        """How long the link needs for what the sender has sent and has not left yet, seconds."""
        return max(0.0, self._free_at[CUSTODIAN] - self.now)

    def is_over(self) -> bool:
        """Whether the sender has handed everything over, and knows it."""
        return CUSTODIAN in self.nodes and not self.nodes[CUSTODIAN].holdings.custody

    def arrived(self) -> dict[DatumId, bytes]:
        """What the base has on disk."""
        found = {id: self.stores[BASE].get(id) for id in self.stores[BASE].ids()}
        return {id: d.payload for id, d in found.items() if d is not None}
