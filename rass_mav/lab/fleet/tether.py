"""`python -m rass_mav.lab.fleet.tether ...` is `python -m rass_mav ...`, but ends when its stdin does.

A swarm of processes holds the other end of each node's stdin. However the parent ends, even by SIGKILL, the system
closes it, and no node outlives the swarm.
"""

from __future__ import annotations

import os
import runpy
import sys
import threading

#: Exit code of a node whose parent is gone.
ORPHANED = 3


def watch(file: int) -> None:
    """End this process at once, as a crash would, when a file descriptor is closed at its other end."""
    while os.read(file, 4096):
        pass
    os._exit(ORPHANED)


if __name__ == "__main__":
    threading.Thread(target=watch, args=(sys.stdin.fileno(),), name="tether", daemon=True).start()
    runpy.run_module("rass_mav", run_name="__main__", alter_sys=True)
