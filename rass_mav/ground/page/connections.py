"""The connections of the page: how many there may be at the same time, and the news that go to its browsers."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rass_mav.errors import RassError

#: Connections at the same time, and those that may wait to be accepted. Together they are far below the usual limit of
#: open files (1024).
MOST_CONNECTIONS = 64
BACKLOG = 32
#: Browsers at the same time, and the news that may wait for one of them.
MOST_CLIENTS = 16
MOST_WAITING = 32
#: Instead of news: the connection is at its end.
END = b""


class CrowdedError(RassError):
    """So many browsers are connected that there is no place for another."""


class Transport(Protocol):
    """A connection, as asyncio has it."""

    def abort(self) -> None:
        """End it at once."""

    def is_closing(self) -> bool:
        """Whether it ends, or has ended."""


class Client:
    """A connected browser."""

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.news: asyncio.Queue[bytes] = asyncio.Queue()
        """The hub bounds it."""


class Hub:
    """The browsers that are connected. Each has a queue of its own; one that is too slow is cut, and connects again."""

    def __init__(self, most: int = MOST_CLIENTS, waiting: int = MOST_WAITING) -> None:
        self._most, self._waiting = most, waiting
        self._clients: set[Client] = set()
        self.cut = 0
        """How many were too slow."""

    def __len__(self) -> int:
        return len(self._clients)

    def join(self, transport: Transport) -> Client:
        """A browser has connected. Raises `CrowdedError`."""
        for other in list(self._clients):
            if other.transport.is_closing():
                self._end(other)
        if len(self._clients) >= self._most:
            raise CrowdedError(f"{self._most} pages are open already: close one")
        client = Client(transport)
        self._clients.add(client)
        return client

    def leave(self, client: Client) -> None:
        """It is gone."""
        self._clients.discard(client)

    def publish(self, news: bytes) -> None:
        """Send news to all. A browser for which too much waits is cut."""
        for client in list(self._clients):
            if client.news.qsize() >= self._waiting:
                self.cut += 1
                self._end(client)
            else:
                client.news.put_nowait(news)

    def close(self, last: bytes) -> None:
        """End all connections in order; `last`: the last news. What is not sent soon is the server's to end."""
        for client in list(self._clients):
            self._empty(client)
            client.news.put_nowait(last)
            client.news.put_nowait(END)

    def _end(self, client: Client) -> None:
        client.transport.abort()
        self._empty(client)
        client.news.put_nowait(END)

    def _empty(self, client: Client) -> None:
        self.leave(client)
        while not client.news.empty():
            client.news.get_nowait()


class Door:
    """All connections. If there are too many, one of the address that has most is closed: one that asks nothing, if
    there is one, and of those the oldest."""

    def __init__(self, most: int = MOST_CONNECTIONS) -> None:
        self._most = most
        self._open: dict[Transport, str] = {}
        """Their addresses, the oldest first."""
        self._asking: set[Transport] = set()

    def enter(self, transport: Transport, address: str) -> None:
        """There is one more."""
        for other in list(self._open):
            if other.is_closing():
                del self._open[other]
        self._open[transport] = address
        if len(self._open) > self._most:
            counts = Counter(self._open.values())
            leaves = min(self._open, key=lambda other: (-counts[self._open[other]], other in self._asking))
            del self._open[leaves]
            leaves.abort()

    @contextmanager
    def asking(self, transport: Transport) -> Iterator[None]:
        """While a request is answered."""
        self._asking.add(transport)
        try:
            yield
        finally:
            self._asking.discard(transport)


class Guest(asyncio.Protocol):
    """A connection until it is let in."""

    def __init__(self, door: Door, made: Callable[[], asyncio.Protocol]) -> None:
        """`made`: returns the protocol that it speaks."""
        self._door, self._made = door, made

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        peer = transport.get_extra_info("peername")
        self._door.enter(transport, peer[0] if peer else "")
        protocol = self._made()
        transport.set_protocol(protocol)
        protocol.connection_made(transport)
