"""Runs the user's command for each datum that arrives, and keeps where it has got to."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any

from rass_mav.app.jsonlines import dump_line
from rass_mav.app.outlets import OnArrivalSection
from rass_mav.errors import why
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry, Opens
from rass_mav.ground.feed import LOOK_S, Cursor, Feed
from rass_mav.store.files import Lock, beside, make_file, sync_directory

from .task import AGAIN_S, Task

log = logging.getLogger(__name__)

#: The file that says how far it has got: its ending after the store's name.
ENDING = ".told"
#: Data that are read at a time.
MOST_ENTRIES = 256
#: Seconds between two lines about failures in the log, at least.
ALARM_S = 30.0
#: After this many seconds it looks again at how many data wait.
FRESH_S = 2.0
#: Of the output of one run: lines that are logged, and bytes of a line.
MOST_LINES = 100
MOST_LINE_BYTES = 1000
#: Of its last line, characters that a failure shows.
MOST_SHOWN = 200


class Hook:
    """Runs a command of the user's for a datum, one run at a time. Each gets a time limit, and its output goes to the
    log."""

    def __init__(self, section: OnArrivalSection) -> None:
        self._command = section.command
        self._timeout_s = section.timeout_s
        self._lines = 0
        self._last = ""
        # It marks the end of the output of a run.
        self._mark = os.urandom(16).hex().encode() + b"\n"
        self._read = threading.Event()
        # One pipe for all runs: what a command leaves running in the background keeps its end, and holds up nobody.
        self._reading, self._output = os.pipe()
        threading.Thread(target=self._log_output, name="output", daemon=True).start()

    def run(self, entry: Entry) -> str:
        """Run the command for a datum. Returns why it failed; empty: it did not."""
        self._last_line()  # of what ran before
        self._lines = 0
        # In memory, so that it can be neither full nor blocked, whether the command reads it or not.
        stdin = os.memfd_create("datum", os.MFD_CLOEXEC)
        try:
            os.write(stdin, dump_line(entry.plain()))
            os.lseek(stdin, 0, os.SEEK_SET)
            process = subprocess.Popen(
                self._command, stdin=stdin, stdout=self._output, stderr=self._output, start_new_session=True,
                env={
                    **os.environ, "RASS_ID": entry.name, "RASS_DRONE": str(entry.id.origin),
                    "RASS_KIND": entry.kind_name,
                },
            )  # fmt: skip
        except OSError as error:
            return f"{self._command[0]}: {why(error)}"
        finally:
            os.close(stdin)
        try:
            code = process.wait(self._timeout_s)
        except subprocess.TimeoutExpired:
            # With all that it has started and not put into a session of its own.
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return f"killed after {self._timeout_s:g} s"
        if code < 0:
            return f"ended by signal {-code}"
        if not code:
            return ""
        last = self._last_line()
        return f"exit code {code}: {last}" if last else f"exit code {code}"

    def _last_line(self) -> str:
        """The last line that came since the last call, when all of it is read."""
        self._read.clear()
        os.write(self._output, b"\n" + self._mark)
        self._read.wait()
        last, self._last = self._last, ""
        return "".join(c if c.isprintable() else "?" for c in last)[:MOST_SHOWN]

    def _log_output(self) -> None:
        with open(self._reading, "rb") as lines:
            while line := lines.readline(MOST_LINE_BYTES):
                if line == self._mark:
                    self._read.set()
                text = line.decode(errors="replace").rstrip("\n")
                if line == self._mark or not text:
                    continue
                self._lines += 1
                self._last = text
                if self._lines <= MOST_LINES:
                    log.info("%s", text)
                elif self._lines == MOST_LINES + 1:
                    log.info("the rest of the output is left out")


class HookRunner(Task):
    """Tells the command of each datum, in the order of arrival, at least once.

    The cursor is written after each run. So after a crash the last datum may be told again, and none is left out. A
    command that fails is not run again for the same datum, unless it failed while the base was stopping.
    """

    name = "on_arrival"
    # It may be an alarm.
    most_again_s = AGAIN_S

    def __init__(self, section: OnArrivalSection, store: Path, opens: Opens | None = None) -> None:
        """`opens`: opens sealed data; None: they stay sealed."""
        super().__init__()
        self._store = store
        # A damaged store is repaired by its node.
        self._feed = Feed(lambda: Archive(store, salvage=False, opens=opens))
        self._kinds = section.kinds
        self._hook = Hook(section)
        self._file = beside(store, ENDING)
        self._cursor: Cursor | None = None
        self._succeeded = self._failed = self._behind = 0
        self._last_failure = ""
        self._unsaved = ""
        """Why the cursor cannot be kept; empty: it can."""
        self._next_alarm = 0.0
        self._unsaid = 0

    def report(self) -> dict[str, Any]:
        """For `status`, since the process was started."""
        return {
            "behind": self._behind,
            "succeeded": self._succeeded,
            "failed": self._failed,
            "last_failure": self._last_failure or None,
            "trouble": self.trouble or self._unsaved or None,
        }

    def work(self, stopping: Event) -> None:
        """Until the event is set, and the command that runs then has ended. Raises `StoreError`."""
        # The process of a node that was killed may still be at its last datum.
        lock = Lock(self._file)
        try:
            self._cursor = read_cursor(self._file)
            while not stopping.is_set():
                if not self._go_on(stopping):
                    stopping.wait(LOOK_S)
        finally:
            lock.release()

    def _go_on(self, stopping: Event) -> bool:
        """Tell of the next data. Returns whether there were any. Raises `StoreError`."""
        with self._feed.look(self._cursor) as look:
            arrivals = list(islice(look.arrivals(second_contents=False), MOST_ENTRIES))
            self._behind = look.behind(look.start)
        self.works()
        if look.restarted:
            log.warning("%s was recovered after damage: the command runs again for all its data", self._store)
        self._cursor = look.start
        skipped = self._tell_all(arrivals, stopping)
        if skipped:
            self._save()
        return bool(arrivals)

    def _tell_all(self, arrivals: Iterable[tuple[Entry, Cursor]], stopping: Event) -> bool:
        """Returns whether the cursor has moved since it was last saved."""
        moved = False
        until = time.monotonic() + FRESH_S
        for entry, cursor in arrivals:
            if stopping.is_set() or time.monotonic() >= until:
                break
            wanted = entry.kind_name != "part" if self._kinds is None else entry.kind_name in self._kinds
            if wanted and not self._tell(entry, stopping):
                break
            self._cursor = cursor
            self._behind -= 1
            moved = not wanted
            if wanted:
                self._save()
        return moved

    def _tell(self, entry: Entry, stopping: Event) -> bool:
        """Returns whether that is done, well or not."""
        failure = self._hook.run(entry)
        if failure and stopping.is_set():
            return False
        if failure:
            self._failed += 1
            self._unsaid += 1
            self._last_failure = f"{entry.name}: {failure}"
            self._alarm()
        else:
            self._succeeded += 1
        return True

    def _alarm(self) -> None:
        now = time.monotonic()
        if now >= self._next_alarm:
            self._next_alarm = now + ALARM_S
            log.warning("the command failed for %d data, the last one %s", self._unsaid, self._last_failure)
            self._unsaid = 0

    def _save(self) -> None:
        assert self._cursor is not None
        try:
            write_cursor(self._file, self._cursor)
            self._unsaved = ""
        except OSError as error:
            # It goes on: after a restart some data are told again.
            self._unsaved = f"{self._file}: {why(error)}"


def read_cursor(path: Path) -> Cursor | None:
    """The cursor in a file; None: there is none that can be read."""
    try:
        plain = json.loads(path.read_bytes())
        return Cursor(int(plain["life"], 16), int(plain["epoch"], 16), int(plain["arrival"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        log.warning("%s: cannot be read: the command runs again for all data", path)
        return None


def write_cursor(path: Path, cursor: Cursor) -> None:
    """Replace the cursor in a file, durably and at once. Raises `OSError`."""
    draft = beside(path, ".new")
    plain = {"life": f"{cursor.life:08x}", "epoch": f"{cursor.epoch:08x}", "arrival": cursor.arrival}
    with open(make_file(draft), "wb") as file:
        file.truncate()
        file.write(json.dumps(plain).encode())
        file.flush()
        os.fsync(file.fileno())
    os.replace(draft, path)
    sync_directory(path)
