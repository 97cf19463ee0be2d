"""The high-water mark of a store, outside its database: how far it had come when the mark was written.

A database whose log was cut off or damaged looks sound: it is an earlier state of itself. Its next number has then
already been assigned, and data that it accepted are gone without a trace. So a small file beside it records how many
numbers have been assigned and how many rows were ever written. It has two slots, written in turn, each with a CRC-32.
It is written after each commit without a sync of its own: the system keeps it however the process ends. After a power
cut it may be old. The mark shows this, because it has the system's boot id.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from .files import make_file

#: A slot has a sector of its own: a torn write to one leaves the other intact.
SLOT_BYTES = 512
MARK_BYTES = 2 * SLOT_BYTES

_MAGIC = b"RASSMARK"
_SLOT = struct.Struct("<8sQIIQQQ16s?")
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_UNKNOWN_BOOT = bytes(16)


class Mark(NamedTuple):
    """How far a store had come."""

    life: int
    epoch: int
    assigned: int
    """Numbers assigned in this epoch."""
    written: int
    """Rows ever written in this life: data, second contents, losses."""
    rows: int
    """The most rows that may be held."""
    clean: bool = False
    """The store was closed in order, and nothing has opened it since."""
    boot: bytes = _UNKNOWN_BOOT
    """The boot id of the system that wrote it, 16 bytes."""

    @property
    def exact(self) -> bool:
        """Whether nothing was committed after it."""
        return self.clean or (self.boot != _UNKNOWN_BOOT and self.boot == boot_id())


class MarkFile:
    """The file, open for writing."""

    def __init__(self, path: Path) -> None:
        """Open or create it. `OSError`."""
        self._file = make_file(path)
        self._boot = boot_id()
        self._turn = max((turn for turn, _ in _slots(os.pread(self._file, MARK_BYTES, 0))), default=0)

    def write(self, mark: Mark) -> None:
        """Overwrite the older slot, without a sync. `OSError`."""
        self._turn += 1
        os.pwrite(self._file, _packed(self._turn, mark._replace(boot=self._boot)), self._turn % 2 * SLOT_BYTES)

    def begin(self, mark: Mark) -> None:
        """Write both slots, and sync: at the start and at the end. `OSError`."""
        if os.fstat(self._file).st_size != MARK_BYTES:
            os.ftruncate(self._file, MARK_BYTES)
        self.write(mark)
        os.fsync(self._file)
        self.write(mark)
        os.fsync(self._file)

    def close(self) -> None:
        """Release the file."""
        os.close(self._file)


def read_mark(path: Path) -> Mark | None:
    """The mark; None: there is none, or not all of it is sound, so that a later one may have been lost. `OSError`."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    slots = _slots(content)
    return max(slots)[1] if len(slots) == 2 and len(content) == MARK_BYTES else None


def make_mark(path: Path, mark: Mark) -> None:
    """Write a new file, durable. `OSError`."""
    file = MarkFile(path)
    try:
        file.begin(mark)
    finally:
        file.close()


def boot_id() -> bytes:
    """The boot id of the running system, 16 bytes; zeros: unknown."""
    try:
        return bytes.fromhex(_BOOT_ID.read_text(encoding="ascii").strip().replace("-", ""))[:16].ljust(16, b"\0")
    except (OSError, ValueError):
        return _UNKNOWN_BOOT


def _packed(turn: int, mark: Mark) -> bytes:
    life, epoch, given, written, rows, clean, boot = mark
    slot = _SLOT.pack(_MAGIC, turn, life, epoch, given, written, rows, boot, clean)
    slot = slot.ljust(SLOT_BYTES - 4, b"\0")
    return slot + crc32(slot).to_bytes(4, "little")


def _slots(content: bytes) -> list[tuple[int, Mark]]:
    """The sound slots, each with its turn."""
    sound = []
    for at in (0, SLOT_BYTES):
        slot = content[at : at + SLOT_BYTES]
        if len(slot) == SLOT_BYTES and crc32(slot[:-4]) == int.from_bytes(slot[-4:], "little"):
            magic, turn, life, epoch, given, written, rows, boot, clean = _SLOT.unpack_from(slot)
            if magic == _MAGIC:
                sound.append((turn, Mark(life, epoch, given, written, rows, clean, boot)))
    return sound
