"""Writes a store's database and the file of its large payloads, and maintains its high-water mark."""

from __future__ import annotations

import sqlite3
from contextlib import suppress
from pathlib import Path

from . import schema
from .changes import Changes
from .disk import Disk
from .drafts import connect
from .errors import Unsound, is_full
from .files import MARK, beside
from .log import FRAME_HEAD_BYTES
from .mark import Mark, MarkFile
from .payloads import PayloadWriter

#: When the log has reached this size, bytes, a commit moves it into the database.
CHECKPOINT_BYTES = 4 << 20


class Committer:
    """Makes changes durable, on one thread at a time."""

    def __init__(self, path: Path, *, disk: Disk, busy_timeout: float) -> None:
        """`OSError` and the errors of SQLite. For the options see `SqliteStore.open`."""
        self.connection = connect(path, vfs=disk.vfs, busy_timeout=busy_timeout)
        try:
            self.connection.execute("PRAGMA synchronous = FULL")
            frames = CHECKPOINT_BYTES // (FRAME_HEAD_BYTES + self._page_bytes())
            self.connection.execute(f"PRAGMA wal_autocheckpoint = {frames}")
            self.payloads = PayloadWriter(path, disk)
            try:
                self._file = MarkFile(beside(path, MARK))
            except BaseException:
                self.payloads.close()
                raise
        except BaseException:
            self.connection.close()
            raise
        self.now_ms: int | None = None
        """When what is written next arrived, milliseconds on the node's timeline; None: unknown."""
        self._mark: Mark | None = None
        self._sure = False
        """Whether the last commit succeeded, so that the numbers of rows are right."""
        self._synced = False
        """Whether a commit has made durable all that the database shows."""

    def begin(self, own: schema.OwnNumbers) -> None:
        """Record that the store is in use, and how far it has come. `OSError`, `Unsound` and the errors of SQLite."""
        positions = [
            position for table in ("datum", "apart") for position in schema.read_positions(self.connection, table)
        ]
        try:
            self.payloads.begin(own.life, positions)
        except ValueError as error:
            raise Unsound(str(error)) from error
        self._mark = Mark(own.life, own.epoch, own.assigned, own.written, schema.count_rows(self.connection))
        self._file.begin(self._mark)
        self._sure = True

    def commit(self, changes: Changes) -> None:
        """The large payloads with one fsync, then one transaction with one; and the mark after it. What has not come
        whole follows without any, and makes way if there is no space."""
        if changes:
            try:
                self._commit(changes)
            except (OSError, sqlite3.Error) as error:
                if not is_full(error) or not self.payloads.give_way():
                    raise
                self._commit(changes, tight=True)
        if changes.has_partials:
            self.payloads.keep(changes.pieces, changes.forgotten)

    def _commit(self, changes: Changes, *, tight: bool = False) -> None:
        assert self._mark is not None
        mark = self._mark
        if not self._sure:
            mark = mark._replace(rows=schema.count_rows(self.connection))
        self._sure = False
        rows = self._write_payloads(changes, mark)
        if tight:
            # For the database.
            self.payloads.cut_off()
        rows += self._transact(changes, mark)
        self._mark = Mark(
            mark.life,
            mark.epoch,
            mark.assigned if changes.sequence is None else changes.sequence,
            mark.written + changes.rows,
            mark.rows + rows,
        )
        self._sure = True
        if changes.rows or changes.sequence is not None:
            # A mark that stays behind does no harm alone; only together with damage would it.
            with suppress(OSError):
                self._file.write(self._mark)

    def _write_payloads(self, changes: Changes, mark: Mark) -> int:
        """Returns by how many the number of rows has grown."""
        data, apart = changes.puts.values(), changes.apart.values()
        try:
            self.payloads.write(data, apart)
            return 0
        except OSError as error:
            relief = changes.relief()
            if not is_full(error) or not relief.removes:
                raise
        # The space of what goes can be used as soon as that is durable. To apply changes twice does no harm.
        rows = self._transact(relief, mark)
        self.payloads.write(data, apart)
        return rows

    def _page_bytes(self) -> int:
        return int(self.connection.execute("PRAGMA page_size").fetchall()[0][0])

    def _transact(self, changes: Changes, mark: Mark) -> int:
        """Returns by how many the number of rows has grown."""
        own = {} if changes.sequence is None else {schema.NEXT_SEQUENCE: changes.sequence}
        if changes.rows:
            own[schema.WRITTEN] = mark.written + changes.rows
        writer, payloads = self.connection, self.payloads
        before = writer.total_changes
        positions = {key: payloads.position(datum) for key, datum in changes.puts.items()}
        writer.execute("BEGIN IMMEDIATE")
        try:
            for statement in schema.MARK_AT_LEAST if changes.aged else ():
                writer.execute(statement)
            removes = () if payloads.empty else changes.removes
            gone = [position for id in removes if (position := schema.read_position(writer, id)) is not None]
            rows = -writer.executemany(schema.DELETE_DATUM, changes.removes).rowcount
            puts = changes.puts.values()
            schema.insert_data(writer, (schema.datum_row(datum, positions[datum.id]) for datum in puts), self.now_ms)
            rows += len(changes.puts)
            kept = {sector for sector in positions.values() if sector is not None}
            writer.executemany(schema.AMEND_DATUM, [(at, *id) for id, at in changes.amends.items()])
            for datum in changes.apart.values():
                sector = payloads.position(datum, apart=True)
                inserted = writer.execute(schema.INSERT_APART, schema.datum_row(datum, sector)).rowcount
                rows += inserted
                if inserted and sector is not None:
                    kept.add(sector)
            rows -= writer.executemany(schema.DELETE_LOSS, changes.founds).rowcount
            losses = [schema.loss_row(id, *loss) for id, loss in changes.losses.items()]
            rows += writer.executemany(schema.INSERT_LOSS, losses).rowcount
            schema.write_numbers(writer, "counter", changes.counters)
            schema.write_numbers(writer, "meta", {**changes.meta, **own})
            writer.execute("COMMIT")
        except BaseException:
            # On some errors SQLite has already rolled back.
            if writer.in_transaction:
                writer.execute("ROLLBACK")
            raise
        payloads.settle(kept, gone)
        if writer.total_changes > before:
            # Otherwise nothing was synced, and the last commit of the life before might still be lost.
            self._synced = True
            with suppress(OSError):
                payloads.recycle()
        return rows

    def close(self, *, clean: bool) -> None:
        """Release the files. `clean`: everything has been written."""
        self.connection.close()
        if clean and self._synced:
            with suppress(OSError):
                self.payloads.recycle(trim_bytes=0)
        self.payloads.close()
        if clean and self._sure and self._mark is not None:
            with suppress(OSError):
                self._file.begin(self._mark._replace(clean=True))
        self._file.close()
