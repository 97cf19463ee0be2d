"""The cables of a flown swarm: UDP sockets on 127.0.0.1 that learn who is at their other end."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Iterator

from rass_mav.link.base import Address
from rass_mav.link.sockets import MAX_DATAGRAM, MAX_PER_WAKE, bound_socket, kernel_drops
from rass_mav.mavlink.reader import FrameReader

LOCALHOST = "127.0.0.1"


class Wire:
    """One end of a cable: a socket of ours, and who has spoken to it last."""

    def __init__(self, port: int = 0) -> None:
        """`port` 0: the system chooses. Raises `LinkError` for a port in use."""
        self.sock = bound_socket(f"{LOCALHOST}:{port}", (LOCALHOST, port))
        self.port: int = self.sock.getsockname()[1]
        self.reader = FrameReader()
        self.peer: Address | None = None

    def datagrams(self) -> Iterator[bytes]:
        """What has arrived, up to a bound."""
        for _ in range(MAX_PER_WAKE):
            try:
                data, self.peer = self.sock.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:
                continue  # an earlier datagram of ours found nobody
            yield data

    def forget(self) -> None:
        """Who was at the other end is gone: so is what it sent last, and its port may be another's soon."""
        while any(True for _ in self.datagrams()):
            pass
        self.peer = None

    def send(self, data: bytes) -> bool:
        """False: nobody has spoken yet, or there is no room."""
        if self.peer is None:
            return False
        try:
            self.sock.sendto(data, self.peer)
        except OSError:
            return False
        return True

    @property
    def overrun(self) -> int:
        """Datagrams that found no room in the kernel."""
        return kernel_drops(self.sock)


class Wires:
    """All of them, and what is to be done when something arrives."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._all: list[Wire] = []

    def new(self, handle: Callable[[int, bytes], None], node: int, port: int = 0) -> Wire:
        """A wire of a node; `handle` gets the node and each datagram. Raises `LinkError`."""
        wire = Wire(port)
        self._all.append(wire)

        def ready() -> None:
            for data in wire.datagrams():
                handle(node, data)

        self._selector.register(wire.sock, selectors.EVENT_READ, ready)
        return wire

    def watch(self, file: int, ready: Callable[[], None]) -> None:
        """Let `poll` call `ready` when there is something to read from a file descriptor."""
        self._selector.register(file, selectors.EVENT_READ, ready)

    def poll(self, timeout_s: float) -> None:
        """Handle what has arrived; wait for it at most so long."""
        for key, _ in self._selector.select(max(timeout_s, 0.0)):
            key.data()

    def close(self) -> None:
        """Release the sockets."""
        self._selector.close()
        for wire in self._all:
            wire.sock.close()
