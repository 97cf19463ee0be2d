"""The connection to the autopilot over UDP: `udpin:` listens and answers the last sender, `udpout:` sends first."""

from __future__ import annotations

from collections.abc import Callable

from rass_mav.errors import LinkError, why

from .address import VehicleUrl, resolve
from .base import Address, Inbox, LinkCounters
from .sockets import Reader, Sender, bound_socket, kernel_drops, udp_socket
from .vehicle import VehiclePort


class VehicleLink(VehiclePort):
    """Datagrams from and to the autopilot. The constructor opens the socket."""

    def __init__(self, url: VehicleUrl) -> None:
        """Raises `LinkError`, for example `udpin:0.0.0.0:14550: address already in use`."""
        self.name = str(url)
        self._inbox = Inbox()
        self._reader: Reader | None = None
        self._listens = url.mode == "udpin"
        self._heard: Address | None = None
        self._speakers = 0
        self._unheard = 0
        address = resolve(url.address, self.name)
        if self._listens:
            self._socket = bound_socket(self.name, address)
        else:
            self._socket = udp_socket()
            try:
                # Connected, so that the kernel accepts datagrams only from this address.
                self._socket.connect(address)
            except OSError as error:
                self._socket.close()
                raise LinkError(f"{self.name}: {why(error)}") from None
        self.address: Address = self._socket.getsockname()
        """Own address."""
        self._sender = Sender(self._socket, self.name)

    def start(self, wake: Callable[[], None]) -> None:
        """Start reading, on the running event loop. `wake` is called when something has arrived."""
        self._inbox.wake = wake
        self._reader = Reader(self._socket, self._inbox, is_echo=lambda source: False)

    @property
    def generation(self) -> int:
        """Grows with each new sender, because a new sender has not heard our heartbeat yet."""
        return 1 + self._speakers if self._listens else 1

    def receive(self) -> list[bytes]:
        """The datagrams of one turn."""
        was_full = self._inbox.full
        arrived = self._inbox.take()
        if arrived and arrived[-1].source != self._heard:
            self._heard = arrived[-1].source
            self._speakers += 1
        if was_full and self._reader is not None:
            self._reader.resume()
        return [datagram.data for datagram in arrived]

    def _send(self, frame: bytes) -> None:
        """Send to the autopilot. With `udpin`, drop the frame if nothing has been heard yet."""
        if not self._listens:
            self._sender.send(frame, None)
        elif self._heard is not None:
            self._sender.send(frame, self._heard)
        else:
            self._unheard += 1

    def counters(self) -> LinkCounters:
        """The counters so far. Frames without a receiver count as dropped."""
        return LinkCounters(
            self._sender.sent, self._inbox.taken, kernel_drops(self._socket), self._sender.dropped + self._unheard, 0
        )

    def close(self) -> None:
        """Release the socket."""
        if self._reader is not None:
            self._reader.stop()
        self._sender.stop()
        self._socket.close()
