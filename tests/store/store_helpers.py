"""What the tests of the stores share."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable
from contextlib import closing
from itertools import count
from pathlib import Path

from rass_mav.core.datum import Datum, DatumId, make_datum
from rass_mav.core.store import Store
from rass_mav.store.sqlite import SqliteStore

EPOCH = 0xFEDC0001
ROOT = Path(__file__).resolve().parents[2]


def epochs(first: int = EPOCH) -> Callable[[], int]:
    """Draws a new epoch at each call."""
    return count(first).__next__


def datum(sequence: int, size: int = 50, *, origin: int = 7, epoch: int = EPOCH, created: float = 1.5) -> Datum:
    """A datum whose payload can be told from its sequence number."""
    return make_datum(DatumId(origin, epoch, sequence), 1, created, payload(sequence, size))


def payload(sequence: int, size: int) -> bytes:
    """`size` bytes that no other sequence number has."""
    return hashlib.shake_128(sequence.to_bytes(8, "little")).digest(size)


def open_store(path: Path, **options: object) -> SqliteStore:
    """Open a store on disk that draws its epochs from `epochs`."""
    options.setdefault("draw_epoch", epochs())
    options.setdefault("node_id", 7)
    return SqliteStore.open(path, **options)  # type: ignore[arg-type]


def commit(store: Store, *, force: bool = True) -> bool:
    """Make the changes durable, as a driver does. Tells whether there was something to write."""
    batch = store.take(force=force)
    if batch is None:
        return False
    store.write(batch)
    return True


def page_bytes(path: Path) -> int:
    """The page size of a store's database."""
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA page_size").fetchone()[0])


def give_pages(path: Path, size: int) -> None:
    """Give the database of a closed store pages of this size, bytes, as another version would have created it."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
        connection.execute(f"PRAGMA page_size = {size}")
        connection.execute("VACUUM")
        connection.execute("PRAGMA journal_mode = WAL").fetchall()
