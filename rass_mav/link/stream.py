"""Ports that carry a stream of bytes (serial, TCP). They are opened again indefinitely when they are lost.

A stream has no datagrams: a piece that is read may end in the middle of a frame, and the reader joins the pieces. A
frame is sent whole or not at all, so a jammed port never sends half a frame and then another one.
"""

from __future__ import annotations

import asyncio
import logging
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from rass_mav.errors import LinkError

from .base import Address, Datagram, Inbox, LinkCounters, Port

log = logging.getLogger(__name__)

#: Bytes read at once, and pieces read per wake, so that other links and the step get their turn.
READ_BYTES = 4096
MAX_PER_WAKE = 16
#: Bytes that may wait because the port does not accept them. At 57,600 bit/s they take 0.7 s to leave.
MAX_PENDING_BYTES = 4096
#: A lost port is tried again after the first pause, then after twice as long, up to the longest pause. Seconds.
FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0
#: A longer attempt is abandoned, seconds. With the longest pause, the port is open within 5 s of its return.
OPENING_S = 2.5


class Channel(NamedTuple):
    """An open port. An `OSError` of its descriptor other than `BlockingIOError` means that the port is lost."""

    fd: int
    """Non-blocking. Reading nothing means that the other end is gone."""
    close: Callable[[], None]
    """Closes the port. Never raises."""


class Opener(ABC):
    """Opens one port."""

    name: str
    """Its name in status and log."""
    source: Address
    """The address reported as the source of all its input."""

    @abstractmethod
    async def open(self) -> Channel:
        """Open the port. Raises `OSError` or `LinkError` if that is not possible now."""


class StreamPort(Port):
    """A port that is kept open."""

    stream = True

    def __init__(self, opener: Opener) -> None:
        self._opener = opener
        self.name = opener.name
        self._inbox = Inbox()
        self._sent = 0
        """Frames that the port accepted whole."""
        self._dropped = 0
        """Frames lost because the port was closed or jammed."""
        self._opened = 0
        self._channel: Channel | None = None
        self._task: asyncio.Task[None] | None = None
        self._lost = asyncio.Event()
        self._reading = False
        self._out: deque[bytes] = deque()
        self._out_bytes = 0
        self._trouble = ""

    @property
    def is_open(self) -> bool:
        """Whether it is open now."""
        return self._channel is not None

    @property
    def generation(self) -> int:
        """How often the port was opened."""
        return self._opened

    @property
    def trouble(self) -> str:
        """Why the port is not open; empty while it is."""
        return "" if self._channel is not None else self._trouble

    def counters(self) -> LinkCounters:
        """The counters so far. `received` counts pieces of the stream."""
        return LinkCounters(self._sent, self._inbox.taken, 0, self._dropped, 0)

    def start(self, wake: Callable[[], None]) -> None:
        """Start opening the port, on the running event loop. `wake` is called when something has arrived, when the port
        has been opened, and when it is lost or cannot be opened."""
        self._inbox.wake = wake
        self._task = asyncio.create_task(self._keep_open(), name=f"keep {self.name} open")
        self._task.add_done_callback(_fail_loudly)

    def take(self) -> list[Datagram]:
        """The pieces of one turn, which end anywhere."""
        arrived = self._inbox.take()
        self._watch()
        return arrived

    def write(self, frame: bytes) -> None:
        """Send a frame. Drop and count it if the port is closed, or if too much is waiting."""
        if self._channel is None or self._out_bytes + len(frame) > MAX_PENDING_BYTES:
            self._dropped += 1
            return
        waiting = bool(self._out)
        self._out.append(frame)
        self._out_bytes += len(frame)
        if not waiting:
            self._write()
            if self._out and self._channel is not None:
                asyncio.get_running_loop().add_writer(self._channel.fd, self._write)

    def reopen(self) -> None:
        """Close the port, if it is open, and open it again: a device that hangs may recover."""
        if self._channel is not None:
            self._drop_channel()
            self._lost.set()

    def close(self) -> None:
        """Close the port and stop opening it."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._drop_channel()

    async def _keep_open(self) -> None:
        pause = FIRST_PAUSE_S
        while True:
            try:
                channel = await asyncio.wait_for(self._opener.open(), OPENING_S)
            except (OSError, LinkError, asyncio.TimeoutError) as error:
                self._tell(error)
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE_S)
                continue
            self._lost.clear()
            self._channel = channel
            self._opened += 1
            log.log(logging.WARNING if self._trouble else logging.INFO, "%s: open", self.name)
            self._trouble = ""
            self._watch()
            self._inbox.wake()
            began = asyncio.get_running_loop().time()
            await self._lost.wait()
            # A port that is lost as soon as it is opened must not be opened a thousand times a second.
            if asyncio.get_running_loop().time() - began > LONGEST_PAUSE_S:
                pause = FIRST_PAUSE_S
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _tell(self, error: BaseException) -> None:
        text = getattr(error, "strerror", None) or str(error) or "no answer"
        # Log it once until it changes.
        if text != self._trouble:
            self._trouble = text
            log.warning("%s: %s; trying again", self.name, text.lower())
            self._inbox.wake()

    def _watch(self) -> None:
        if self._channel is not None and not self._reading:
            self._reading = True
            asyncio.get_running_loop().add_reader(self._channel.fd, self._read)

    def _read(self) -> None:
        channel = self._channel
        assert channel is not None
        for _ in range(MAX_PER_WAKE):
            if self._inbox.full:
                # Until `receive`; then the kernel has to keep it.
                self._reading = False
                asyncio.get_running_loop().remove_reader(channel.fd)
                break
            try:
                data = os.read(channel.fd, READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                self._lose(error)
                break
            if not data:
                self._lose(OSError("the other end is gone"))
                break
            self._inbox.put(Datagram(data, self._opener.source))
        if self._inbox:
            self._inbox.wake()

    def _write(self) -> None:
        channel = self._channel
        assert channel is not None
        while self._out:
            frame = self._out[0]
            try:
                taken = os.write(channel.fd, frame)
            except BlockingIOError:
                return
            except OSError as error:
                self._lose(error)
                return
            self._out_bytes -= taken
            if taken < len(frame):
                self._out[0] = frame[taken:]
                return
            self._out.popleft()
            self._sent += 1
        asyncio.get_running_loop().remove_writer(channel.fd)

    def _lose(self, error: OSError) -> None:
        self._tell(error)
        self._drop_channel()
        self._lost.set()

    def _drop_channel(self) -> None:
        channel, self._channel = self._channel, None
        self._reading = False
        self._dropped += len(self._out)
        self._out.clear()
        self._out_bytes = 0
        if channel is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(channel.fd)
            loop.remove_writer(channel.fd)
            channel.close()


def _fail_loudly(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        task.get_loop().call_exception_handler(
            {"message": f"{task.get_name()} has failed", "exception": task.exception(), "task": task}
        )
