"""Pseudo-terminals that stand in for serial devices: plugged in, unplugged, plugged in again under the same name."""

from __future__ import annotations

import os
import pty
import select
from pathlib import Path

from tests.patience import PATIENCE_S


class SerialDevice:
    """A device, whose end of the cable the test holds. Its port is a link, as names in /dev/serial/by-id are.

    The line discipline is left as it is: whoever opens the port has to see to it that all bytes come through.
    """

    def __init__(self, path: Path) -> None:
        """`path`: of the port, which is there once it was plugged in."""
        self.path = path
        self._ends: tuple[int, int] | None = None

    @property
    def far(self) -> int:
        """The device's end, non-blocking."""
        assert self._ends is not None
        return self._ends[0]

    def plug(self) -> SerialDevice:
        """Plug it in; the port appears."""
        # The near end stays open: else the far one would fail whenever nobody else has the port open.
        self._ends = far, near = pty.openpty()
        os.set_blocking(far, False)
        self.path.symlink_to(os.ttyname(near))
        return self

    def unplug(self) -> None:
        """Pull the cable, if it is in: the port hangs up and its name disappears."""
        if self._ends is not None:
            self.path.unlink()
            for end in self._ends:
                os.close(end)
            self._ends = None

    def say(self, data: bytes) -> None:
        """Blocking, until all is on its way."""
        while data:
            _, ready, _ = select.select([], [self.far], [], PATIENCE_S)
            assert ready, f"{data!r} is not taken"
            data = data[os.write(self.far, data) :]

    def hear(self, end: bytes) -> bytes:
        """Wait until what was asked of the device ends so, and take it."""
        heard = b""
        while not heard.endswith(end):
            ready, _, _ = select.select([self.far], [], [], PATIENCE_S)
            assert ready, f"expected {end!r}, heard {heard!r}"
            heard += os.read(self.far, 4096)
        return heard
