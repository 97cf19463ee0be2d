"""Writes a store's database, and maintains its high-water mark."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from . import schema
from .changes import Changes
from .drafts import connect
from .files import MARK, beside
from .mark import Mark, MarkFile


class Committer:
    """Makes changes durable, on one thread at a time."""

    def __init__(self, path: Path, *, vfs: str | None, busy_timeout: float, file_limit: int | None) -> None:
        """`OSError` and the errors of SQLite. For the options see `SqliteStore.open`."""
        self.connection = connect(path, vfs=vfs, busy_timeout=busy_timeout)
        try:
            self.connection.execute("PRAGMA synchronous = FULL")
            if file_limit is not None:
                page = self.connection.execute("PRAGMA page_size").fetchall()[0][0]
                self.connection.execute(f"PRAGMA max_page_count = {max(file_limit // page, 1)}")
            self._file = MarkFile(beside(path, MARK))
        except BaseException:
            self.connection.close()
            raise
        self.now_ms: int | None = None
        """When what is written next arrived, milliseconds on the node's timeline; None: unknown."""
        self._mark: Mark | None = None
        self._sure = False
        """Whether the last commit succeeded, so that the numbers of rows are right."""

    def begin(self, own: schema.OwnNumbers) -> None:
        """Record that the store is in use, and how far it has come. `OSError` and the errors of SQLite."""
        self._mark = Mark(own.life, own.epoch, own.given, own.written, schema.count_rows(self.connection))
        self._file.begin(self._mark)
        self._sure = True

    def commit(self, changes: Changes) -> None:
        """One transaction, one fsync; and the mark after it."""
        assert self._mark is not None
        mark = self._mark
        if not self._sure:
            mark = mark._replace(rows=schema.count_rows(self.connection))
        self._sure = False
        rows = self._transact(changes, mark)
        self._mark = Mark(
            mark.life,
            mark.epoch,
            mark.given if changes.sequence is None else changes.sequence,
            mark.written + changes.rows,
            mark.rows + rows,
        )
        self._sure = True
        if changes.rows or changes.sequence is not None:
            # A mark that stays behind does no harm alone; only together with damage would it.
            with suppress(OSError):
                self._file.write(self._mark)

    def _transact(self, changes: Changes, mark: Mark) -> int:
        """Returns by how many the number of rows has grown."""
        own = {} if changes.sequence is None else {schema.NEXT_SEQUENCE: changes.sequence}
        if changes.rows:
            own[schema.WRITTEN] = mark.written + changes.rows
        writer = self.connection
        writer.execute("BEGIN IMMEDIATE")
        try:
            for statement in schema.MARK_AT_LEAST if changes.aged else ():
                writer.execute(statement)
            rows = -writer.executemany(schema.DELETE_DATUM, changes.removes).rowcount
            schema.insert_data(writer, changes.puts.values(), self.now_ms)
            rows += len(changes.puts)
            writer.executemany(schema.AMEND_DATUM, [(at, *id) for id, at in changes.amends.items()])
            rows += writer.executemany(schema.INSERT_APART, map(schema.datum_row, changes.apart.values())).rowcount
            rows -= writer.executemany(schema.DELETE_LOSS, changes.founds).rowcount
            losses = [schema.loss_row(id, fate) for id, fate in changes.losses.items()]
            rows += writer.executemany(schema.INSERT_LOSS, losses).rowcount
            schema.write_numbers(writer, "counter", changes.counters)
            schema.write_numbers(writer, "meta", {**changes.meta, **own})
            writer.execute("COMMIT")
        except BaseException:
            # On some errors SQLite has already rolled back.
            if writer.in_transaction:
                writer.execute("ROLLBACK")
            raise
        return rows

    def close(self, *, clean: bool) -> None:
        """Release the files. `clean`: everything has been written."""
        self.connection.close()
        if clean and self._sure and self._mark is not None:
            with suppress(OSError):
                self._file.begin(self._mark._replace(clean=True))
        self._file.close()
