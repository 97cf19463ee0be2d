"""The store of a real node: a SQLite file that survives power cuts.

It has two connections. One writes, only inside `write` and so on the thread on which the driver commits. The other
reads, on the thread of the store's owner. In write-ahead mode (WAL) neither waits for the other. With `synchronous =
FULL` a commit returns when the disk has it.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from rass_mav.core.datum import RECORDED, Datum, DatumId, Fate
from rass_mav.core.store import MAX_APART, MAX_APART_OF_ONE, Loss, PartialKey, StoredInfo, info_of
from rass_mav.errors import StoreDamagedError, StoreError, StoreFullError

from . import schema
from .changes import Batch, BatchState, Changes
from .committing import Committer
from .disk import HOST, Disk, Quota
from .drafts import connect
from .errors import Unsound, explained
from .files import Lock, checked_path
from .opening import CHECK_LIMIT, Opening
from .payloads import Payloads
from .quota import MOST_PARTIAL_BYTES, charge, cost, lies_beside
from .repairs import OpenReport, Repairs
from .repairs import apply as repair

#: Removals that wait for other changes until `take` returns them alone.
MAX_WAITING_REMOVALS = 512
#: Bytes (the sum of `quota.cost`) that may wait in memory for the next commit. The limit is reached when the disk
#: fails or does not keep up; then `put` refuses. A batch that is being written is not counted, so twice as much may
#: wait.
MAX_BUFFERED_BYTES = 16 << 20
#: Losses that a read-only store keeps in memory.
MAX_UNWRITTEN_LOSSES = 4096

D = TypeVar("D", Datum, StoredInfo)


class SqliteStore:
    """A `Store` in a SQLite file. Created by `open`.

    **Sequence numbers.** A number that `next_sequence` claims becomes durable in the transaction that stores its datum.
    After a crash before that commit the number is claimed once more. This is safe, because nothing that the commit
    would have made durable had been sent either: no node has ever seen the number.

    **A write that fails** loses nothing: its batch stays visible to `get`, and the next `take` returns it again,
    together with what has changed since. The driver only has to hold back its frames and try again later.

    **Damage** that shows while the store is in use raises `StoreDamagedError`. The caller then calls `abandon`, and
    `open` with `suspect=True`, which checks the whole file: either it is sound after all, or it is set aside. The
    buffered changes are then lost, as after a crash; no node has heard of them.
    """

    def __init__(
        self,
        path: Path,
        lock: Lock,
        source: schema.Source,
        committer: Committer | None,
        report: OpenReport,
        quota_bytes: int | None,
        disk: Disk,
    ) -> None:
        """Not for callers: see `open`. `committer`: None: nothing can be written. `OSError`."""
        self._path = path
        self._lock = lock
        self._source = source
        self._committer = committer
        self._writing = threading.Lock()
        self._closed = False
        self.report = report
        """What opening the store found, and what was done about it."""
        self._quota = Quota(path, disk, quota_bytes)
        if committer is not None:
            self._quota.look()
        self._changes = Changes()
        self._buffered = 0
        self._out: Batch | None = None
        self._failing = False
        self._load(_NOTHING)

    def _load(self, waiting: Changes) -> None:
        """Load into memory what the disk has and will have: some changes are `waiting` for it."""
        self._meta = schema.read_numbers(self._source.rows, "meta")
        own = schema.read_own(self._meta)
        self.life, self.epoch = own.life, own.epoch
        """32 bits each. The life is drawn when the store is created; the epoch of newly assigned ids is drawn then, and
        whenever numbers may have been lost."""
        self._meta.update(waiting.meta)
        self._sequence = own.assigned if waiting.sequence is None else waiting.sequence
        self._counters = {**schema.read_numbers(self._source.rows, "counter"), **waiting.counters}
        # Id -> size of all stored data, buffered changes included, in the order of arrival.
        self._sizes: dict[DatumId, int] = {info.id: info.size for info in schema.read_infos(self._source.rows)}
        for id in (*waiting.removes, *waiting.puts):
            self._sizes.pop(id, None)
        self._sizes.update({id: len(datum.payload) for id, datum in waiting.puts.items()})
        self._apart = {(info.id, info.crc): info for info in schema.read_infos(self._source.rows, "apart")}
        self._apart.update({key: info_of(datum) for key, datum in waiting.apart.items()})
        self.used_bytes = sum(map(cost, (*self._sizes.values(), *(info.size for info in self._apart.values()))))
        """The sum of `cost`, buffered data included: what the quota bounds."""

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        node_id: int,
        draw_epoch: Callable[[], int],
        quota_bytes: int | None = None,
        suspect: bool = False,
        doubt: str = "",
        check_limit: int = CHECK_LIMIT,
        busy_timeout: float = 5.0,
        disk: Disk = HOST,
    ) -> SqliteStore:
        """Open the store at `path`, or create a new one. Blocking; up to seconds for a large file.

        `node_id`: the node that owns it; losses are recorded under it.
        `draw_epoch`: called for a life or an epoch (32 bits) when a new one is due.
        `quota_bytes`: bound of `used_bytes`; None: only that of the disk, which leaves a reserve free.
        `suspect`: check the whole file whatever its size; for opening again after `StoreDamagedError`.
        `doubt`: why a new epoch is due although the store is sound; for opening again after `StoreCopiedError`. Empty:
        none is.
        `check_limit`: size of file in bytes up to which the whole file is checked in any case.
        `busy_timeout`: seconds that a commit waits for another program that has locked the database.
        `disk`: where the files are.

        Damage is repaired; or the file is set aside under a new name, and what it still holds is salvaged. Where
        nothing can be written, the existing data are read and no new ones accepted. `report` describes it. Raises
        `StoreError` naming the path if the directory is missing, if another node uses the store, if a newer version of
        this program created it, or if one of an earlier version cannot be converted.
        """
        path = checked_path(path)
        opening = Opening(path, node_id, draw_epoch, disk, suspect, check_limit, doubt)

        def load(lock: Lock, report: OpenReport, repairs: Repairs) -> SqliteStore:
            reader: sqlite3.Connection | None = None
            committer: Committer | None = None
            try:
                with explained(path, "opening the store"):
                    committer = Committer(path, disk=disk, busy_timeout=busy_timeout)
                    writer = committer.connection
                    if repairs:
                        own = repairs.own or schema.read_own(schema.sound_numbers(writer, "meta")[0])
                        report = repair(writer, repairs, own, node_id)
                    reader = connect(path, vfs=disk.vfs, busy_timeout=busy_timeout)
                    reader.execute("PRAGMA query_only = ON")
                    source = schema.Source(reader, committer.payloads)
                    store = cls(path, lock, source, committer, report, quota_bytes, disk)
                    committer.begin(schema.read_own(schema.read_numbers(writer, "meta")))
                    return store
            except BaseException:
                if reader is not None:
                    reader.close()
                if committer is not None:
                    committer.close(clean=False)
                raise

        def load_repaired(lock: Lock) -> SqliteStore:
            try:
                return load(lock, *opening.prepare())
            except StoreDamagedError:
                # It was not checked closely enough.
                report, repairs = opening._replace(suspect=True).prepare()
            try:
                return load(lock, report, repairs)
            except StoreDamagedError as error:
                return load(lock, opening.begin_anew(str(error.__cause__)), Repairs())

        try:
            lock = Lock(path)
            try:
                return load_repaired(lock)
            except BaseException:
                lock.release()
                raise
        except StoreError as error:
            from .reading import open_to_read, why_unwritable  # what only a disk that refuses writes needs

            reason = why_unwritable(error, path)
            if not reason:
                raise
        lock = Lock(path, readable_only=True)
        try:
            reader = open_to_read(path, draw_epoch, disk.vfs)
            with explained(path, "opening the store to read"):
                source = schema.Source(reader, Payloads(path, disk, writable=False))
            return cls(path, lock, source, None, OpenReport(unwritable=reason), quota_bytes, disk)
        except BaseException:
            lock.release()
            raise

    # -- changes -------------------------------------------------------------------------------------------------------

    @property
    def assigned(self) -> int:
        """How many numbers of this epoch have been assigned."""
        return self._sequence

    def next_sequence(self) -> int:
        """Claim the next sequence number of this epoch; durable with the next commit. From 0, without gaps."""
        sequence = self._sequence
        if self._committer is None:
            raise StoreFullError(f"{self._path}: cannot be written ({self.report.unwritable}); no number was assigned")
        if sequence == 1 << 32:
            raise StoreFullError(f"{self._path}: all sequence numbers of this epoch are in use")
        self._sequence = self._changes.sequence = sequence + 1
        return sequence

    @property
    def quota_bytes(self) -> int | None:
        """What `used_bytes` may be now at most; None: no bound."""
        return self._quota.bytes

    @property
    def accepting(self) -> bool:
        """False from a failed write until one succeeds; permanently where nothing can be written."""
        return self._committer is not None and not self._failing

    @property
    def unwritten(self) -> bool:
        """Whether a batch is not known to be durable, or one is due. Where nothing can be written nothing waits."""
        if self._committer is None:
            return False
        return self._changes.urgent or self._in_flight().urgent

    def room_for(self, size: int) -> bool:
        """Whether a new datum of `size` bytes of payload fits the quota, and the limit of what may wait for a
        commit."""
        if self._committer is None:
            return False
        needed = cost(size)
        within_quota = self.quota_bytes is None or self.used_bytes + needed <= self.quota_bytes
        return within_quota and self._buffered + needed <= MAX_BUFFERED_BYTES

    def put(self, datum: Datum) -> None:
        """Store a datum as the latest, or replace the one with its id.

        Raises `StoreFullError` over the quota, when too much waits for a commit, or when nothing can be written;
        nothing changes then.
        """
        if self._committer is None:
            raise StoreFullError(f"{self._path}: cannot be written ({self.report.unwritable})")
        id, size = datum.id, len(datum.payload)
        old = self._sizes.get(id)
        used = charge(self.used_bytes, 0 if old is None else cost(old), size, self.quota_bytes)
        if self._buffered + cost(size) > MAX_BUFFERED_BYTES:
            raise StoreFullError(f"{self._path}: {self._buffered} bytes are waiting to be written, the limit")
        self._release(id)
        self._changes.put(datum, older=old is not None)
        self._sizes.pop(id, None)
        self._sizes[id] = size
        self.used_bytes = used
        self._buffered += cost(size)

    def keep_apart(self, datum: Datum) -> bool:
        """Keep a second content of an id beside the stored one. True: it is kept, or was. False: there is no space."""
        id, size = datum.id, len(datum.payload)
        stored = self.get(id)
        if (id, datum.crc) in self._apart or (stored is not None and stored.crc == datum.crc):
            return True
        of_this_id = sum(other == id for other, _ in self._apart)
        if len(self._apart) >= MAX_APART or of_this_id >= MAX_APART_OF_ONE or not self.room_for(size):
            return False
        self._changes.apart[id, datum.crc] = datum
        self._apart[id, datum.crc] = info_of(datum)
        self._buffered += cost(size)
        self.used_bytes += cost(size)
        return True

    def corrupt(self, ids: Iterable[DatumId]) -> list[DatumId]:
        """The ids, among some stored data, whose bytes no longer match their checksum, in the same order."""
        return [id for id in ids if (datum := self.get(id)) is None or not datum.intact]

    def durable(self, id: DatumId) -> bool:
        """Whether a datum is stored, and on disk."""
        return id in self._sizes and id not in self._changes.puts and id not in self._in_flight().puts

    def remove(self, id: DatumId, fate: Fate) -> None:
        """Forget a datum; record the loss if it was corrupted or expired. Unknown ids are ignored."""
        size = self._sizes.pop(id, None)
        if size is None:
            return
        self._release(id)
        self._changes.remove(id)
        self.used_bytes -= cost(size)
        if fate in RECORDED:
            self.lose(id, fate)

    def lose(self, id: DatumId, fate: Fate, proof: bytes = b"") -> None:
        """Record a loss elsewhere. The first fate recorded for an id stays."""
        if self._committer is not None or len(self._changes.losses) < MAX_UNWRITTEN_LOSSES:
            self._changes.lose(id, Loss(fate, proof))

    def found(self, id: DatumId) -> None:
        """Remove an entry from the table of losses; need not be durable soon. Unknown ids are ignored."""
        self._changes.found(id)

    def keep_partial(self, key: PartialKey, offset: int, data: bytes) -> None:
        """Keep a piece of a payload of which the rest has not come. Those below 4 KiB come in no time, and are not
        kept."""
        if self._committer is None or not lies_beside(key.size) or key.id in self._sizes:
            return
        pieces = self._changes.pieces
        waiting = sum(len(some) for every in pieces.values() for _, some in every)
        if waiting + len(data) <= MOST_PARTIAL_BYTES:
            of_key = pieces[key] = pieces.pop(key, [])
            of_key.append((offset, data))

    def partial(self, key: PartialKey) -> list[tuple[int, bytes]]:
        """The pieces that were kept and are there."""
        changes, out = self._changes, self._in_flight()
        found: list[tuple[int, bytes]] = []
        if self._committer is not None and key not in changes.forgotten:
            if key not in out.forgotten:
                with suppress(OSError):
                    found += self._committer.payloads.partial(key)
            found += out.pieces.get(key, ())
        return [*found, *changes.pieces.get(key, ())]

    def forget_partial(self, key: PartialKey) -> None:
        """The pieces are of no use."""
        if self._committer is not None:
            self._changes.forget(key)

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a named counter that survives restarts."""
        self._counters[name] = self._changes.counters[name] = self._counters.get(name, 0) + amount

    def set_meta(self, key: str, value: int) -> None:
        """Set a number that survives restarts; durable with the next commit.

        `value`: 64 bits, signed. `key` must not begin with "store.": such names belong to the store itself.
        """
        if key.startswith(schema.OWN_PREFIX) or not -(1 << 63) <= value < 1 << 63:
            raise ValueError(f"{key} = {value}: a reserved name, or more than 64 bits")
        self._meta[key] = self._changes.meta[key] = value

    def meta_durable(self, key: str) -> bool:
        """Whether such a number is on disk with its latest value."""
        return key not in self._changes.meta and key not in self._in_flight().meta

    def _release(self, id: DatumId) -> None:
        """Subtract a buffered datum from the count of buffered bytes."""
        waiting = self._changes.puts.get(id)
        if waiting is not None:
            self._buffered -= cost(len(waiting.payload))

    def note_time(self, now_ms: int) -> None:
        """What is written from now on arrived at this time, milliseconds on the node's timeline."""
        if self._committer is not None:
            self._committer.now_ms = now_ms

    def mark_at_least(self) -> None:
        """Every datum that is stored now is at least as old as recorded; durable with the next commit.

        Call it before anything is put.
        """
        self._changes.aged = True
        self._apart = {key: info._replace(at_least=True) for key, info in self._apart.items()}

    def amend(self, ids: Collection[DatumId], off_s: float) -> None:
        """These data are `off_s` seconds older than recorded, and not `at_least` so old; durable with the next commit.

        Unknown ids are ignored. A `roll_back` before that commit forgets it.
        """
        wanted = frozenset(ids)
        amends = {info.id: info.created - off_s for info in self.held() if info.id in wanted}
        self._changes.amends.update(amends)

    @property
    def _aged(self) -> bool:
        """Whether rows on disk do not show yet that they are older. Call it before reading them."""
        return self._changes.aged or self._in_flight().aged

    # -- stored data ---------------------------------------------------------------------------------------------------

    def get(self, id: DatumId) -> Datum | None:
        """The datum as its bytes are now (its checksum is not verified here), or None."""
        if id not in self._sizes:
            return None
        changes, out = self._changes, self._in_flight()
        # What has been put again since the batch was taken is newer than the batch.
        amended = changes.amends.get(id, None if id in changes.puts else out.amends.get(id))
        datum = changes.puts.get(id) or out.puts.get(id)
        if datum is not None:
            return _aged(datum, False, amended)
        aged = self._aged
        with explained(self._path, "reading a datum"):
            datum = schema.read_datum(self._source, id)
            if datum is None:
                raise Unsound(f"datum {id} is in the index but not in the database")
        return _aged(datum, aged, amended)

    def apart(self) -> Iterable[StoredInfo]:
        """The second contents: a list, safe to keep while the store changes."""
        return list(self._apart.values())

    def get_apart(self, id: DatumId, crc: int) -> Datum | None:
        """One second content, or None."""
        if (id, crc) not in self._apart:
            return None
        datum = self._changes.apart.get((id, crc)) or self._in_flight().apart.get((id, crc))
        if datum is not None:
            return datum
        aged = self._aged
        with explained(self._path, "reading a datum"):
            datum = schema.read_datum(self._source, id, crc)
        return datum._replace(at_least=True) if aged and datum is not None else datum

    def held(self) -> Iterator[StoredInfo]:
        """What is stored, least recently stored first.

        Streams from the disk, without payloads. Data that are put or removed while it runs may be included or not.
        """
        waiting = self._in_flight().followed_by(self._changes)
        in_memory, amends = waiting.puts, waiting.amends
        aged = self._aged
        with explained(self._path, "listing the data"):
            for info in schema.read_infos(self._source.rows, payloads=self._source.payloads):
                if info.id in self._sizes and info.id not in in_memory:
                    yield _aged(info, aged, amends.get(info.id))
        for datum in in_memory.values():
            if datum.id in self._sizes:
                yield _aged(info_of(datum), False, amends.get(datum.id))

    def ids(self) -> Iterable[DatumId]:
        """The ids of what is stored, from memory: a list, safe to keep while the store changes."""
        return list(self._sizes)

    def losses(self) -> Iterable[tuple[DatumId, Fate]]:
        """The table of losses: a list, safe to keep while the store changes."""
        return [(id, loss.fate) for id, loss in self._losses().items()]

    def proofs(self) -> dict[DatumId, bytes]:
        """The proofs in the table of losses, where there are any."""
        return {id: loss.proof for id, loss in self._losses().items() if loss.proof}

    def _losses(self) -> dict[DatumId, Loss]:
        waiting = self._in_flight().followed_by(self._changes)
        with explained(self._path, "reading the losses"):
            durable = schema.read_losses(self._source.rows)
        for id in waiting.founds:
            durable.pop(id, None)
        return {**waiting.losses, **durable}

    def get_meta(self, key: str) -> int | None:
        """A small number that survives restarts."""
        return self._meta.get(key)

    def counters(self) -> dict[str, int]:
        """All named counters."""
        return dict(self._counters)

    def _in_flight(self) -> Changes:
        """The changes that were returned by `take` and are not known to be durable. Read the disk after this: what is
        no longer in here is then in the database."""
        if self._out is None:
            return _NOTHING
        if self._out.state is BatchState.WRITTEN:
            self._out = None
            return _NOTHING
        return self._out.changes

    # -- commits -------------------------------------------------------------------------------------------------------

    def take(self, *, force: bool = False) -> Batch | None:
        """What has to be written now, or None.

        Removals and counters alone wait for changes that other nodes will hear about (`Changes.urgent`), unless `force`
        is set or there are `MAX_WAITING_REMOVALS` removals. What has not come whole does not wait, and nothing waits
        for it. A batch whose write has failed is returned again, together with the changes since. RuntimeError while
        the last batch is neither written nor restored. Where nothing can be written, always None.
        """
        if self._committer is None:
            return None
        self._in_flight()
        if self._out is not None:
            if self._out.state is not BatchState.FAILED:
                raise RuntimeError("the last batch has not been written yet")
            self.restore(self._out)
        changes = self._changes
        removals = len(changes.removes) + len(changes.founds)
        if changes.urgent or removals >= MAX_WAITING_REMOVALS or (force and changes):
            self._changes = Changes()
            self._buffered = 0
            self._out = Batch(changes)
        elif changes.has_partials:
            self._out = Batch(changes.partials())
        return self._out

    def restore(self, batch: object) -> None:
        """Put a batch that was not written back at the front of the buffer.

        On the thread of the store's owner. Needed only if `write` was never called for it: after a failed write, `take`
        does it.
        """
        out = self._checked(batch)
        if out.state not in (BatchState.TAKEN, BatchState.FAILED):
            raise RuntimeError(f"a batch that is {out.state.value} cannot be restored")
        self._changes = out.changes.followed_by(self._changes)
        self._buffered = self._changes.bytes
        self._out = None

    def roll_back(self) -> None:
        """Forget what has changed since the last `take`; what that returned stays, however far it has come.

        Reads the stored data again, as `open` does; raises `StoreError` if they cannot be read.
        """
        # Before reading the disk: what is written meanwhile is the same, in absolute values.
        waiting = self._in_flight()
        # That the data may be older than recorded was known before anything changed.
        self._changes = Changes(aged=self._changes.aged)
        self._buffered = 0
        with explained(self._path, "reading the stored data"):
            self._load(waiting)

    def write(self, batch: object) -> None:
        """Make a batch durable: one transaction. Blocking; on any thread, one call at a time.

        Raises `StoreFullError` on a full disk, `StoreDamagedError` for a damaged database, `StoreError` for other
        trouble. The batch is not lost then. Pass it to `write` again, or leave it to the next `take`.
        """
        with self._writing:
            out = self._checked(batch)
            if out.state not in (BatchState.TAKEN, BatchState.FAILED):
                raise RuntimeError(f"the batch is {out.state.value} already")
            assert self._committer is not None
            out.state = BatchState.WRITING
            try:
                with explained(self._path, "writing"):
                    self._committer.commit(out.changes)
                out.state = BatchState.WRITTEN
                self._failing = False
            finally:
                if out.state is BatchState.WRITING:
                    out.state = BatchState.FAILED
                    self._failing = True
                with suppress(OSError):
                    self._quota.look()

    def _checked(self, batch: object) -> Batch:
        out = self._out
        if out is None or batch is not out:
            raise RuntimeError("not the batch that was taken last")
        return out

    # -- closing -------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Write buffered changes and release the files, also if writing fails. Waits for a write in flight."""
        if self._closed:
            return
        clean = False
        try:
            with self._writing:
                self._in_flight()
            if self._out is not None:
                self.restore(self._out)
            batch = self.take(force=True)
            if batch is not None:
                self.write(batch)
            clean = True
        finally:
            self._release_files(clean=clean)

    def abandon(self) -> None:
        """Release the files and forget buffered changes, as a crash would. Waits for a write in flight."""
        self._release_files(clean=False)

    def _release_files(self, *, clean: bool) -> None:
        if self._closed:
            return
        self._closed = True
        with self._writing:
            # The writer last: the last one to close cleans up the write-ahead log, which the reader may not.
            self._source.rows.close()
            if self._committer is None:
                self._source.payloads.close()
            else:
                self._committer.close(clean=clean)
        self._lock.release()

    def __enter__(self) -> SqliteStore:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def _aged(datum: D, at_least: bool, created: float | None) -> D:
    """A datum with what is not on disk yet: that it is `at_least` so old, or that it was `created` then."""
    if created is not None:
        return datum._replace(created=created, at_least=False)
    return datum._replace(at_least=True) if at_least else datum


_NOTHING = Changes()
