"""Serial devices made of pseudo-terminals: plugged in and pulled out under a name that stays."""

from __future__ import annotations

import os
import select
from pathlib import Path

TIMEOUT_S = 5.0


class Device:
    """A serial device. The test holds its far end."""

    def __init__(self, directory: Path, name: str = "ttyUSB0") -> None:
        self.path = directory / name
        self._far: int | None = None

    def plug_in(self) -> Device:
        import pty

        self._far, near = pty.openpty()
        os.set_blocking(self._far, False)
        self.path.symlink_to(os.ttyname(near))
        os.close(near)
        return self

    def pull_out(self) -> None:
        self.path.unlink(missing_ok=True)
        if self._far is not None:
            os.close(self._far)
            self._far = None

    @property
    def far(self) -> int:
        assert self._far is not None
        return self._far

    def say(self, data: bytes) -> None:
        assert os.write(self.far, data) == len(data)

    def hear(self, size: int) -> bytes:
        """At least so many bytes; fails when they do not come. Blocking: for tests without an event loop in this thread
        that has to run meanwhile."""
        heard = b""
        while len(heard) < size:
            ready, _, _ = select.select([self.far], [], [], TIMEOUT_S)
            assert ready, f"only {heard!r} came"
            heard += os.read(self.far, 4096)
        return heard
