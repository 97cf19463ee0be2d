"""The browsers that are connected. Each has a queue of its own; one that is too slow is cut, and connects again."""

from __future__ import annotations

import asyncio
from typing import Protocol

from rass_mav.errors import RassError

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

    def __init__(self, transport: Transport, waiting: int) -> None:
        self.transport = transport
        self.news: asyncio.Queue[bytes] = asyncio.Queue(waiting)


class Hub:
    """All of them."""

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
        client = Client(transport, self._waiting)
        self._clients.add(client)
        return client

    def leave(self, client: Client) -> None:
        """It is gone."""
        self._clients.discard(client)

    def publish(self, news: bytes) -> None:
        """Send news to all. A browser for which too much waits is cut."""
        for client in list(self._clients):
            if client.news.full():
                self.cut += 1
                self._end(client)
            else:
                client.news.put_nowait(news)

    def close(self) -> None:
        """End all connections."""
        for client in list(self._clients):
            self._end(client)

    def _end(self, client: Client) -> None:
        self.leave(client)
        client.transport.abort()
        while not client.news.empty():
            client.news.get_nowait()
        client.news.put_nowait(END)
