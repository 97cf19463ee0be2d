"""Creating a store, empty or from the content of a damaged one: it is there completely, or not at all.

It is created under the name `node.db.new`. If it replaces another store, it is renamed to `node.db.ready-damaged-1` as
soon as it is complete; then the old files are set aside as `node.db.damaged-1`, and it gets its name. Whatever ends the
program in between, the next start continues from there.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from .files import LOG_ENDINGS, MARK, PARTIALS, PAYLOADS, beside, make_file, sync_directory
from .mark import Mark, make_mark
from .schema import PAGE_BYTES, count_rows, create_tables, read_numbers, read_own

_READY = ".ready-"


def draw(draw_number: Callable[[], int], *taken: int) -> int:
    """A number of 32 bits that is none of `taken`."""
    number = draw_number()
    if not 0 <= number < 1 << 32:
        raise ValueError(f"an epoch has 32 bits, got {number}")
    while number in taken:
        number = (number + 1) % (1 << 32)
    return number


def connect(
    path: Path, mode: Literal["ro", "rw", "rwc"] = "rw", *, vfs: str | None = None, busy_timeout: float = 5.0,
    immutable: bool = False,
) -> sqlite3.Connection:  # fmt: skip
    """A connection to a database, in which the caller begins transactions.

    Any thread may use it, one at a time. `mode`: "ro" does not change the database, not even by moving the log into it
    when the connection is closed; "rwc" creates one if there is none. `immutable`: no process changes the file, and
    there is no log.
    """
    options = f"mode={mode}"
    if vfs is not None:
        options += f"&vfs={vfs}"
    if immutable:
        options += "&immutable=1"
    name = f"{path.absolute().as_uri()}?{options}"
    return sqlite3.connect(name, uri=True, isolation_level=None, check_same_thread=False, timeout=busy_timeout)


@contextmanager
def drafted(
    path: Path, life: int, epoch: int, vfs: str | None, aside: Path | None = None
) -> Iterator[sqlite3.Connection]:
    """Create a store of this life and epoch. The block fills it; at the end of the block it gets its place.

    `aside`: where the present file is moved, a name of `path` with an ending; None: there is none.
    """
    draft = beside(path, ".new")
    _discard(draft)
    try:
        os.close(make_file(draft))
        connection = connect(draft, "rwc", vfs=vfs)
        try:
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
            create_tables(connection, life, epoch)
            connection.execute("BEGIN")
            yield connection
            own = read_own(read_numbers(connection, "meta"))
            mark = Mark(own.life, own.epoch, own.assigned, own.written, count_rows(connection), clean=True)
            connection.execute("COMMIT")
            # Last: closing does not report if moving a log into the database fails. Fetched to the end, where the
            # change is committed; if the mode is not available, the answer is the old one.
            if connection.execute("PRAGMA journal_mode = WAL").fetchall() != [("wal",)]:
                raise OSError(errno.ENOTSUP, "no write-ahead mode here")
        finally:
            connection.close()
        make_mark(beside(draft, MARK), mark)
    except BaseException:
        # An incomplete store would only take up space.
        with suppress(OSError):
            _discard(draft)
        raise
    if aside is None:
        _rename_whole(draft, path)
    else:
        ready = beside(path, _READY + aside.name[len(path.name) + 1 :])
        _rename_whole(draft, ready)
        _take_place(path, ready)
    sync_directory(path)


def finish(path: Path) -> Path | None:
    """Continue if a program ended while a store replaced another. Returns where the other one is."""
    for ready in sorted(path.parent.glob(f"{_literal(path.name)}{_READY}*")):
        if not ready.name.endswith((MARK, *LOG_ENDINGS)):
            _take_place(path, ready)
            sync_directory(path)
            return beside(path, "." + ready.name[len(path.name + _READY) :])
    return None


def free_name(path: Path) -> Path:
    """An unused name for a damaged file that is set aside."""
    number = 1
    endings = ("", MARK, PAYLOADS, PARTIALS, *LOG_ENDINGS)
    while any(beside(path, f".damaged-{number}{ending}").exists() for ending in endings):
        number += 1
    return beside(path, f".damaged-{number}")


def _discard(draft: Path) -> None:
    for ending in ("", "-journal", MARK, *LOG_ENDINGS):
        beside(draft, ending).unlink(missing_ok=True)


def _rename_whole(old: Path, new: Path) -> None:
    # The mark first: one without its database shows by its zeros that nothing is missing.
    beside(old, MARK).rename(beside(new, MARK))
    old.rename(new)


def _take_place(path: Path, ready: Path) -> None:
    aside = beside(path, "." + ready.name[len(path.name + _READY) :])
    # The mark of the old store is moved only while that of the new one waits.
    # The new one has no payloads beside it yet.
    endings = ("", *LOG_ENDINGS, PAYLOADS, PARTIALS, *((MARK,) if beside(ready, MARK).exists() else ()))
    for ending in endings:
        if beside(path, ending).exists():
            beside(path, ending).rename(beside(aside, ending))
    if beside(ready, MARK).exists():
        beside(ready, MARK).rename(beside(path, MARK))
    ready.rename(path)


def _literal(name: str) -> str:
    return "".join(f"[{sign}]" if sign in "*?[" else sign for sign in name)
