"""A few nodes with custody with replicas in a small network whose frames a test may lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rass_mav.core.datum import USUAL, Datum, DatumId, Fate, Terms
from rass_mav.core.messages import BROADCAST, Data, Message
from rass_mav.core.node import Node
from rass_mav.core.observer import Observer

from .books import check_node, holders
from .build import make_node
from .durable import DurableStore


class Book(Observer):
    """Counts copies, and keeps why each was dropped."""

    def __init__(self) -> None:
        self.copies: dict[DatumId, int] = {}
        self.fates: list[tuple[DatumId, Fate]] = []

    def gained(self, datum: Datum) -> None:
        self.copies[datum.id] = self.copies.get(datum.id, 0) + 1

    def dropped(self, id: DatumId, fate: Fate) -> None:
        self.copies[id] -= 1
        self.fates.append((id, fate))


class Net:
    """Nodes by id, and who hears whom. Steps are one second; a step's frames and all answers arrive at once, after
    what they depend on is on disk."""

    def __init__(
        self, risks: dict[int, float], links: Iterable[tuple[int, int]], *, base: int = -1,
        own: dict[int, dict[str, Any]] | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        """`risks`: of each node. All nodes but `base` are drones with replicas. `own`: settings of single nodes."""
        self.links = {frozenset(link) for link in links}
        self.base = base
        self.settings: dict[str, Any] = {"mirror": True, "mirror_until_receipt": False, **settings}
        self.own: dict[int, dict[str, Any]] = own or {}
        self.risks = risks
        self.book = Book()
        self.stores = {i: DurableStore(1000 + i) for i in risks}
        self.nodes: dict[int, Node] = {}
        self.off: set[int] = set()
        self.said: list[Message] = []
        self.loses: Callable[[Message], bool] = lambda message: False
        self.now = 0.0
        for i in risks:
            self.start(i)

    def start(self, i: int, **more: Any) -> Node:
        """A new life on the node's store."""
        node = self.nodes[i] = make_node(
            i, store=self.stores[i], risk=self.risks[i], now=self.now, seed=int(self.now), base=i == self.base,
            observer=None if i == self.base else self.book, **{**self.settings, **self.own.get(i, {}), **more},
        )  # fmt: skip
        return node

    def deliver(self, messages: list[tuple[int, Message]]) -> None:
        """Deliver messages, each with its sender, and the answers to them, until all is silent."""
        queue = list(messages)
        while queue:
            sender, message = queue.pop(0)
            self.said.append(message)
            target = getattr(message, "target", BROADCAST)
            for i, node in self.nodes.items():
                if i in self.off or frozenset((i, sender)) not in self.links:
                    continue
                # Data for others are heard too.
                if (target in (i, BROADCAST) or type(message) is Data) and not self.loses(message):
                    answers = node.receive(message, self.now)
                    self.stores[i].commit()
                    moves = self.forwarded(node)
                    queue += [(i, more) for more in node.needed(answers, moves) + moves]

    def forwarded(self, node: Node) -> list[Message]:
        return node.forward(self.now) if node.settings.immediate else []

    def step(self, count: int = 1) -> None:
        """Steps of all nodes that are on; `said` holds what was said in the last one."""
        for _ in range(count):
            self.now += 1.0
            self.said = []
            queue: list[tuple[int, Message]] = []
            for i, node in self.nodes.items():
                if i not in self.off:
                    queue += [(i, message) for message in node.step(self.now)]
                    self.stores[i].commit()
            self.deliver(queue)
            for node in self.nodes.values():
                check_node(node)

    def put(self, i: int, payload: bytes = b"reading", kind: int = 0, terms: Terms = USUAL) -> DatumId:
        node = self.nodes[i]
        id = node.put(payload, self.now, kind, terms)
        self.deliver([(i, message) for message in self.forwarded(node)])
        return id

    def custody(self, id: DatumId) -> list[int]:
        """Who has custody of a datum."""
        return [i for i, node in self.nodes.items() if id in node.holdings.custody]

    def replicas(self, id: DatumId) -> list[int]:
        """Who has a replica of it."""
        return [i for i, node in self.nodes.items() if id in node.holdings and id not in node.holdings.custody]

    def active(self, id: DatumId) -> list[int]:
        """Who has an active replica of it."""
        return [i for i, node in self.nodes.items() if id in node.holdings.replica]

    def holder(self, i: int, id: DatumId) -> int | None:
        return holders(self.nodes[i]).get(id)

    def strike(self, i: int, id: DatumId) -> None:
        self.stores[i].flip_bit(id)

    def of(self, kind: type) -> list[Any]:
        """What was said of a kind in the last step."""
        return [message for message in self.said if type(message) is kind]


#: A chain down the risk: 1 gives to 2, 2 to 3; data rest at 3.
RISKS = {1: 0.9, 2: 0.5, 3: 0.1}
CHAIN = [(1, 2), (2, 3)]


def handed_over(net: Net) -> DatumId:
    """A datum that 1 has handed to 2."""
    net.step()
    id = net.put(1)
    net.step()
    assert net.custody(id) == [2]
    return id


def at_rest(net: Net) -> DatumId:
    """A datum that has come from 1 over 2 to 3, of which 2 has told 1 in the last step."""
    id = handed_over(net)
    net.step()
    assert net.custody(id) == [3]
    net.step()
    return id
