"""The SQLite library that Python's `sqlite3` uses, and its tables of functions for files (sqlite.org/vfs.html)."""

from __future__ import annotations

import _sqlite3
import ctypes
import sqlite3
from ctypes import CFUNCTYPE, POINTER, c_char_p, c_int, c_int64, c_void_p

from rass_mav.errors import StoreError

OK = 0
FULL = 13
CANTOPEN = 14
IOERR_READ = 10 | 1 << 8
IOERR_WRITE = 10 | 3 << 8
IOERR_FSYNC = 10 | 4 << 8
IOERR_TRUNCATE = 10 | 6 << 8
IOERR_DELETE = 10 | 10 << 8
OPEN_READONLY = 1
OPEN_READWRITE = 2
OPEN_CREATE = 4


Close = CFUNCTYPE(c_int, c_void_p)
Transfer = CFUNCTYPE(c_int, c_void_p, c_void_p, c_int, c_int64)
Truncate = CFUNCTYPE(c_int, c_void_p, c_int64)
Sync = CFUNCTYPE(c_int, c_void_p, c_int)
Open = CFUNCTYPE(c_int, c_void_p, c_void_p, c_void_p, c_int, c_void_p)
Delete = CFUNCTYPE(c_int, c_void_p, c_char_p, c_int)
Randomness = CFUNCTYPE(c_int, c_void_p, c_int, c_void_p)


class Methods(ctypes.Structure):
    """`sqlite3_io_methods`: the operations on an open file. Those that are never replaced have no types."""

    _fields_ = (
        ("version", c_int),
        ("close", Close),
        ("read", Transfer),
        ("write", Transfer),
        ("truncate", Truncate),
        ("sync", Sync),
        # Size, locks, controls and characteristics; shared memory; mapped memory.
        ("others", c_void_p * 13),
    )


class Vfs(ctypes.Structure):
    """`sqlite3_vfs`: how files are opened and deleted, and the source of randomness."""

    _fields_ = (
        ("version", c_int),
        ("size_of_file", c_int),
        ("longest_path", c_int),
        ("next", c_void_p),
        ("name", c_char_p),
        ("data", c_void_p),
        ("open", Open),
        ("delete", Delete),
        # Access, full path, dynamic libraries.
        ("paths", c_void_p * 6),
        ("randomness", Randomness),
        # Sleep, time, the last error; system calls.
        ("others", c_void_p * 7),
    )


def load(module: str | None = getattr(_sqlite3, "__file__", None)) -> ctypes.CDLL:
    """The library that the extension `module` is linked with; None: the one that is built into the interpreter.

    Raises `StoreError` if it cannot be reached, or is not the one that `sqlite3` uses.
    """
    try:
        # A name is also looked up in what the module is linked with.
        library = ctypes.CDLL(module)
        library.sqlite3_vfs_find.restype = POINTER(Vfs)
        library.sqlite3_vfs_find.argtypes = (c_char_p,)
        library.sqlite3_vfs_register.argtypes = (POINTER(Vfs), c_int)
        library.sqlite3_vfs_unregister.argtypes = (POINTER(Vfs),)
        library.sqlite3_randomness.argtypes = (c_int, c_char_p)
        probe = Vfs.from_buffer_copy(library.sqlite3_vfs_find(None).contents)
    except (OSError, AttributeError, ValueError) as error:
        raise StoreError(f"no simulated disk: the library of sqlite3 cannot be reached ({error})") from error
    probe.name = b"probe"
    library.sqlite3_vfs_register(probe, 0)
    try:
        sqlite3.connect("file::memory:?vfs=probe", uri=True).close()
    except sqlite3.OperationalError as error:
        raise StoreError("no simulated disk: the library found is not the one that sqlite3 uses") from error
    finally:
        library.sqlite3_vfs_unregister(probe)
    return library
