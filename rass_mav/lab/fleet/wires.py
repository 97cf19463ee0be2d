"""The cables of a swarm of real processes: UDP sockets on 127.0.0.1 that learn the address of their other end."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Iterator

from rass_mav.link.base import Address
from rass_mav.link.sockets import MAX_DATAGRAM, MAX_PER_WAKE, bound_socket, kernel_drops
from rass_mav.mavlink.frames import FLAG_SIGNED, MAGIC_V1, MAGIC_V2, Frame, FrameReader
from rass_mav.mavlink.signing import SIGNATURE_SIZE

LOCALHOST = "127.0.0.1"
_HEADERS = {MAGIC_V1: 6, MAGIC_V2: 10}


class Wire:
    """One end of a cable: a socket of ours, and the last sender to it."""

    def __init__(self, handle: Callable[[int, bytes], None], node: int, port: int = 0) -> None:
        """`handle` gets the node and each datagram. `port` 0: the system chooses. Raises `LinkError`: it is in use."""
        self.sock = bound_socket(f"{LOCALHOST}:{port}", (LOCALHOST, port))
        self.port: int = self.sock.getsockname()[1]
        self.reader = FrameReader()
        self.peer: Address | None = None
        self._handle = handle
        self._node = node

    def read(self) -> bool:
        """Handle what has arrived, up to a bound. True: there may be more."""
        for _ in range(MAX_PER_WAKE):
            try:
                data, self.peer = self.sock.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return False
            except OSError:
                continue  # an earlier datagram of ours reached no socket
            self._handle(self._node, data)
        return True

    def forget(self) -> None:
        """The other end is gone. What it sent last is handled first, because another may soon use its port."""
        while self.read():
            pass
        self.peer = None

    def send(self, data: bytes) -> bool:
        """False: no sender is known yet, or there is no space."""
        if self.peer is None:
            return False
        try:
            self.sock.sendto(data, self.peer)
        except OSError:
            return False
        return True

    @property
    def overrun(self) -> int:
        """Datagrams for which the kernel had no space."""
        return kernel_drops(self.sock)


class Wires:
    """All of them, read as something arrives."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._all: list[Wire] = []

    def new(self, handle: Callable[[int, bytes], None], node: int, port: int = 0) -> Wire:
        """See `Wire`."""
        wire = Wire(handle, node, port)
        self._all.append(wire)
        self._selector.register(wire.sock, selectors.EVENT_READ, wire.read)
        return wire

    def watch(self, file: int, ready: Callable[[], None]) -> None:
        """Let `poll` call `ready` when there is something to read from a file descriptor."""
        self._selector.register(file, selectors.EVENT_READ, ready)

    def poll(self, timeout_s: float) -> None:
        """Handle what has arrived; wait for it for at most `timeout_s` seconds."""
        for key, _ in self._selector.select(max(timeout_s, 0.0)):
            key.data()

    def close(self) -> None:
        """Release the sockets."""
        self._selector.close()
        for wire in self._all:
            wire.sock.close()


def whole_frames(data: bytes, reader: FrameReader) -> Iterator[tuple[bytes, Frame]]:
    """The frames of a datagram, each as bytes and as a `Frame`; `reader` checks and counts them.

    For a program that forwards frames unchanged. It stops at the first bytes that are not a whole frame, because a
    datagram contains only whole frames.
    """
    start = 0
    while start < len(data):
        header = _HEADERS.get(data[start])
        if header is None or start + header > len(data):
            break
        size = header + data[start + 1] + 2
        if header == _HEADERS[MAGIC_V2] and data[start + 2] & FLAG_SIGNED:
            size += SIGNATURE_SIZE
        raw = data[start : start + size]
        for frame in reader.datagram(raw):
            yield raw, frame
        start += size
    else:
        return
    reader.datagram(data[start:])
