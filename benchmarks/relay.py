"""An emulated link between two UDP ends: a bit rate, a delay, a bounded queue and frames that are lost.

    python -m benchmarks.relay --left 127.0.0.1:14601 --right 127.0.0.1:14602 --bytes-s 5760 --loss 0.05

Each end sends to one of the two ports. What it sends arrives at the other end, which is known as soon as it has sent
something itself. On the way each direction is a line of its own:

- A MAVLink frame takes its bytes divided by the rate. Those that come meanwhile wait, up to `--queue` bytes; a frame
  that finds no space is dropped.
- It arrives `--delay` seconds after its last byte has left.
- It is lost with the probability `--loss`, each independently, by a seeded generator. A lost frame takes its time too.

Frames of one datagram are sent one by one. The times are those at which the kernel received a datagram, so a busy
machine does not slow the line down: what is late is delivered at once, and the line has gone on meanwhile.

It prints its two addresses, and for each line on its standard input what it has counted, as JSON. At the end of the
input it ends.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

#: What a line holds by default, bytes. A server of MAVLink FTP that does not know the rate sends a file in one burst,
#: and nothing of it should be dropped here.
QUEUE_BYTES = 1 << 19
DELAY_S = 0.02
#: The longest datagram.
MAX_DATAGRAM = 1 << 16
#: Datagrams read from a socket before the other one has its turn.
MAX_PER_WAKE = 64
_BUFFER_BYTES = 1 << 22
# The kernel's time of arrival, with each datagram (socket(7)). Python has no name for it; the number is Linux's.
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_MAGIC_V1, _MAGIC_V2, _SIGNED = 0xFE, 0xFD, 0x01


class LineSettings(NamedTuple):
    """One direction of a link."""

    bytes_s: float
    """Rate, bytes/s."""
    delay_s: float = DELAY_S
    """From the last byte sent to the last byte received, seconds."""
    loss: float = 0.0
    """Probability that a frame is lost, 0..1."""
    queue_bytes: int = QUEUE_BYTES
    """The most bytes that wait, the frame that is being sent included."""


class Line:
    """One direction of an emulated link. Pure: time is an argument, in seconds on any timeline that does not jump."""

    def __init__(self, settings: LineSettings, rng: random.Random) -> None:
        self.settings = settings
        self._rng = rng
        self._free_at = float("-inf")
        self._flying: deque[tuple[float, bytes]] = deque()
        self.frames = self.bytes = 0
        """Frames and bytes sent, those that were lost included."""
        self.lost = 0
        """Frames lost on the way."""
        self.dropped = 0
        """Frames that found no space."""

    def send(self, frame: bytes, now: float) -> None:
        """A frame has come in."""
        line = self.settings
        begin = max(self._free_at, now)
        if (begin - now) * line.bytes_s + len(frame) > line.queue_bytes + 1e-6:
            self.dropped += 1
            return
        self._free_at = begin + len(frame) / line.bytes_s
        self.frames += 1
        self.bytes += len(frame)
        if self._rng.random() < line.loss:
            self.lost += 1
        else:
            self._flying.append((self._free_at + line.delay_s, frame))

    @property
    def next_at(self) -> float | None:
        """When the next frame arrives; None: there is none."""
        return self._flying[0][0] if self._flying else None

    def arrived(self, now: float) -> Iterator[bytes]:
        """The frames that have arrived, in order; each is returned once."""
        while self._flying and self._flying[0][0] <= now:
            yield self._flying.popleft()[1]

    def counters(self) -> dict[str, int]:
        """What it has counted."""
        return {"frames": self.frames, "bytes": self.bytes, "lost": self.lost, "dropped": self.dropped}


def frames(datagram: bytes) -> Iterator[bytes]:
    """The MAVLink frames of a datagram. What is none goes as one piece."""
    while datagram:
        size = len(datagram)
        if datagram[0] == _MAGIC_V2 and size >= 12:
            size = 12 + datagram[1] + (13 if datagram[2] & _SIGNED else 0)
        elif datagram[0] == _MAGIC_V1 and size >= 8:
            size = 8 + datagram[1]
        yield datagram[:size]
        datagram = datagram[size:]


class _Side:
    """A socket at which one end is heard."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.socket.bind(address)
        self.end: tuple[str, int] | None = None
        """The address of the end; None: it has not sent yet."""

    def receive(self) -> Iterator[tuple[bytes, float]]:
        """What has come, and when, seconds on the clock of `time.time`."""
        for _ in range(MAX_PER_WAKE):
            try:
                data, about, _, self.end = self.socket.recvmsg(MAX_DATAGRAM, 64)
            except BlockingIOError:
                return
            except OSError:
                continue  # the end has closed its socket, and says so of an earlier datagram
            at = time.time()
            for level, kind, content in about:
                if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(content) >= _TIMESPEC.size:
                    seconds, nanoseconds = _TIMESPEC.unpack_from(content)
                    at = seconds + nanoseconds * 1e-9
            yield data, at

    def send(self, frame: bytes) -> None:
        """To the end, if it is known."""
        if self.end is not None:
            # It has closed its socket, or its buffer is full: a loss as any other.
            with contextlib.suppress(OSError):
                self.socket.sendto(frame, self.end)


class Relay:
    """The link between two ends, in real time."""

    def __init__(
        self, left: tuple[str, int], right: tuple[str, int], rightward: LineSettings, leftward: LineSettings, seed: int
    ) -> None:
        """`left`, `right`: where each end is heard; port 0: any. Raises `OSError`."""
        self.sides = _Side(left), _Side(right)
        self.lines = (
            Line(rightward, random.Random(f"{seed}:rightward")),
            Line(leftward, random.Random(f"{seed}:leftward")),
        )
        # Deadlines are on the clock that does not jump; the kernel's times are not.
        self._offset = time.time() - time.monotonic()

    def addresses(self) -> dict[str, tuple[str, int]]:
        """Where each end is heard."""
        left, right = (side.socket.getsockname() for side in self.sides)
        return {"left": left, "right": right}

    def counters(self) -> dict[str, dict[str, int]]:
        """What each direction has counted."""
        rightward, leftward = (line.counters() for line in self.lines)
        return {"rightward": rightward, "leftward": leftward}

    def run(self, control: Any) -> None:
        """Pass frames on until the end of the input `control`, a file. Each line is answered with the counters."""
        left, right = self.sides
        rightward, leftward = self.lines
        ways = ((left, rightward, right), (right, leftward, left))
        while True:
            due = min((at for line in self.lines if (at := line.next_at) is not None), default=None)
            wait = None if due is None else max(0.0, due - time.monotonic())
            ready, _, _ = select.select([left.socket, right.socket, control], [], [], wait)
            now = time.monotonic()
            for side, line, other in ways:
                if side.socket in ready:
                    for datagram, at in side.receive():
                        # Not later than now, whatever has happened to the date.
                        came = min(at - self._offset, now) if now - 1.0 < at - self._offset else now
                        for frame in frames(datagram):
                            line.send(frame, came)
                for frame in line.arrived(time.monotonic()):
                    other.send(frame)
            if control in ready:
                if not control.readline():
                    return
                print(json.dumps(self.counters()), flush=True)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    return host, int(port)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a relay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--left", type=_address, default=("127.0.0.1", 0), metavar="HOST:PORT")
    parser.add_argument("--right", type=_address, default=("127.0.0.1", 0), metavar="HOST:PORT")
    parser.add_argument("--bytes-s", type=float, nargs="+", default=[5760.0], help="rate; two: rightward and leftward")
    parser.add_argument("--delay", type=float, default=DELAY_S, help="seconds each way (%(default)s)")
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0], help="0 to 1; two: rightward and leftward")
    parser.add_argument("--queue", type=int, default=QUEUE_BYTES, help="bytes that may wait (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    rightward, leftward = (
        LineSettings(options.bytes_s[index], options.delay, options.loss[index], options.queue) for index in (0, -1)
    )
    relay = Relay(options.left, options.right, rightward, leftward, options.seed)
    print(json.dumps(relay.addresses()), flush=True)
    # Without a buffer, so that nothing waits in one that `select` does not see.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as control:
        relay.run(control)


if __name__ == "__main__":
    main()
