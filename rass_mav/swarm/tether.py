"""`python -m rass_mav.swarm.tether ...` is `rass-mav ...`, but it ends when its stdin does.

A swarm of processes holds the other end of each node's stdin. However the parent ends, with SIGKILL too, the system
closes it, and no node outlives the swarm.
"""

from __future__ import annotations

import os
import sys
import threading

from rass_mav.cli import main

#: Exit code of a node whose parent is gone.
ORPHANED = 3


def watch(file: int) -> None:
    """End this process at once, as a crash would, when there is nothing more to come from a file descriptor."""
    while os.read(file, 4096):
        pass
    os._exit(ORPHANED)


if __name__ == "__main__":
    threading.Thread(target=watch, args=(sys.stdin.fileno(),), name="tether", daemon=True).start()
    sys.exit(main(sys.argv[1:]))
