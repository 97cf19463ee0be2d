"""Makes files of the data for browsers, one at a time: in the formats of `rass_mav.ground.formats`."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, closing
from pathlib import Path
from tempfile import TemporaryDirectory

from rass_mav.errors import RassError, os_errors_as
from rass_mav.ground.entry import Data, Entry
from rass_mav.ground.formats import Format, format_of, names
from rass_mav.ground.selection import Selection

#: Of more data no browser gets a file.
MOST_EXPORTED = 1_000_000
# What a name of a file may have: what every system and every header takes.
_OTHERS = re.compile(r"[^A-Za-z0-9._-]+")


class BusyError(RassError):
    """Another file is made, or sent."""


class _StoppedError(RassError):
    """Nobody waits for the file any more."""


class Exports:
    """The formats that are one file each, and the file that is made."""

    def __init__(self, open: Callable[[], Data]) -> None:
        """`open`: opens the data, for another thread than that which follows them."""
        self._open = open
        # Formats are loaded now, so that a missing package shows at the start.
        found = {name: format_of(name) for name in names()}
        self.formats: dict[str, Format] = {name: format for name, format in found.items() if format.ending}
        """By name."""
        self._writing = ThreadPoolExecutor(1, "page-export")
        self._busy = False

    def plain(self) -> list[dict[str, str]]:
        """For the page."""
        return [{"name": name, "ending": format.ending} for name, format in self.formats.items()]

    @asynccontextmanager
    async def file(self, name: str, gone: Callable[[], bool]) -> AsyncIterator[Path]:
        """A file in one of these formats, as long as it is sent. `gone`: whether nobody waits for it any more. Raises
        `BusyError`, and `RassError`: it cannot be made, and why."""
        if self._busy:
            raise BusyError("another file is being written: try again in a moment")
        self._busy = True
        stopped = threading.Event()
        try:
            with TemporaryDirectory(prefix="rass-mav-") as folder:
                made = asyncio.get_running_loop().run_in_executor(
                    self._writing, lambda: self._write(name, Path(folder), lambda: stopped.is_set() or gone())
                )
                try:
                    path = await asyncio.shield(made)
                except asyncio.CancelledError:
                    # The thread writes into the folder.
                    stopped.set()
                    await asyncio.wait([made])
                    raise
                yield path
        finally:
            self._busy = False

    def _write(self, name: str, folder: Path, gone: Callable[[], bool]) -> Path:
        format, selection = self.formats[name], Selection()
        with os_errors_as(RassError, "export"), closing(self._open()) as data:
            if (count := data.count()) > MOST_EXPORTED:
                raise RassError(f"{count:,} data are too many for a browser: use rass-mav export")
            title = _OTHERS.sub("-", data.title).strip("-.")[:80] or "mission"
            path = folder / f"{title}{format.ending}"

            def entries() -> Iterator[Entry]:
                for entry in data.entries():
                    if gone():
                        raise _StoppedError("the download was cancelled")
                    yield entry

            done = format.write(selection.of(entries()), path, data)
            if not done.data:
                raise RassError(f"nothing to export: {selection.nothing(done.left_out, name, format, data)}")
        return path

    def close(self) -> None:
        """Wait until no thread works any more."""
        self._writing.shutdown()
