"""What can go wrong with a database file, distinguished: a full disk, damage, other trouble, and our own bugs."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rass_mav.errors import StoreDamagedError, StoreError, StoreFullError, why

# Caused by a wrong statement or value, so by us: these pass unchanged.
_OUR_BUGS = (
    sqlite3.ProgrammingError, sqlite3.IntegrityError, sqlite3.InterfaceError, sqlite3.NotSupportedError,
    sqlite3.DataError,
)  # fmt: skip
# Python 3.10 does not give the numeric result code, so SQLite's constant messages have to do.
_FULL = "database or disk is full"
_OUTSIDE = (
    "locked", "locking protocol", "disk I/O error", "unable to open database", "readonly database",
    "access permission denied", "large file support", "interrupted", "no such vfs",
)  # fmt: skip


class Unsound(Exception):
    """Something read from a database that we cannot have written. Inside `rass_mav.store` only."""


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Raise errors of the block as a `StoreError` that names the file and what was being done.

    `StoreFullError`: the disk is full. `StoreDamagedError`: the database is not sound.
    Exceptions that only a bug of ours can cause pass unchanged.
    """
    try:
        yield
    except _OUR_BUGS:
        raise
    except UnicodeDecodeError as error:
        raise StoreDamagedError(f"{path}: a text in the database is not UTF-8 (while {doing})") from error
    except (sqlite3.Error, OSError, Unsound) as error:
        raise _kind(error)(f"{path}: {_text(error)} (while {doing})") from error


def is_full(error: Exception) -> bool:
    """Whether an error of SQLite or of a file means that there is no space."""
    return isinstance(error, (sqlite3.Error, OSError)) and _kind(error) is StoreFullError


def _text(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return why(error)
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _kind(error: Exception) -> type[StoreError]:
    if isinstance(error, Unsound):
        return StoreDamagedError
    if isinstance(error, OSError):
        return StoreFullError if error.errno in (errno.ENOSPC, errno.EDQUOT) else StoreError
    text = str(error)
    if text == _FULL:
        return StoreFullError
    if any(sign in text for sign in _OUTSIDE):
        return StoreError
    # Our statements are always the same, and fail for no other reason.
    return StoreDamagedError
