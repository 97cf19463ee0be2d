"""`python -m rass_mav.lab.sitl.guard PARENT DIRECTORY NAME=VALUE... -- COMMAND...` becomes the command.

It changes into the directory, sets the variables, and dies when its parent does: flight control firmware knows nothing
about us, and would run indefinitely if we were killed. Linux then kills it. Its output goes to stderr. stdout stays
open and unused, so its end shows that the firmware has ended.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

from rass_mav.errors import why

# prctl(2): the signal that the calling process gets when its parent dies; it survives exec.
_SET_PARENT_DEATH_SIGNAL = 1


def arguments(directory: str, variables: dict[str, str], command: Sequence[str]) -> list[str]:
    """Arguments of the Python interpreter that start a command in this way, as a child of this process."""
    settings = [f"{name}={value}" for name, value in variables.items()]
    return ["-m", __name__, str(os.getpid()), directory, *settings, "--", *command]


def become(parent: int, directory: str, variables: dict[str, str], command: list[str]) -> NoReturn:
    """Replace this process by a command. `parent`: process id of the process that started us.

    If the command cannot be started, it exits with code 127 and a line on stderr.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)  # the parent died before the request
    os.set_inheritable(os.dup(1), True)
    os.dup2(2, 1)
    try:
        os.chdir(directory)
        os.execvpe(command[0], command, {**os.environ, **variables})
    except OSError as error:
        sys.stderr.write(f"{command[0]}: {why(error)}\n")
        sys.exit(127)


def _main(words: list[str]) -> NoReturn:
    parent, directory, *rest = words
    end = rest.index("--")
    pairs = (setting.partition("=") for setting in rest[:end])
    become(int(parent), directory, {name: value for name, _, value in pairs}, rest[end + 1 :])


if __name__ == "__main__":
    _main(sys.argv[1:])
