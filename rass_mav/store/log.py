"""The write-ahead log as it is on disk (sqlite.org/fileformat2.html, section 4), read without SQLite.

SQLite uses the log up to the first frame that does not match, and reports nothing about what follows. After a torn last
write there is nothing, or frames of an earlier log, with other salts. Frames there with the present salts were written,
and perhaps committed, but SQLite no longer sees them.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

_HEADER = 32
_FRAME = struct.Struct(">6I")
_SUMS = struct.Struct(">2I")
_MAGIC = 0x377F0682
_MASK = 0xFFFFFFFF

#: What a frame has before its page, bytes.
FRAME_HEAD_BYTES = _FRAME.size


class LogFrame(NamedTuple):
    """One page of the database, as a transaction left it."""

    page: int
    """Its number, from 1."""
    at: int
    """Where its bytes begin in the file."""
    sound: bool
    """Whether they match the checksums of this frame and the one before it."""


class Log(NamedTuple):
    """The content of a log."""

    intact: bool
    """Whether all that was ever committed to it can be read, as far as that can be determined."""
    frames: list[LogFrame]
    """All frames with the present salts, in the order of writing."""
    committed: int
    """How many of them, from the first, SQLite uses."""


class _Head(NamedTuple):
    """What the head of a log says."""

    page_bytes: int
    order: str
    """Of the bytes in a word of the checksums."""
    salts: list[int]
    sums: tuple[int, int]


def log_page_bytes(path: Path) -> int | None:
    """The page size that the head of a log names; None: there is none, or it is damaged. `OSError`."""
    if not path.exists():
        return None
    with path.open("rb") as file:
        head = _sound_head(file.read(_HEADER))
    return None if head is None else head.page_bytes


def read_log(path: Path, page_bytes: int | None = None) -> Log:
    """Read a log; one that is missing or empty is intact. `page_bytes`: the page size if the head of the log is
    damaged; None: then nothing of it can be read. `OSError`."""
    if not path.exists() or not path.stat().st_size:
        return Log(True, [], 0)
    with path.open("rb") as file:
        header = file.read(_HEADER)
        head = sound = _sound_head(header)
        if head is None:
            if len(header) < _HEADER or page_bytes is None:
                return Log(False, [], 0)
            # What follows can still be read if it is in the form in which we write it.
            head = _Head(page_bytes, "<", _repeated_salts(file, page_bytes), _SUMS.unpack(header[24:]))
        frames: list[LogFrame] = []
        committed = broken = behind = 0
        before = head.sums
        at = _HEADER
        file.seek(at)
        while len(frame := file.read(FRAME_HEAD_BYTES + head.page_bytes)) == FRAME_HEAD_BYTES + head.page_bytes:
            page, size, *salts, sum1, sum2 = _FRAME.unpack_from(frame)
            if salts == head.salts and page:
                sums = _checksum(head.order, frame[FRAME_HEAD_BYTES:], *_checksum(head.order, frame[:8], *before))
                matches = sums == (sum1, sum2)
                frames.append(LogFrame(page, at + FRAME_HEAD_BYTES, matches))
                behind += bool(broken)
                broken += not matches
                if matches and not broken and size:
                    committed = len(frames)
            else:
                broken += 1
            before = (sum1, sum2)
            at += len(frame)
    return Log(sound is not None and not behind, frames, committed if sound is not None else 0)


def is_page_size(size: int) -> bool:
    """Whether SQLite has pages of `size` bytes."""
    return 512 <= size <= 65536 and size & (size - 1) == 0


def _sound_head(header: bytes) -> _Head | None:
    if len(header) < _HEADER:
        return None
    magic, _, page_bytes, _, *salts, sum1, sum2 = struct.unpack(">8I", header)
    order = ">" if magic & 1 else "<"
    if magic & ~1 != _MAGIC or not is_page_size(page_bytes) or _checksum(order, header[:24], 0, 0) != (sum1, sum2):
        return None
    return _Head(page_bytes, order, salts, (sum1, sum2))


def _repeated_salts(file: BinaryIO, page_bytes: int) -> list[int]:
    """The first salts that two frames in a row have, because the first frame may be damaged too; otherwise those of the
    last frame."""
    before: list[int] = []
    while len(header := file.read(FRAME_HEAD_BYTES)) == FRAME_HEAD_BYTES:
        page, _, *salts, _, _ = _FRAME.unpack(header)
        if page and salts == before:
            break
        before = salts
        file.seek(page_bytes, os.SEEK_CUR)
    return before


def _checksum(order: str, data: bytes, sum1: int, sum2: int) -> tuple[int, int]:
    for word1, word2 in struct.iter_unpack(order + "II", data):
        sum1 = (sum1 + word1 + sum2) & _MASK
        sum2 = (sum2 + word2 + sum1) & _MASK
    return sum1, sum2
