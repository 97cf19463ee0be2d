"""Finds the process that uses a UDP port, so that an error message can name it."""

from __future__ import annotations

import os
from pathlib import Path

from .sockets import udp_table

#: How much of a command line is shown, characters.
_MAX_COMMAND = 80


def holder(port: int) -> str | None:
    """The process that uses this port, as `process 1234 (rass-mav run drone.yaml)`; None: this user may not see it."""
    try:
        sockets = {f"socket:[{entry.inode}]" for entry in udp_table() if entry.port == port}
    except OSError:
        return None
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(descriptor) in sockets for descriptor in (process / "fd").iterdir()):
                return f"process {process.name} ({_command(process)})"
        except OSError:
            continue  # it belongs to another user, or has ended
    return None


def _command(process: Path) -> str:
    words = (process / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ").strip()
    return "".join(c if c.isprintable() else "?" for c in words)[:_MAX_COMMAND]
