"""What the driver asks of a link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar

from .airtime import Budget

T = TypeVar("T")

#: Where a datagram came from: (IPv4 address, port), or a name and 0.
Address: TypeAlias = tuple[str, int]

#: Datagrams that may wait in a link for the driver. Beyond it the link stops reading, and the kernel's buffer fills.
MAX_INBOX = 256
#: Frames that may wait in a link because the socket would block.
MAX_OUTBOX = 256


class Datagram(NamedTuple):
    """What has arrived."""

    data: bytes
    source: Address


class LinkCounters(NamedTuple):
    """What a link has done since it was started."""

    sent: int
    """Datagrams sent, each receiver that was addressed by itself counted."""
    received: int
    """Datagrams taken in; own echoes are not counted."""
    dropped_in: int
    """Datagrams that arrived and were lost for want of room, as far as the system tells."""
    dropped_out: int
    """Datagrams that could not be sent: no route, nobody there, or too many were waiting."""
    echoes: int
    """Own datagrams that came back."""


class Port(ABC):
    """Something that bytes come in by and go out. Used on one event loop; never raises for what happens to it."""

    name: str
    """How status and log call it."""
    stream = False
    """True: what `receive` returns are pieces of a stream, which may end in the middle of a frame. False: each piece
    holds whole frames."""

    @abstractmethod
    def start(self, wake: Callable[[], None]) -> None:
        """Begin to read, on the running event loop. `wake` is called when something has arrived."""

    @property
    def generation(self) -> int:
        """How often the port was opened: what was half read before has no end any more."""
        return 1

    @property
    def trouble(self) -> str:
        """Why the port is not open; empty while it is."""
        return ""

    @abstractmethod
    def counters(self) -> LinkCounters:
        """What has been done so far. Not for every datagram: may ask the system."""

    @abstractmethod
    def close(self) -> None:
        """Release the sockets. What waits to be sent is lost, as frames may be."""


class Link(Port):
    """Datagrams from and to the neighbours."""

    budget: Budget | None = None
    """What may be sent; None: as much as one likes."""
    one_hop = True
    """Who is heard is one hop away. False: somebody on the way forwards frames."""
    only: frozenset[int] | None = None
    """Node ids that are taken for neighbours on this link; None: all."""

    def __init__(self, name: str) -> None:
        """`name`: how status and log call it."""
        self.name = name
        self._received = 0
        self._inbox: deque[Datagram] = deque()

    @abstractmethod
    def receive(self) -> list[Datagram]:
        """What has arrived, at most `MAX_INBOX` datagrams, in order. Who does not call it slows the sender, not us."""

    @abstractmethod
    def send(self, frame: bytes, target: int) -> None:
        """Send a frame to the node with id `target` if its address is known, else (BROADCAST too) to everybody."""

    @abstractmethod
    def reaches(self, target: int) -> bool:
        """Whether the address of this node is known on this link."""

    @abstractmethod
    def learn(self, node_id: int, source: Address) -> None:
        """A beacon of this node came from there. What the configuration says of it stays."""


def remember(known: OrderedDict[int, T], node_id: int, value: T, most: int) -> None:
    """Note something about the node that was heard last; beyond `most` the longest silent one is forgotten."""
    known[node_id] = value
    known.move_to_end(node_id)
    if len(known) > most:
        known.popitem(last=False)
