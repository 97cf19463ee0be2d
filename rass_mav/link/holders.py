"""The UDP sockets of this computer, and which process uses a port, so that an error message can name it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

#: How much of a command line is shown, characters.
_MAX_COMMAND = 80


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
