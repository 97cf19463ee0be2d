"""`rass-mav` as processes of their own, forked from one that has imported it: to start an interpreter takes longer than
most nodes of a test have to do.

Imports no more than a node: what this module loads, each forked process has.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path

#: What is imported before anything is forked.
PRELOADED = ("rass_mav.cli", "rass_mav.app.run", "rass_mav.commands.node", "tests.forked")


class Forked:
    """A running `rass-mav ARGUMENTS`, with what tests need of a `subprocess.Popen`."""

    def __init__(
        self, arguments: Sequence[str], *, cwd: Path, env: Mapping[str, str], stderr: Path | None = None
    ) -> None:
        context = _context()
        reader, writer = context.Pipe(duplex=False)
        with reader, writer:
            self._process = context.Process(
                target=_run,
                args=(arguments, cwd.absolute(), dict(env), writer, None if stderr is None else stderr.absolute()),
                daemon=True,
            )
            self._process.start()
            self.stdout = os.fdopen(os.dup(reader.fileno()), "rb", buffering=0)
        assert self._process.pid is not None
        self.pid = self._process.pid

    def send_signal(self, number: int) -> None:
        """To one that has ended: nothing."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def poll(self) -> int | None:
        """The exit code of one that has ended."""
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        """The exit code, or minus the signal that ended it."""
        self._process.join(timeout)
        code = self._process.exitcode
        assert code is not None, "it still runs"
        return code


def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
    return context


def _run(arguments: Sequence[str], cwd: Path, env: Mapping[str, str], stdout: Connection, stderr: Path | None) -> None:
    """In the forked process."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    os.dup2(stdout.fileno(), 1)
    stdout.close()
    if stderr is not None:
        log = os.open(stderr, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 2)
        os.close(log)
    measurement = None
    if "COVERAGE_PROCESS_CONFIG" in env or "COVERAGE_PROCESS_START" in env:
        import coverage

        measurement = coverage.process_startup(force=True)
    from rass_mav.cli import main

    try:
        sys.exit(main(arguments))
    finally:
        if measurement is not None:
            measurement.stop()
            measurement.save()
