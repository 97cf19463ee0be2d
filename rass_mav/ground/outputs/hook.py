"""A command of the user's that is run for a datum. It gets a time limit, and its output goes to the log."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import threading

from rass_mav.app.jsonlines import dump_line
from rass_mav.app.outlets import OnArrivalSection
from rass_mav.errors import why
from rass_mav.ground.entry import Entry

log = logging.getLogger(__name__)

#: Of the output of one run: lines that are logged, and bytes of a line.
MOST_LINES = 100
MOST_LINE_BYTES = 1000


class Hook:
    """Runs the command, one run at a time."""

    def __init__(self, section: OnArrivalSection) -> None:
        self._command = section.command
        self._timeout_s = section.timeout_s
        self._lines = 0
        # One pipe for all runs: what a command leaves running in the background keeps its end, and holds up nobody.
        self._reading, self._output = os.pipe()
        threading.Thread(target=self._log_output, name="output", daemon=True).start()

    def run(self, entry: Entry) -> str:
        """Run the command for a datum. Returns why it failed; empty: it did not."""
        self._lines = 0
        # In memory, so that it can be neither full nor blocked, whether the command reads it or not.
        told = os.memfd_create("datum", os.MFD_CLOEXEC)
        try:
            os.write(told, dump_line(entry.plain()))
            os.lseek(told, 0, os.SEEK_SET)
            process = subprocess.Popen(
                self._command, stdin=told, stdout=self._output, stderr=self._output, start_new_session=True,
                env={
                    **os.environ, "RASS_ID": entry.name, "RASS_DRONE": str(entry.id.origin),
                    "RASS_KIND": entry.kind_name,
                },
            )  # fmt: skip
        except OSError as error:
            return f"{self._command[0]}: {why(error)}"
        finally:
            os.close(told)
        try:
            code = process.wait(self._timeout_s)
        except subprocess.TimeoutExpired:
            # With all that it has started and not put into a session of its own.
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return f"killed after {self._timeout_s:g} s"
        if code < 0:
            return f"ended by signal {-code}"
        return f"exit code {code}" if code else ""

    def _log_output(self) -> None:
        with open(self._reading, "rb") as lines:
            while line := lines.readline(MOST_LINE_BYTES):
                self._lines += 1
                if self._lines <= MOST_LINES:
                    log.info("%s", line.decode(errors="replace").rstrip("\n"))
                elif self._lines == MOST_LINES + 1:
                    log.info("the rest of the output is left out")
