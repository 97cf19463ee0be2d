"""Non-blocking UDP sockets on an event loop, for the links; those of this computer, and which process has a port."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from rass_mav.errors import LinkError, why

from .base import MAX_OUTBOX, Address, Datagram, Inbox

log = logging.getLogger(__name__)

#: Datagrams read per wake, so that other links and the step get their turn.
MAX_PER_WAKE = 64
#: Longer datagrams are cut. A MAVLink frame has at most 280 bytes. Autopilots and routers put several into a datagram,
#: as many as fit one Ethernet packet.
MAX_DATAGRAM = 1472
#: Socket buffers, bytes: about a thousand frames. The system may grant less.
_BUFFER_BYTES = 1 << 19
#: How much of a command line is shown, characters.
_MAX_COMMAND = 80


def bound_socket(name: str, address: Address) -> socket.socket:
    """A non-blocking UDP socket bound to an address (port 0: any). Raises `LinkError`, for example if it is in use."""
    sock = udp_socket()
    try:
        sock.bind(address)
    except OSError as error:
        sock.close()
        if error.errno == errno.EADDRINUSE:
            raise in_use(name, address[1]) from None
        raise LinkError(f"{name}: {why(error)}") from None
    return sock


def in_use(name: str, port: int) -> LinkError:
    """The error for a UDP port in use. It names the process, if this user may see it."""
    who = holder(port)
    if who is not None and who.pid == os.getpid():
        asks = "this process already uses it: give each link, autopilot.url and ground.url its own port;"
    else:
        asks = "is another node running? rass-mav status CONFIG; or another program?"
    return LinkError(
        f"{name}: address already in use" + (f" by {who}" if who is not None else ""),
        f"{asks} ss -lunp 'sport = :{port}'",
    )


def udp_socket() -> socket.socket:
    """An unbound non-blocking UDP socket that may broadcast."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    return sock


class Reader:
    """Reads a socket into an inbox, until the inbox is full. Then the kernel has to keep what arrives."""

    def __init__(
        self,
        sock: socket.socket,
        inbox: Inbox,
        *,
        is_echo: Callable[[Address], bool],
    ) -> None:
        """`is_echo`: returns whether a datagram from this address is our own."""
        self._sock = sock
        self._inbox = inbox
        self._is_echo = is_echo
        self._loop = asyncio.get_running_loop()
        self._reading = False
        self.echoes = 0
        self.resume()

    def resume(self) -> None:
        """Continue reading. Call it when there is space in the inbox."""
        if not self._reading:
            self._reading = True
            self._loop.add_reader(self._sock, self._readable)

    def stop(self) -> None:
        """Stop reading."""
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self._sock)

    def _readable(self) -> None:
        inbox = self._inbox
        receive = self._sock.recvfrom
        for _ in range(MAX_PER_WAKE):
            if inbox.full:
                self.stop()
                break
            try:
                data, source = receive(MAX_DATAGRAM)
            except BlockingIOError:
                break
            except OSError as error:
                # For example, the receiver refused an earlier datagram. The next one may be good.
                log.debug("receiving: %s", error)
                continue
            if self._is_echo(source):
                self.echoes += 1
            else:
                inbox.put(Datagram(data, source))
        if inbox:
            inbox.wake()


# After this long without an error, sending counts as working again, seconds.
_CALM_S = 10.0


class Sender:
    """Sends at once. Frames that the socket does not accept wait, up to a bound."""

    def __init__(self, sock: socket.socket, name: str) -> None:
        self._sock = sock
        self._name = name
        self._outbox: deque[tuple[bytes, Address | None]] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.sent = 0
        self.dropped = 0
        self._trouble = ""
        self._failed_at = 0.0

    def send(self, frame: bytes, address: Address | None) -> None:
        """Send a frame. `address`: None for a connected socket."""
        if self._outbox:
            self._wait(frame, address)
        elif not self._try(frame, address):
            self._wait(frame, address)
            self._loop = asyncio.get_running_loop()
            self._loop.add_writer(self._sock, self._writable)

    def _wait(self, frame: bytes, address: Address | None) -> None:
        if len(self._outbox) >= MAX_OUTBOX:
            # The oldest has waited longest and is the least useful.
            self._outbox.popleft()
            self.dropped += 1
        self._outbox.append((frame, address))

    def _try(self, frame: bytes, address: Address | None) -> bool:
        """False: the socket would block."""
        try:
            if address is None:
                self._sock.send(frame)
            else:
                self._sock.sendto(frame, address)
        except BlockingIOError:
            return False
        except OSError as error:
            self.dropped += 1
            self._failed_at = asyncio.get_running_loop().time()
            text = error.strerror or str(error)
            if text != self._trouble:
                # Log it once until it changes: a network that is down stays down for many frames.
                self._trouble = text
                log.warning("%s: cannot send: %s", self._name, text.lower())
            return True
        self.sent += 1
        # Without a listener, a connected socket fails for the previous datagram: every other one seems to be sent.
        if self._trouble and asyncio.get_running_loop().time() - self._failed_at > _CALM_S:
            self._trouble = ""
            log.info("%s: sending again", self._name)
        return True

    def _writable(self) -> None:
        while self._outbox and self._try(*self._outbox[0]):
            self._outbox.popleft()
        if not self._outbox:
            self.stop()

    def stop(self) -> None:
        """Drop the waiting frames."""
        self._outbox.clear()
        if self._loop is not None:
            self._loop.remove_writer(self._sock)
            self._loop = None


def kernel_drops(sock: socket.socket) -> int:
    """Datagrams that found the socket's receive buffer full; 0 where the system does not report it (Linux does)."""
    try:
        inode = str(os.fstat(sock.fileno()).st_ino)
        return next((entry.drops for entry in udp_table() if entry.inode == inode), 0)
    except OSError:
        return 0


def is_local(host: str) -> bool:
    """Whether an IPv4 address now belongs to this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            return False
    return True


class UdpEntry(NamedTuple):
    """A UDP socket of this computer."""

    port: int
    inode: str
    drops: int
    """Datagrams that found its receive buffer full."""


def udp_table() -> Iterator[UdpEntry]:
    """All UDP sockets (proc_pid_net(5)). Raises `OSError` where the system does not list them."""
    with Path("/proc/net/udp").open(encoding="ascii") as table:
        for line in table:
            fields = line.split()
            if len(fields) >= 13 and fields[0] != "sl":
                yield UdpEntry(int(fields[1].rpartition(":")[2], 16), fields[9], int(fields[12]))


class Holder(NamedTuple):
    """A process that uses a port. As text: `process 1234 (rass-mav run drone.yaml)`."""

    pid: int
    command: str
    """Its command line, or the beginning of it."""

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command})"


def holder(port: int) -> Holder | None:
    """The process that uses this port; None: this user may not see it."""
    try:
        sockets = {f"socket:[{entry.inode}]" for entry in udp_table() if entry.port == port}
    except OSError:
        return None
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(descriptor) in sockets for descriptor in (process / "fd").iterdir()):
                return Holder(int(process.name), _command(process))
        except OSError:
            continue  # it belongs to another user, or has ended
    return None


def _command(process: Path) -> str:
    words = (process / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ").strip()
    return "".join(c if c.isprintable() else "?" for c in words)[:_MAX_COMMAND]
