"""Serves the page of a base."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from threading import Event
from typing import Any

from rass_mav.app.outlets import PageSection
from rass_mav.errors import RassError, why
from rass_mav.ground.archive import Archive
from rass_mav.ground.opening import Opens
from rass_mav.ground.page.server import Page, page_of, serve

log = logging.getLogger(__name__)

#: Seconds until an address or a store that cannot be used is tried again: at first, and at most.
AGAIN_S = 1.0
MOST_AGAIN_S = 60.0
# Between two looks at whether to stop.
_LOOK_S = 0.2


class Site:
    """The page, and whether it is served."""

    last_s: float | None = 2.0

    def __init__(self, section: PageSection, socket: Path, store: Path, opens: Opens | None = None) -> None:
        """`socket`: of the node that writes the store. `opens`: opens sealed data; None: they stay sealed."""
        self._section, self._socket, self._store, self._opens = section, socket, store, opens
        self._page: Page | None = None
        self._url: str | None = None
        self._trouble = ""

    def report(self) -> dict[str, Any]:
        """For `status`."""
        browsers = 0 if self._page is None else len(self._page.hub)
        return {"url": self._url, "browsers": browsers, "trouble": self._trouble or None}

    def run(self, stopping: Event) -> None:
        """Until the event is set."""
        again_s = AGAIN_S
        while not stopping.is_set():
            try:
                asyncio.run(self._serve(stopping))
            except RassError as error:
                self._complain(" ".join(error.lines()))
            except OSError as error:
                self._complain(f"{self._section.listen}: {why(error)}")
            self._url = None
            stopping.wait(again_s)
            again_s = min(2 * again_s, MOST_AGAIN_S)

    def _complain(self, trouble: str) -> None:
        if trouble != self._trouble:
            log.warning("page: %s", trouble)
        self._trouble = trouble

    def _open(self) -> Archive:
        return Archive(self._store, salvage=False, opens=self._opens)

    async def _serve(self, stopping: Event) -> None:
        # A damaged store is repaired by its node; a copy of what can be read would be outdated at once.
        self._page = page_of(self._section, self._open, self._socket)
        stopped = asyncio.Event()

        async def watch() -> None:
            while not stopping.is_set():
                await asyncio.sleep(_LOOK_S)
            stopped.set()

        def ready(url: str) -> None:
            self._url, self._trouble = url, ""

        watching = asyncio.create_task(watch())
        try:
            await serve(self._page, self._section.listen, ready, stopped)
        finally:
            watching.cancel()
