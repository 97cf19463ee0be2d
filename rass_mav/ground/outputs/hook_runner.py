"""Runs the user's command for each datum that arrives, and keeps where it has got to."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any

from rass_mav.app.outlets import OnArrivalSection
from rass_mav.errors import StoreError, why
from rass_mav.ground.archive import Archive
from rass_mav.ground.entry import Entry
from rass_mav.ground.feed import LOOK_S, Cursor, Feed
from rass_mav.ground.opening import Opens
from rass_mav.store.files import beside, make_file, sync_directory
from rass_mav.store.lock import Lock

from .hook import Hook

log = logging.getLogger(__name__)

#: The file that says how far it has got: its ending after the store's name.
ENDING = ".told"
#: Data that are read at a time.
MOST_ENTRIES = 256
#: Seconds between two lines about failures in the log, at least.
ALARM_S = 30.0
#: After this many seconds it looks again at how many data wait.
FRESH_S = 2.0


class HookRunner:
    """Tells the command of each datum, in the order of arrival, at least once.

    The cursor is written after each run. So after a crash the last datum may be told again, and none is left out. A
    command that fails is not run again for the same datum, unless it failed while the base was stopping.
    """

    last_s: float | None = None

    def __init__(self, section: OnArrivalSection, store: Path, opens: Opens | None = None) -> None:
        """`opens`: opens sealed data; None: they stay sealed."""
        self._store = store
        # A damaged store is repaired by its node.
        self._feed = Feed(lambda: Archive(store, salvage=False, opens=opens))
        self._kinds = section.kinds
        self._hook = Hook(section)
        self._file = beside(store, ENDING)
        self._cursor: Cursor | None = None
        self._told = self._failed = self._behind = 0
        self._last_failure = ""
        self._trouble = ""
        self._next_alarm = 0.0
        self._unsaid = 0

    def report(self) -> dict[str, Any]:
        """For `status`, since the process was started."""
        return {
            "behind": self._behind,
            "told": self._told,
            "failed": self._failed,
            "last_failure": self._last_failure or None,
            "trouble": self._trouble or None,
        }

    def run(self, stopping: Event) -> None:
        """Until the event is set, and the command that runs then has ended."""
        lock = self._locked(stopping)
        if lock is None:
            return
        try:
            self._cursor = read_cursor(self._file)
            while not stopping.is_set():
                if not self._go_on(stopping):
                    stopping.wait(LOOK_S)
        finally:
            lock.release()

    def _locked(self, stopping: Event) -> Lock | None:
        """The right to use the cursor: the process of a node that was killed may still be at its last datum. None: the
        event was set."""
        while not stopping.is_set():
            try:
                return Lock(self._file)
            except StoreError as error:
                self._trouble = str(error)
                stopping.wait(LOOK_S)
        return None

    def _go_on(self, stopping: Event) -> bool:
        """Tell of the next data. Returns whether there were any."""
        try:
            with self._feed.look(self._cursor) as look:
                arrivals = list(islice(look.arrivals(second_contents=False), MOST_ENTRIES))
                self._behind = look.behind(look.start)
        except StoreError as error:
            # The node itself finds out, and repairs it.
            self._trouble = str(error)
            return False
        self._trouble = ""
        if look.restarted:
            log.warning("%s was recovered after damage: its data are told again from the beginning", self._store)
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
            self._told += 1
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
        except OSError as error:
            # It goes on: after a restart some data are told again.
            self._trouble = f"{self._file}: {why(error)}"


def read_cursor(path: Path) -> Cursor | None:
    """The cursor in a file; None: there is none that can be read."""
    try:
        plain = json.loads(path.read_bytes())
        return Cursor(int(plain["life"], 16), int(plain["epoch"], 16), int(plain["arrival"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        log.warning("%s: cannot be read: all data are told again", path)
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
