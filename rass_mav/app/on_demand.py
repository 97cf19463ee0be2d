"""Files that are put: what handles them is loaded and started with the first one, because most nodes never get one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rass_mav.core.datum import DatumId
from rass_mav.errors import ControlError

from .driver import Driver
from .track import Track

if TYPE_CHECKING:
    from .files import Files
    from .watch import Watch

#: Behind the name of the store, the folder of files that wait, and the file with what was put from a watched folder.
FILES, WATCHED = ".files", ".watched"


class FilesOnDemand:
    """The files of a node, and the folder that it watches."""

    def __init__(self, driver: Driver, folder: Path, part_bytes: int | None) -> None:
        """`folder`: for files that wait. If it is there, some may wait already. `part_bytes`: of a part at most. Raises
        `StoreError`."""
        self._driver = driver
        self._folder = folder
        self._part_bytes = part_bytes
        self.track = Track(driver)
        """Where the node was lately."""
        self._stack = ExitStack()
        self._work: list[Callable[[], Coroutine[Any, Any, None]]] = []
        self._tasks: list[asyncio.Task[None]] | None = None
        """None: nothing runs yet."""
        self._files: Files | None = None
        self._watch: Watch | None = None
        if folder.is_dir():
            self.open()

    def open(self) -> Files:
        """What handles files. Raises `StoreError`."""
        if self._files is None:
            from .files import Files
            from .spool import Spool

            self._files = Files(self._driver, Spool(self._folder), self._part_bytes, self._thread("files"), self.track)
            self._begin(self._files.run)
        return self._files

    def watch(self, folder: Path, settle_s: float, notes: Path) -> None:
        """Put the files of a folder, too. As for a `Watch`."""
        from .watch import Watch

        self._watch = Watch(folder, settle_s, self._driver, self.open(), notes, self._thread("watch"))
        self._begin(self._watch.run)

    def _thread(self, name: str) -> Executor:
        return self._stack.enter_context(ThreadPoolExecutor(1, name))

    def _begin(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self._work.append(work)
        if self._tasks is not None:
            self._tasks.append(asyncio.create_task(self._supervised(work)))

    async def _supervised(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Damage of the store, and faults of ours, end the driver."""
        try:
            await work()
        except asyncio.CancelledError:
            raise
        except BaseException as error:
            self._driver.fail(error)
            raise

    @contextmanager
    def running(self) -> Iterator[None]:
        """Create the data of files, and look after the folder, during the block."""
        self._tasks = [asyncio.create_task(self._supervised(work)) for work in self._work]
        try:
            yield
        finally:
            for task in self._tasks:
                task.cancel()

    def close(self) -> None:
        """End the threads."""
        self._stack.close()

    def report(self) -> dict[str, Any]:
        """For `status`."""
        return {
            "files": [] if self._files is None else self._files.report(),
            "watch": None if self._watch is None else self._watch.report(),
        }

    def progress(self, id: DatumId) -> dict[str, int]:
        """How far a datum that was created here is, or the file of a manifest: how many `data` are needed, and
        how many of them have `arrived` or are `lost`, as far as is known. Raises `ControlError`: it hears nothing."""
        node = self._driver.agent.node
        if not (node.sink or node.receipts.active):
            raise ControlError("this node cannot tell what has arrived: its policy uses no receipts")
        if self._files is not None and (found := self._files.progress(id)) is not None:
            return found
        receipts = node.receipts
        return {"data": 1, "arrived": int(node.sink or id in receipts), "lost": int(receipts.is_reported_lost(id))}
