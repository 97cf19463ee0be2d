"""The commits of a running node: writes the gate's batches on a worker thread, one at a time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor

from rass_mav.agent.commits import CommitGate
from rass_mav.agent.outgoing import Outgoing
from rass_mav.core.store import Store
from rass_mav.errors import RassError, StoreDamagedError, StoreError

log = logging.getLogger(__name__)

#: Seconds between a failed commit and the next attempt.
RETRY_S = 1.0


class Writer:
    """Writes the batches of one store, on the event loop."""

    def __init__(
        self,
        store: Store,
        executor: Executor,
        wake: Callable[[], None],
        failed: Callable[[StoreError], None],
        note: Callable[[], None] | None = None,
    ) -> None:
        """`executor`: one thread. `wake`: called when a write has ended; then call `drive`. `failed`: called with the
        error of a failed write.

        `note`: stores what every commit must include. A note alone is no reason for a commit.
        """
        self.gate = CommitGate(store)
        """Holds the frames that wait for commits."""
        self.retry_at: float | None = None
        """When a failed commit is tried again, on the loop's clock; None: the last one did not fail."""
        self._store = store
        self._executor = executor
        self._wake = wake
        self._failed = failed
        self._note = note
        self._write: asyncio.Future[None] | None = None

    def drive(self, *, force: bool = False, waits: bool = False) -> Sequence[Outgoing]:
        """Handle a finished commit, and begin the next one, unless it `waits` for more. Returns what may leave. Raises
        `StoreDamagedError`."""
        out: list[Outgoing] = []
        if self._write is not None:
            if not self._write.done():
                return out
            out += self._finish(self._write)
        loop = asyncio.get_running_loop()
        if waits or (self.retry_at is not None and loop.time() < self.retry_at and not force):
            return out
        if self._note is not None and (force or self._store.unwritten):
            self._note()
        batch = self.gate.begin(force=force)
        if batch is None:
            self.retry_at = None
            return [*out, *self.gate.written()]
        self._write = loop.run_in_executor(self._executor, self._store.write, batch)
        self._write.add_done_callback(lambda _: self._wake())
        return out

    def _finish(self, write: asyncio.Future[None]) -> Sequence[Outgoing]:
        self._write = None
        try:
            write.result()
        except StoreDamagedError:
            raise
        except StoreError as error:
            self.retry_at = asyncio.get_running_loop().time() + RETRY_S
            self.gate.failed(StoreError(f"not on disk yet, kept in memory until it can be written: {error}"))
            self._failed(error)
            return ()
        if self.retry_at is not None:
            self.retry_at = None
            log.warning("the store is writable again")
        return self.gate.written()

    async def finish(self) -> Sequence[Outgoing]:
        """Commit all changes. Returns the frames that waited. Raises `StoreError` if they cannot be written."""
        out: list[Outgoing] = []
        if self._write is not None:
            await asyncio.wait([self._write])
        out += self.drive(force=True)
        if self._write is not None:
            await asyncio.wait([self._write])
            out += self._finish(self._write)
            if self.retry_at is not None:
                raise StoreError("stopped, but the last data could not be written to disk")
        return out

    async def durable(self) -> None:
        """Wait until all changes are on disk. Raises `StoreError` if they cannot be written now."""
        durable: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def tell(error: RassError | None) -> None:
            if durable.done():
                return
            if error is None:
                durable.set_result(None)
            else:
                durable.set_exception(error)

        self.gate.ask(tell)
        self._wake()
        await durable
