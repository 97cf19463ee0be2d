"""What the driver asks of a link."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias, TypeVar

from .airtime import Budget
from .interface import Carrier

T = TypeVar("T")

#: Where a datagram came from: (IPv4 address, port), or a name and 0.
Address: TypeAlias = tuple[str, int]

#: Datagrams that may wait in a link for the driver, and their bytes. Beyond it the link stops reading, and the kernel's
#: buffer fills.
MAX_INBOX = 256
MAX_INBOX_BYTES = 1 << 16
#: Of these so many are handed out in one turn, and so many bytes or one datagram: other links, the step and whoever
#: asks at the control socket come in between, whatever arrives.
MAX_TURN = 64
MAX_TURN_BYTES = 8192
#: Frames that may wait in a link because the socket would block.
MAX_OUTBOX = 256


class Datagram(NamedTuple):
    """What has arrived."""

    data: bytes
    source: Address


class Inbox:
    """What has arrived on a port and waits for the driver."""

    def __init__(self) -> None:
        self.wake: Callable[[], None] = lambda: None  # nobody is listening yet
        """Called when there is something to take."""
        self.taken = 0
        """Datagrams handed out."""
        self._waiting: deque[Datagram] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Then the kernel has to keep what comes."""
        return len(self._waiting) >= MAX_INBOX or self._bytes >= MAX_INBOX_BYTES

    def put(self, datagram: Datagram) -> None:
        """Something has arrived. Who puts it calls `wake` when that is all."""
        self._waiting.append(datagram)
        self._bytes += len(datagram.data)

    def take(self) -> list[Datagram]:
        """A turn of it, in order. If something is left, `wake` is called when the event loop has gone round."""
        waiting = self._waiting
        turn: list[Datagram] = []
        room = MAX_TURN_BYTES
        while waiting and len(turn) < MAX_TURN and (not turn or len(waiting[0].data) <= room):
            turn.append(waiting.popleft())
            room -= len(turn[-1].data)
        self.taken += len(turn)
        self._bytes -= MAX_TURN_BYTES - room
        if waiting:
            asyncio.get_running_loop().call_soon(self.wake)
        return turn


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


class Remark(NamedTuple):
    """What of a link's configuration does not fit this computer as it is now, though it may fit it later."""

    key: str
    """Of the configuration."""
    text: str
    remedy: str
    works: bool = False
    """The link works, but perhaps not as it was meant."""


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
        self._inbox = Inbox()

    @staticmethod
    def remarks(section: Any, key: str) -> Iterable[Remark]:
        """What of its section, which was checked, does not fit this computer as it is now. `key`: of the section."""
        return ()

    def carriers(self) -> list[Carrier]:
        """The network interfaces by which the neighbours are reached; none: it needs none."""
        return []

    @abstractmethod
    def receive(self) -> list[Datagram]:
        """What has arrived, so much as one turn bears, in order. Who does not call it slows the sender, not us."""

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
