"""What the output process does, each on a thread of its own. What fails is tried again."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from threading import Event
from typing import Any

from rass_mav.errors import RassError

log = logging.getLogger(__name__)

#: Seconds until what cannot be used (a database, an address, a store) is tried again for the first time.
AGAIN_S = 1.0


class Task(ABC):
    """Something that goes on beside the node."""

    name: str
    """Of its section in the configuration."""
    last_s: float | None = None
    """It is waited for so many seconds at the end; None: until it ends by itself."""
    most_again_s: float = 60.0
    """What fails is tried again after `AGAIN_S`, then at intervals that grow up to so many seconds."""

    def __init__(self) -> None:
        self.trouble = ""
        """Why it does not work now; empty: it does."""
        self._again_s = AGAIN_S

    @abstractmethod
    def work(self, stopping: Event) -> None:
        """Until the event is set; and then as long as needed, but within a limit. Raises `RassError`: it is tried
        again."""

    @abstractmethod
    def report(self) -> dict[str, Any]:
        """For `status`. Called on another thread."""

    def run(self, stopping: Event) -> None:
        """Work until the event is set, whatever fails meanwhile."""
        while not stopping.is_set():
            try:
                self.work(stopping)
            except RassError as error:
                self.complain(" ".join(error.lines()))
                self.wait(stopping, self._again_s)
                self._again_s = min(2 * self._again_s, self.most_again_s)

    def wait(self, stopping: Event, wait_s: float) -> None:
        """Wait until it is tried again."""
        stopping.wait(wait_s)

    def complain(self, trouble: str) -> None:
        """It does not work. Logged once."""
        if trouble != self.trouble:
            log.warning("%s: %s", self.name, trouble)
        self.trouble = trouble

    def works(self) -> None:
        """It works, or does again."""
        if self.trouble:
            log.warning("%s: working again", self.name)
        self.trouble, self._again_s = "", AGAIN_S
