"""How a process ends with the one that started it, however that ends, even by SIGKILL.

    python -m rass_mav.lab.fleet.tether ...

is `python -m rass_mav ...`, but ends when its stdin does: a fleet holds the other end of each node's stdin, and the
system closes it.

    python -m rass_mav.lab.fleet.tether --become PARENT DIRECTORY NAME=VALUE... -- COMMAND...

changes into the directory, sets the variables, and becomes the command, which dies when its parent does: flight control
firmware knows nothing about us, and would run indefinitely if we were killed. Linux then kills it. Its output goes to
stderr. stdout stays open and unused, so its end shows that the firmware has ended.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

from rass_mav.errors import why

#: Exit code of a node whose parent is gone.
ORPHANED = 3
_BECOME = "--become"
# prctl(2): the signal that the calling process gets when its parent dies; it survives exec.
_SET_PARENT_DEATH_SIGNAL = 1


def watch(file: int) -> None:
    """End this process at once, as a crash would, when a file descriptor is closed at its other end."""
    while os.read(file, 4096):
        pass
    os._exit(ORPHANED)


def end_with_stdin() -> None:
    """Let this process end when its stdin does."""
    threading.Thread(target=watch, args=(sys.stdin.fileno(),), name="tether", daemon=True).start()


def become_arguments(directory: str, variables: dict[str, str], command: Sequence[str]) -> list[str]:
    """Arguments of the Python interpreter that start a command as a child of this process, to end with it."""
    settings = [f"{name}={value}" for name, value in variables.items()]
    return ["-m", "rass_mav.lab.fleet.tether", _BECOME, str(os.getpid()), directory, *settings, "--", *command]


def _become(parent: str, directory: str, *rest: str) -> NoReturn:
    """Replace this process by a command. If that cannot be started, it exits with code 127 and a line on stderr."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != int(parent):
        sys.exit(1)  # the parent died before the request
    os.set_inheritable(os.dup(1), True)
    os.dup2(2, 1)
    end = rest.index("--")
    variables = dict(setting.split("=", 1) for setting in rest[:end])
    command = rest[end + 1 :]
    try:
        os.chdir(directory)
        os.execvpe(command[0], command, {**os.environ, **variables})
    except OSError as error:
        sys.stderr.write(f"{command[0]}: {why(error)}\n")
        sys.exit(127)


if __name__ == "__main__":
    if sys.argv[1:2] == [_BECOME]:
        _become(*sys.argv[2:])
    end_with_stdin()
    runpy.run_module("rass_mav", run_name="__main__", alter_sys=True)
