"""The right to use a store."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from rass_mav.errors import StoreError

from .errors import explained
from .files import beside, make_file


class Lock:
    """The right to use a store: one process at a time. The system releases it however the process ends."""

    def __init__(self, path: Path, *, readable_only: bool = False) -> None:
        """Raises `StoreError` if another process, or another store in this one, has the lock.

        `readable_only`: nothing can be written here; if there is no lock file, no process needs to be kept out.
        """
        self._file = -1
        lock = beside(path, ".lock")
        with explained(lock, "locking the store"):
            if not readable_only:
                self._file = make_file(lock)
            elif lock.exists():
                self._file = os.open(lock, os.O_RDONLY)
            else:
                return
        try:
            with explained(lock, "locking the store"):
                try:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    holder = os.read(self._file, 32).decode("ascii", "replace").strip() or "unknown"
                    raise StoreError(f"{path}: in use by another node (process {holder})") from None
                if not readable_only:
                    os.ftruncate(self._file, 0)
                    os.pwrite(self._file, b"%d\n" % os.getpid(), 0)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Release the lock. The file stays: deleting it could take it from a process that has just opened it."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
