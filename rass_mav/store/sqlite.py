"""The store of a real node: a SQLite file that survives power cuts.

Two connections: one writes, inside `write` only and so on whichever thread the driver commits on; the other reads, on
the thread of the store's owner. In write-ahead mode (WAL) neither waits for the other. With `synchronous = FULL` a
commit returns when the disk has it.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rass_mav.core.datum import Datum, DatumId, Fate
from rass_mav.core.store import StoredInfo
from rass_mav.errors import StoreDamagedError, StoreFullError

from . import schema
from .changes import Batch, BatchState, Changes
from .errors import Unsound, explained
from .opening import CHECK_LIMIT, Lock, OpenReport, begin_anew, connect, prepare
from .quota import ROW_OVERHEAD, charge

#: Removals that wait for company before `take` hands them out alone.
MAX_WAITING_REMOVALS = 512
#: Bytes (payload and `ROW_OVERHEAD`) that may wait in memory for the next commit. It is reached when the disk fails or
#: does not keep up; then `put` refuses. A batch on its way to the disk is not counted, so twice as much may wait.
MAX_BUFFERED_BYTES = 16 << 20

_RECORDED = (Fate.CORRUPTED, Fate.EXPIRED)


class SqliteStore:
    """A `Store` in a SQLite file. Made by `open`.

    **Sequence numbers.** A number that `next_sequence` claims becomes durable in the transaction that stores the datum
    which bears it. After a crash before that commit the number is claimed once more. This is safe, because what the
    commit would have made durable had not been sent either: nobody has ever seen the number.

    **A write that fails** loses nothing: its batch stays visible to `get`, and the next `take` hands it out again,
    together with what has changed since. The driver need only hold back its frames and try again later.

    **Damage** that shows while the store is in use raises `StoreDamagedError`. The way on is `abandon`, and `open` with
    `suspect=True`, which checks the whole file: either it is sound after all, or it is set aside. What was
    buffered is gone then, as after a crash; nobody had been told of it.
    """

    def __init__(
        self,
        path: Path,
        lock: Lock,
        reader: sqlite3.Connection,
        writer: sqlite3.Connection,
        report: OpenReport,
        quota_bytes: int | None,
    ) -> None:
        """Not to be called: see `open`."""
        self._path = path
        self._lock = lock
        self._reader = reader
        self._writer = writer
        self._writing = threading.Lock()
        self._closed = False
        self.report = report
        """What opening the store found: whether it was created, and what was set aside for being damaged."""
        self._quota = quota_bytes
        self._changes = Changes()
        self._buffered = 0
        self._out: Batch | None = None
        self._failing = False
        self._meta = schema.read_numbers(reader, "meta")
        self.epoch, self._sequence = schema.read_own(self._meta)
        """32 bits, drawn when the store was created; and the sequence number of the next own datum."""
        self.life = self.epoch
        self._counters = schema.read_numbers(reader, "counter")
        # Id -> size of all that is stored, buffered changes included, in the order of arrival.
        self._sizes: dict[DatumId, int] = {info.id: info.size for info in schema.read_infos(reader)}
        self.used_bytes = sum(self._sizes.values()) + ROW_OVERHEAD * len(self._sizes)
        """Bytes of payload plus `ROW_OVERHEAD` for each datum, buffered ones included: what the quota bounds."""

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        draw_epoch: Callable[[], int],
        quota_bytes: int | None = None,
        file_limit: int | None = None,
        suspect: bool = False,
        check_limit: int = CHECK_LIMIT,
        busy_timeout: float = 5.0,
        vfs: str | None = None,
    ) -> SqliteStore:
        """Open the store at `path`, or make a new one. Blocking; up to seconds for a large file.

        `draw_epoch`: called for the epoch (32 bits) if a store is made.
        `quota_bytes`: bound of payload bytes plus `ROW_OVERHEAD` a datum; None: no bound.
        `file_limit`: bound of the database file in bytes, rounded down to pages; a commit beyond it fails as on a full
        disk. None: no bound.
        `suspect`: check the whole file whatever its size; for opening again after `StoreDamagedError`.
        `check_limit`: size of file in bytes up to which the whole file is checked in any case.
        `busy_timeout`: seconds that a commit waits for another program that has locked the database.
        `vfs`: SQLite's name of what it reads and writes files with, letters, digits and _ - only; None: its default.

        A file that is damaged or no store is set aside under a new name; `report` tells. Raises `StoreError` naming
        the path if the directory is missing or not writable, if another node uses the store, or if a newer
        version of this program made it.
        """
        path = Path(path)
        lock = Lock(path)

        def load(report: OpenReport) -> SqliteStore:
            connections: list[sqlite3.Connection] = []
            try:
                with explained(path, "opening the store"):
                    for _ in range(2):
                        connections.append(connect(path, vfs=vfs, busy_timeout=busy_timeout))
                    reader, writer = connections
                    reader.execute("PRAGMA query_only = ON")
                    writer.execute("PRAGMA synchronous = FULL")
                    if file_limit is not None:
                        page = writer.execute("PRAGMA page_size").fetchall()[0][0]
                        writer.execute(f"PRAGMA max_page_count = {max(file_limit // page, 1)}")
                    return cls(path, lock, reader, writer, report, quota_bytes)
            except BaseException:
                for connection in connections:
                    connection.close()
                raise

        try:
            report = prepare(path, draw_epoch, suspect=suspect, check_limit=check_limit, vfs=vfs)
            try:
                return load(report)
            except StoreDamagedError as error:
                return load(begin_anew(path, draw_epoch, str(error.__cause__), vfs))
        except BaseException:
            lock.release()
            raise

    # -- what the store is ---------------------------------------------------------------------------------------------

    # -- changes -------------------------------------------------------------------------------------------------------

    @property
    def given(self) -> int:
        """How many numbers of this epoch have been given."""
        return self._sequence

    def next_sequence(self) -> int:
        """Claim the next sequence number of this epoch; durable with the next commit. From 0, without holes."""
        sequence = self._sequence
        if sequence == 1 << 32:
            raise StoreFullError(f"{self._path}: all sequence numbers of this epoch are used up")
        self._sequence = self._changes.sequence = sequence + 1
        return sequence

    @property
    def accepting(self) -> bool:
        """False from a failed write until one succeeds."""
        return not self._failing

    @property
    def unwritten(self) -> bool:
        """Whether a batch is not known to be durable, or one is due."""
        return self._changes.urgent or self._in_flight() is not _NOTHING

    def room_for(self, size: int) -> bool:
        """Whether a new datum of `size` bytes of payload fits the quota, and what may wait for a commit."""
        cost = size + ROW_OVERHEAD
        within_quota = self._quota is None or self.used_bytes + cost <= self._quota
        return within_quota and self._buffered + cost <= MAX_BUFFERED_BYTES

    def put(self, datum: Datum) -> None:
        """Store a datum as the latest, or replace the one with its id.

        Raises `StoreFullError` over the quota, or when too much waits for a commit; then nothing changes.
        """
        id, size = datum.id, len(datum.payload)
        old = self._sizes.get(id)
        used = charge(self.used_bytes, 0 if old is None else old + ROW_OVERHEAD, size, self._quota)
        if self._buffered + size + ROW_OVERHEAD > MAX_BUFFERED_BYTES:
            raise StoreFullError(f"{self._path}: {self._buffered} bytes wait to be written, no more fit in memory")
        self._release(id)
        self._changes.put(datum, older=old is not None)
        self._sizes.pop(id, None)
        self._sizes[id] = size
        self.used_bytes = used
        self._buffered += size + ROW_OVERHEAD

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        """Those of some stored data whose bytes do not fit their checksum any more, in the same order."""
        return [id for id in ids if (datum := self.get(id)) is None or not datum.intact]

    def durable(self, id: DatumId) -> bool:
        """Whether a datum is stored, and on disk."""
        return id in self._sizes and id not in self._changes.puts and id not in self._in_flight().puts

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum; note the loss if it was corrupted or expired. Unknown ids are ignored."""
        size = self._sizes.pop(id, None)
        if size is None:
            return
        self._release(id)
        self._changes.remove(id)
        self.used_bytes -= size + ROW_OVERHEAD
        if fate in _RECORDED:
            self.lose(id, fate)

    def lose(self, id: DatumId, fate: Fate) -> None:
        """Note a loss elsewhere. The first fate that is noted for an id stays."""
        self._changes.lose(id, fate)

    def found(self, id: DatumId) -> None:
        """Take an entry out of the table of losses; need not be durable soon. Unknown ids are ignored."""
        self._changes.found(id)

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a named counter that survives restarts."""
        self._counters[name] = self._changes.counters[name] = self._counters.get(name, 0) + amount

    def set_meta(self, key: str, value: int) -> None:
        """Set a number that survives restarts; durable with the next commit.

        `value`: 64 bits, signed. `key` must not begin with "store.": such names are the store's own.
        """
        if key.startswith(schema.OWN_PREFIX) or not -(1 << 63) <= value < 1 << 63:
            raise ValueError(f"{key} = {value}: a reserved name, or more than 64 bits")
        self._meta[key] = self._changes.meta[key] = value

    def _release(self, id: DatumId) -> None:
        """Take a datum that waits in the buffer out of the count of buffered bytes."""
        waiting = self._changes.puts.get(id)
        if waiting is not None:
            self._buffered -= len(waiting.payload) + ROW_OVERHEAD

    # -- what is stored ------------------------------------------------------------------------------------------------

    def keep_apart(self, datum: Datum) -> bool:
        """Store a second content under the id of a stored datum. False: there is no room, and there is none yet."""
        return False

    def get(self, id: DatumId) -> Datum | None:
        """The datum as its bytes are now (its checksum is not verified here), or None."""
        if id not in self._sizes:
            return None
        datum = self._changes.puts.get(id) or self._in_flight().puts.get(id)
        if datum is not None:
            return datum
        with explained(self._path, "reading a datum"):
            datum = schema.read_datum(self._reader, id)
            if datum is None:
                raise Unsound(f"datum {id} is stored, but not found")
        return datum

    def held(self) -> Iterator[StoredInfo]:
        """What is stored, least recently stored first.

        Streams from the disk, without payloads. What is put or removed while it runs may be told or not.
        """
        in_memory = {**self._in_flight().followed_by(self._changes).puts}
        with explained(self._path, "listing the data"):
            for info in schema.read_infos(self._reader):
                if info.id in self._sizes and info.id not in in_memory:
                    yield info
        for id, kind, created, hops, crc, payload, _ in in_memory.values():
            if id in self._sizes:
                yield StoredInfo(id, kind, created, hops, crc, len(payload))

    def ids(self) -> Iterable[DatumId]:
        """The ids of what is stored, from memory: a list, safe to keep while the store changes."""
        return list(self._sizes)

    def losses(self) -> Iterable[tuple[DatumId, Fate]]:
        """The table of losses: a list, safe to keep while the store changes."""
        waiting = self._in_flight().followed_by(self._changes)
        with explained(self._path, "reading the losses"):
            durable = schema.read_losses(self._reader)
        for id in waiting.founds:
            durable.pop(id, None)
        return list({**waiting.losses, **durable}.items())

    def get_meta(self, key: str) -> int | None:
        """A small number that survives restarts."""
        return self._meta.get(key)

    def counters(self) -> dict[str, int]:
        """All named counters."""
        return dict(self._counters)

    def _in_flight(self) -> Changes:
        """The changes that were handed out and are not known to be durable. Reads of the disk come after this: what is
        not in here any more is in the database then."""
        if self._out is None:
            return _NOTHING
        if self._out.state is BatchState.WRITTEN:
            self._out = None
            return _NOTHING
        return self._out.changes

    # -- commits -------------------------------------------------------------------------------------------------------

    def take(self, *, force: bool = False) -> Batch | None:
        """What has to be written now, or None.

        Removals and counters alone wait for something that is told to others (`Changes.urgent`), unless `force` is set
        or `MAX_WAITING_REMOVALS` removals have come together. A batch whose write has failed is handed out
        again, together with the changes since. RuntimeError while the last batch is neither written nor given back.
        """
        self._in_flight()
        if self._out is not None:
            if self._out.state is not BatchState.FAILED:
                raise RuntimeError("the last batch has not been written yet")
            self.restore(self._out)
        changes = self._changes
        removals = len(changes.removes) + len(changes.founds)
        if not (changes.urgent or removals >= MAX_WAITING_REMOVALS or (force and changes)):
            return None
        self._changes = Changes()
        self._buffered = 0
        self._out = Batch(changes)
        return self._out

    def restore(self, batch: object) -> None:
        """Put a batch that was not written back in front of the buffer.

        On the thread of the store's owner. Needed only if `write` was never called for it: after a failed write, `take`
        does it.
        """
        out = self._checked(batch)
        if out.state not in (BatchState.TAKEN, BatchState.FAILED):
            raise RuntimeError(f"a batch that is {out.state.value} cannot be given back")
        self._changes = out.changes.followed_by(self._changes)
        self._buffered = sum(len(datum.payload) + ROW_OVERHEAD for datum in self._changes.puts.values())
        self._out = None

    def write(self, batch: object) -> None:
        """Make a batch durable: one transaction, one fsync. Blocking; on any thread, one call at a time.

        Raises `StoreFullError` on a full disk, `StoreDamagedError` for a damaged database, `StoreError` for other
        trouble. The batch is not lost then, and may be given to `write` once more, or left to the next `take`.
        """
        with self._writing:
            out = self._checked(batch)
            if out.state not in (BatchState.TAKEN, BatchState.FAILED):
                raise RuntimeError(f"the batch is {out.state.value} already")
            out.state = BatchState.WRITING
            try:
                with explained(self._path, "writing"):
                    self._transact(out.changes)
                out.state = BatchState.WRITTEN
                self._failing = False
            finally:
                if out.state is BatchState.WRITING:
                    out.state = BatchState.FAILED
                    self._failing = True

    def _checked(self, batch: object) -> Batch:
        out = self._out
        if out is None or batch is not out:
            raise RuntimeError("not the batch that was taken last")
        return out

    def _transact(self, changes: Changes) -> None:
        own = {} if changes.sequence is None else {schema.NEXT_SEQUENCE: changes.sequence}
        writer = self._writer
        writer.execute("BEGIN IMMEDIATE")
        try:
            writer.executemany(schema.DELETE_DATUM, changes.removes)
            writer.executemany(
                schema.INSERT_DATUM,
                (
                    (*id, kind, created, hops, crc, len(payload), payload)
                    for id, kind, created, hops, crc, payload, _ in changes.puts.values()
                ),
            )
            writer.executemany(schema.DELETE_LOSS, changes.founds)
            writer.executemany(schema.INSERT_LOSS, [(*id, fate.value) for id, fate in changes.losses.items()])
            schema.write_numbers(writer, "counter", changes.counters)
            schema.write_numbers(writer, "meta", {**changes.meta, **own})
            writer.execute("COMMIT")
        except BaseException:
            # On some errors SQLite has rolled back by itself.
            if writer.in_transaction:
                writer.execute("ROLLBACK")
            raise

    # -- the end -------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Write what is buffered and release the files, also if writing fails. Waits for a write in flight."""
        if self._closed:
            return
        try:
            with self._writing:
                self._in_flight()
            if self._out is not None:
                self.restore(self._out)
            batch = self.take(force=True)
            if batch is not None:
                self.write(batch)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Release the files and forget what is buffered, as a crash would. Waits for a write in flight."""
        if self._closed:
            return
        self._closed = True
        with self._writing:
            # The writer last: the last one to go cleans up the write-ahead log, which the reader may not.
            self._reader.close()
            self._writer.close()
        self._lock.release()

    def __enter__(self) -> SqliteStore:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


_NOTHING = Changes()
