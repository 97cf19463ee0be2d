"""The connection to the autopilot over a stream. The port is opened by `start`, and again whenever it is lost."""

from __future__ import annotations

import asyncio
import socket

from rass_mav.errors import LinkError

from .address import VehicleUrl
from .base import Address
from .serialport import SerialOpener
from .stream import Channel, Opener, StreamPort
from .vehicle import VehiclePort

#: The connection ends if sent bytes are not confirmed for this long, milliseconds. A heartbeat leaves each second.
_UNCONFIRMED_MS = 4000
_TCP_USER_TIMEOUT = getattr(socket, "TCP_USER_TIMEOUT", None)


class TcpOpener(Opener):
    """Connects to a server."""

    def __init__(self, address: Address) -> None:
        """`address`: IPv4 address or name, and port."""
        self._address = address
        self.name = f"tcp:{address[0]}:{address[1]}"
        self.source: Address = address

    async def open(self) -> Channel:
        """Connect. The name is looked up each time, because the address may have changed."""
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(*self._address, family=socket.AF_INET, type=socket.SOCK_STREAM)
        except UnicodeError as error:
            raise LinkError(str(error)) from None
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            # Frames are small and must not wait for each other.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if _TCP_USER_TIMEOUT is not None:
                sock.setsockopt(socket.IPPROTO_TCP, _TCP_USER_TIMEOUT, _UNCONFIRMED_MS)
            await loop.sock_connect(sock, found[0][4])
            if sock.getsockname() == sock.getpeername():
                # On this host, without a listener, the system may have given us the very port that we connect to.
                raise LinkError("no server is listening")
        except BaseException:
            sock.close()
            raise
        return Channel(sock.fileno(), sock.close)


class VehicleStream(StreamPort, VehiclePort):
    """Bytes from and to the autopilot, through a serial port or TCP."""

    def __init__(self, url: VehicleUrl) -> None:
        super().__init__(SerialOpener(*url.address) if url.mode == "serial" else TcpOpener(url.address))

    def receive(self) -> list[bytes]:
        """The bytes of one turn, in pieces that end anywhere."""
        return [data for data, _ in self.take()]

    def _send(self, frame: bytes) -> None:
        self.write(frame)
