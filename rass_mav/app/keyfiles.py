"""The node's key file, which may change while it runs, and the key updates that it keeps beside its store."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path

from rass_mav.agent.agent import VehicleService
from rass_mav.errors import KeysError, MalformedError, why
from rass_mav.mavlink.messages import CRITICAL, WARNING
from rass_mav.trust.key_updates import KeyUpdates
from rass_mav.trust.keys.files import write_over
from rass_mav.trust.keys.key_updates import key_updates_in, key_updates_text
from rass_mav.trust.keys.keyring import Keyring

log = logging.getLogger(__name__)

#: Seconds between two looks at the key file.
LOOK_S = 2.0
#: Seconds between two writes of key updates, and after one that failed.
WRITE_S, RETRY_S = 10.0, 60.0
#: The largest file of key updates that is read.
MAX_BYTES = 1 << 20


def key_updates_path(store: Path) -> Path:
    """Where the node with this store keeps its key updates."""
    return store.with_name(store.name + ".letters")


def kept_key_updates(store: Path, keyring: Keyring) -> list[bytes]:
    """The key updates of earlier lives. Empty: there are none that can be read."""
    path = key_updates_path(store)
    try:
        with path.open("rb") as file:
            return key_updates_in(file.read(MAX_BYTES), keyring.own.ground)
    except FileNotFoundError:
        return []
    except (OSError, MalformedError) as error:
        reason = why(error) if isinstance(error, OSError) else error
        log.warning("%s: %s; the node will receive its key updates again from its neighbours", path, reason)
        return []


class KeyFiles(VehicleService):
    """A service of the agent."""

    def __init__(
        self,
        key_updates: KeyUpdates,
        key_file: str,
        store: Path,
        load: Callable[[], Keyring],
        executor: Executor,
        tell: Callable[[int, str], None],
    ) -> None:
        """`load`: reads the keys from `key_file`. `executor`: writes. `tell`: informs the operator."""
        self._key_updates = key_updates
        self._key_file = key_file
        self._path = key_updates_path(store)
        self._load = load
        self._executor = executor
        self._tell = tell
        self._seen = self._look()
        self._look_at = 0.0
        self._writing: Future[None] | None = None
        self._written = key_updates.news
        """The news of the key updates on disk, or on their way there."""
        self._link_written = key_updates.link.number
        self._write_at = 0.0
        self._failed = False

    def step(self, now: float) -> None:
        """Once a step."""
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            self._take_changes()
        key_updates = self._key_updates
        if self._writing is not None:
            if not self._writing.done():
                return
            self._has_written(self._writing, now)
        if key_updates.news != self._written and (
            now >= self._write_at or key_updates.link.number != self._link_written
        ):
            self._written, self._link_written, self._write_at = key_updates.news, key_updates.link.number, now + WRITE_S
            self._writing = self._executor.submit(write_over, self._path, key_updates_text(key_updates.packed()))

    def _look(self) -> tuple[int, ...] | None:
        try:
            found = os.stat(self._key_file)
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size

    def _take_changes(self) -> None:
        seen = self._look()
        if seen == self._seen:
            return
        self._seen = seen
        if seen is None:
            # The node has its keys in memory.
            return
        try:
            self._key_updates.renew(self._load())
        except KeysError as error:
            # Perhaps it is being copied. Then it changes again.
            log.warning("%s", error)
            self._tell(WARNING, "RASS: the key file has changed but cannot be used, see the log")
        else:
            log.info("%s: reloaded", self._key_file)

    def _has_written(self, writing: Future[None], now: float) -> None:
        self._writing = None
        error = writing.exception()
        if error is None:
            self._failed = False
            return
        if not isinstance(error, OSError):
            raise error
        self._written, self._write_at = -1, now + RETRY_S
        if not self._failed:
            self._failed = True
            log.error("%s: %s; after a restart the node needs its key updates again", self._path, why(error))
            self._tell(CRITICAL, "RASS: the new link key is not on disk, only in memory; trying again")
