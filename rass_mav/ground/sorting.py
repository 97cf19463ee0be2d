"""Pieces of text in another order than the one in which they come, in memory that does not grow with them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from rass_mav.store.errors import explained

Key = int | float | str


class Sorter:
    """A temporary database on disk, which SQLite sorts there."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        db.execute("PRAGMA journal_mode = OFF")
        db.execute("CREATE TABLE line (a, b, c, text TEXT)")
        db.execute("BEGIN")

    def add(self, a: Key, b: Key, c: Key, text: str) -> None:
        """Keep a text, sorted by a, then by b and c, then in the order in which they came."""
        self._db.execute("INSERT INTO line VALUES (?, ?, ?, ?)", (a, b, c, text))

    def sorted(self) -> Iterator[tuple[Key, Key, Key, str]]:
        """All of them in order: a, b, c and the text."""
        return self._db.execute("SELECT a, b, c, text FROM line ORDER BY a, b, c, rowid")


@contextmanager
def sorting(out: Path) -> Iterator[Sorter]:
    """A sorter for what is written to a file or folder. Raises `StoreError`: it cannot be kept on disk."""
    # Without a name it is a temporary file, which SQLite deletes whatever happens.
    with (
        explained(Path(out.name), "sorting the measurements"),
        closing(sqlite3.connect("", isolation_level=None)) as db,
    ):
        yield Sorter(db)
