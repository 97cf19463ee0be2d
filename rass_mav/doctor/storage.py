"""The store: can it be written, is there space, is it sound?"""

from __future__ import annotations

import os
from pathlib import Path

from rass_mav.core.datum import MAX_PAYLOAD
from rass_mav.errors import StoreDamagedError, StoreError
from rass_mav.store.reader import SqliteReader

from .finding import Finding, failed, passed, warned

_MIB = 1 << 20
#: With less free space the store is useless: a few of the largest data, and the log that is written first.
LEAST_BYTES = 4 * MAX_PAYLOAD
#: With less free space a person should free some.
LOW_BYTES = 64 * _MIB


def free_bytes(folder: Path) -> int:
    """The bytes that a user can still write there. Raises OSError."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def store(path: Path, free: int | None = None) -> Finding:
    """Check the store's file and folder. `free`: free bytes on the disk; None: ask the disk."""
    folder = path.absolute().parent
    effective = os.access in os.supports_effective_ids
    try:
        exists = folder.is_dir()
    except PermissionError:
        return failed(
            "store", f"{folder}: no permission to read it", "run this as the node's user, or change store.path"
        )
    if not exists:
        return failed("store", f"{folder}: no such folder", "create it, or change store.path")
    if not os.access(folder, os.W_OK | os.X_OK, effective_ids=effective):
        return failed("store", f"{folder}: no permission to write", "give it to the node's user, or change store.path")
    if path.exists():
        if not os.access(path, os.R_OK | os.W_OK, effective_ids=effective):
            return failed("store", f"{path}: no permission to write", "give it to the node's user (chown)")
        try:
            with SqliteReader(path) as reader:
                held = f"{len(reader.ids())} data"
        except StoreDamagedError as error:
            return warned("store", str(error), "the node will set it aside and salvage what it can; copy it first")
        except StoreError as error:
            return warned("store", str(error), "start the node; its log shows more")
    else:
        held = "not created yet"
    free = free_bytes(folder) if free is None else free
    room = f"{free / _MIB:.0f} MiB free"
    if free < LEAST_BYTES:
        return failed("store", f"{path}: {room}", "free space on the disk")
    if free < LOW_BYTES:
        return warned("store", f"{path}: {room}", "free space on the disk")
    aside = sorted(file for file in folder.glob(f"{path.name}.damaged-[0-9]*") if file.name[-1].isdigit())
    if aside:
        return warned(
            "store", f"{path}: {held}, {room}; {aside[-1].name} was set aside as damaged",
            "check the card or disk; delete the file when its data are not needed",
        )  # fmt: skip
    return passed("store", f"{path}: {held}, {room}")
