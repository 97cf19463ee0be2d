"""How many connections the page has at the same time: whoever opens more makes way for others."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rass_mav.ground.page.hub import Transport

#: Connections at the same time, and those that may wait to be accepted. Together they are far below the usual limit of
#: open files (1024).
MOST_CONNECTIONS = 64
BACKLOG = 32


class Door:
    """The connections. If there are too many, one of the address that has most is closed: one that asks nothing, if
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
