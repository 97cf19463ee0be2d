"""Serial ports. pyserial sets the line's speed and mode; reading and writing use the descriptor."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import termios
from functools import partial
from typing import TYPE_CHECKING

from rass_mav.errors import LinkError, installing

from .base import Address
from .stream import Channel, Opener

if TYPE_CHECKING:
    from serial import Serial


#: Index of the control characters in the result of `termios.tcgetattr`.
_CC = 6


class SerialOpener(Opener):
    """Opens a device by its name each time, so a USB port that comes back under the same name is used again."""

    def __init__(self, device: str, baud: int, *, flow_control: bool = False) -> None:
        """`baud`: bit/s, 8N1. `flow_control`: RTS/CTS, for five wires."""
        self._device = device
        self._baud = baud
        self._flow_control = flow_control
        self.name = f"serial:{device}:{baud}"
        self.source: Address = (device, 0)

    async def open(self) -> Channel:
        """Open it on a thread, because a faulty USB device may take seconds to answer."""
        opening = asyncio.get_running_loop().run_in_executor(None, self._open)
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            # Nothing waits any more. If the thread still opens the port, close it.
            opening.add_done_callback(_close_unwanted)
            raise

    def _open(self) -> Channel:
        try:
            import serial
        except ImportError:
            raise LinkError(f"serial ports need pyserial: {installing('drone')}") from None
        try:
            # Locked: otherwise two programs that read the same port would each get half of the bytes.
            port = serial.Serial(
                self._device, self._baud, timeout=0, write_timeout=0, rtscts=self._flow_control, exclusive=True
            )
        except serial.SerialException as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EBUSY):
                raise LinkError("in use by another program") from None
            raise LinkError((os.strerror(error.errno) if error.errno else str(error)).lower()) from None
        except ValueError as error:
            raise LinkError(str(error).lower()) from None
        try:
            return _ready(port)
        except termios.error as error:
            port.close()
            raise LinkError(f"not a serial port: {error}") from None


def _ready(port: Serial) -> Channel:
    """The port for reading and writing by its descriptor."""
    fd: int = port.fileno()
    os.set_blocking(fd, False)
    # pyserial sets up reads that return empty at once. Then "nothing yet" looks like "the device is gone".
    mode = termios.tcgetattr(fd)
    mode[_CC][termios.VMIN] = 1
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    return Channel(fd, partial(_close, port))


def _close(port: Serial) -> None:
    """Discard unsent bytes and close: a jammed port would block us for half a minute."""
    # A device that was unplugged cannot be flushed. Its errors do not matter.
    with contextlib.suppress(OSError, termios.error):
        port.reset_output_buffer()
    with contextlib.suppress(OSError):
        port.close()


def _close_unwanted(opening: asyncio.Future[Channel]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
