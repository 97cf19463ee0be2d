"""The interface of a link."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias, TypeVar

from .budget import USUAL, Budget
from .interface import Carrier
from .radios import Radio

T = TypeVar("T")

#: Where a datagram came from: (IPv4 address, port), or a name and 0.
Address: TypeAlias = tuple[str, int]

#: Datagrams that may wait in a link for the driver, and their bytes. When there are more, the link stops reading, and
#: the kernel's buffer fills.
MAX_INBOX = 256
MAX_INBOX_BYTES = 1 << 16
#: Datagrams and bytes handed out in one turn, at least one datagram. So other links, the step and the control socket's
#: clients get their turn, whatever arrives.
MAX_TURN = 64
MAX_TURN_BYTES = 8192
#: Frames that may wait in a link because the socket would block.
MAX_OUTBOX = 256


class Datagram(NamedTuple):
    """A received datagram."""

    data: bytes
    source: Address


class Inbox:
    """Received datagrams that wait for the driver."""

    def __init__(self) -> None:
        self.wake: Callable[[], None] = lambda: None  # until the port is started
        """Called when there is something to take."""
        self.taken = 0
        """Datagrams handed out."""
        self._waiting: deque[Datagram] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether there is no space left. The kernel then has to keep what arrives."""
        return len(self._waiting) >= MAX_INBOX or self._bytes >= MAX_INBOX_BYTES

    def put(self, datagram: Datagram) -> None:
        """Add a datagram. After the last one the caller calls `wake`."""
        self._waiting.append(datagram)
        self._bytes += len(datagram.data)

    def take(self) -> list[Datagram]:
        """The datagrams of one turn, in order. If some remain, `wake` is called when the event loop has gone round."""
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
    """Datagrams sent; one to several addressed receivers counts once for each."""
    received: int
    """Datagrams received, without own echoes."""
    dropped_in: int
    """Datagrams that arrived and were lost because a buffer was full, as far as the system reports it."""
    dropped_out: int
    """Datagrams that could not be sent: no route, no receiver, or too many were waiting."""
    echoes: int
    """Own datagrams that came back."""


class Remark(NamedTuple):
    """A part of a link's configuration that does not fit the computer's present state, although it may fit later."""

    key: str
    """Key of the configuration."""
    text: str
    remedy: str
    works: bool = False
    """The link works, but perhaps not as intended."""


class Port(ABC):
    """A connection that carries bytes in and out. Used on one event loop. Never raises, whatever happens to it."""

    name: str
    """Its name in status and log."""
    stream = False
    """True: `receive` returns pieces of a stream, which may end in the middle of a frame. False: each piece contains
    whole frames."""

    @abstractmethod
    def start(self, wake: Callable[[], None]) -> None:
        """Start reading, on the running event loop. `wake` is called when something has arrived."""

    @property
    def generation(self) -> int:
        """How often the port was opened. A frame that was half read before an opening cannot be completed."""
        return 1

    @property
    def trouble(self) -> str:
        """Why the port is not open; empty while it is."""
        return ""

    @abstractmethod
    def counters(self) -> LinkCounters:
        """The counters so far. It may ask the system, so do not call it for every datagram."""

    @abstractmethod
    def close(self) -> None:
        """Release the sockets. Waiting frames are lost."""


class Link(Port):
    """Datagrams from and to the neighbours."""

    budget: Budget | None = None
    """What may be sent; None: no limit."""
    radio: Radio | None = None
    """What is known of its radio; None: nothing."""
    broadcasts = True
    """Whether all neighbours hear every frame."""
    one_hop = True
    """Whether nodes that are heard are one hop away. False: frames may be forwarded on the way."""
    only: frozenset[int] | None = None
    """Node ids accepted as neighbours on this link; None: all."""
    through = False
    """Whether it goes through the autopilot's port, whose owner then reads it, and calls `took`."""

    def __init__(self, name: str) -> None:
        """`name`: its name in status and log."""
        self.name = name

    @property
    def waiting(self) -> int:
        """Bytes that the system has accepted and that have not left, as far as it reports them. For links without a
        budget."""
        return 0

    @staticmethod
    def remarks(section: Any, key: str) -> Iterable[Remark]:
        """Settings of a checked section that do not fit the computer's present state. `key`: the section's key."""
        return ()

    @staticmethod
    def usual(section: Any) -> Budget:
        """What may be sent where `airtime` of a checked section is silent."""
        radio: Radio | None = section.known_radio
        return USUAL if radio is None else radio.usual

    def carriers(self) -> list[Carrier]:
        """The network interfaces through which the neighbours are reached; empty: it uses none."""
        return []

    def report(self) -> dict[str, Any]:
        """What only this kind of link knows, for `status`."""
        return {}

    @abstractmethod
    def receive(self) -> list[Datagram]:
        """The datagrams of one turn, in order. Without calls the sender has to wait; our memory does not grow."""

    def took(self) -> None:
        """Count a frame that came `through` the autopilot's port."""

    @abstractmethod
    def send(self, frame: bytes, target: int) -> None:
        """Send a frame to the node `target` if its address is known, otherwise (also for BROADCAST) to everybody."""

    @abstractmethod
    def reaches(self, target: int) -> bool:
        """Whether the address of this node is known on this link."""

    @abstractmethod
    def learn(self, node_id: int, source: Address) -> None:
        """A beacon of this node came from this address. An address in the configuration takes precedence."""


def remember(table: OrderedDict[int, T], node_id: int, value: T, most: int) -> None:
    """Store a value for a node that was just heard. If there are more than `most`, forget the longest silent one."""
    table[node_id] = value
    table.move_to_end(node_id)
    if len(table) > most:
        table.popitem(last=False)
