"""Finds the process that uses a UDP port, so that an error message can name it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from .sockets import udp_table

#: How much of a command line is shown, characters.
_MAX_COMMAND = 80


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
