"""Pseudo-terminals that stand in for serial devices: plugged in, unplugged, plugged in again under the same name."""

from __future__ import annotations

import os
import pty
import select
import tty
from pathlib import Path

TIMEOUT_S = 10.0


class SerialDevice:
    """The device's end of a cable. Its port is a link to a pseudo-terminal, as names in /dev/serial/by-id are."""

    def __init__(self, port: Path) -> None:
        self.port = port
        self._end: int | None = None
        self._node = -1
        self.plug()

    def plug(self) -> None:
        """Plug it in; the port appears. What is said before somebody has opened it is lost on them."""
        self._end, self._node = pty.openpty()
        tty.setraw(self._node)
        self.port.symlink_to(os.ttyname(self._node))

    def unplug(self) -> None:
        """Pull the cable: the port hangs up and its name disappears."""
        assert self._end is not None
        self.port.unlink()
        os.close(self._end)
        os.close(self._node)
        self._end = None

    def say(self, data: bytes) -> None:
        assert self._end is not None
        os.write(self._end, data)

    def hear(self, end: bytes) -> bytes:
        """Wait until what was asked of the device ends so, and take it."""
        assert self._end is not None
        heard = b""
        while not heard.endswith(end):
            ready, _, _ = select.select([self._end], [], [], TIMEOUT_S)
            assert ready, f"expected {end!r}, heard {heard!r}"
            heard += os.read(self._end, 4096)
        return heard

    def close(self) -> None:
        if self._end is not None:
            self.unplug()
