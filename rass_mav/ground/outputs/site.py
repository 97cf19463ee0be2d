"""Serves the page of a base."""

from __future__ import annotations

import asyncio
from pathlib import Path
from threading import Event
from typing import Any

from rass_mav.app.outlets import PageSection
from rass_mav.errors import LinkError, os_errors_as
from rass_mav.ground.archive import Archive
from rass_mav.ground.attention.rules import RuleBook
from rass_mav.ground.entry import Opens
from rass_mav.ground.page.server import Page, page_of, serve

from .task import Task

# Between two looks at whether to stop, seconds.
_LOOK_S = 0.2


class Site(Task):
    """The page, and whether it is served."""

    name = "page"
    last_s = 2.0

    def __init__(
        self, section: PageSection, socket: Path, store: Path, opens: Opens | None = None,
        rules: RuleBook | None = None, title: str | None = None,
    ) -> None:  # fmt: skip
        """`socket`: of the node that writes the store. `opens`: opens sealed data; None: they stay sealed. `rules`: of
        what needs attention. `title`: as of an `Archive`."""
        super().__init__()
        self._rules, self._title = rules, title
        self._section, self._socket, self._store, self._opens = section, socket, store, opens
        self._page: Page | None = None
        self._url: str | None = None

    def report(self) -> dict[str, Any]:
        """For `status`."""
        browsers = 0 if self._page is None else len(self._page.hub)
        return {"url": self._url, "browsers": browsers, "trouble": self.trouble or None}

    def work(self, stopping: Event) -> None:
        """Raises `LinkError`: the address cannot be used; `StoreError`."""
        try:
            with os_errors_as(LinkError, self._section.listen):
                asyncio.run(self._serve(stopping))
        finally:
            self._url = None

    def _open(self) -> Archive:
        return Archive(self._store, salvage=False, opens=self._opens, title=self._title)

    async def _serve(self, stopping: Event) -> None:
        # A damaged store is repaired by its node; a copy of what can be read would be outdated at once.
        self._page = page_of(self._section, self._open, self._socket, self._rules)
        stopped = asyncio.Event()

        async def watch() -> None:
            while not stopping.is_set():
                await asyncio.sleep(_LOOK_S)
            stopped.set()

        def ready(url: str) -> None:
            self._url = url
            self.works()

        watching = asyncio.create_task(watch())
        try:
            await serve(self._page, self._section.listen, ready, stopped)
        finally:
            watching.cancel()
