"""The write-ahead log as it is on disk (sqlite.org/fileformat2.html, section 4), read without SQLite.

SQLite uses the log up to the first frame that does not match, and reports nothing about what follows. After a torn last
write there is nothing, or frames of an earlier log, with other salts. Frames there with the present salts were written,
and perhaps committed, but SQLite no longer sees them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_HEADER = 32
_FRAME = struct.Struct(">6I")
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
    page_bytes: int | None = None
    """The page size; None: there is no log, or its head is damaged, and nothing of it can be read."""
    frames: Sequence[LogFrame] = ()
    """All frames with the present salts, in the order of writing."""
    committed: int = 0
    """How many of them, from the first, SQLite uses."""


def read_log(path: Path) -> Log:
    """Read a log; one that is missing or empty is intact. `OSError`."""
    if not path.exists() or not path.stat().st_size:
        return Log(True)
    with path.open("rb") as file:
        header = file.read(_HEADER)
        if len(header) < _HEADER:
            return Log(False)
        magic, _, page_bytes, _, *salts, sum1, sum2 = struct.unpack(">8I", header)
        order = ">" if magic & 1 else "<"
        if magic & ~1 != _MAGIC or not is_page_size(page_bytes) or _checksum(order, header[:24], 0, 0) != (sum1, sum2):
            return Log(False)
        frames: list[LogFrame] = []
        committed = broken = behind = 0
        before = sum1, sum2
        at = _HEADER
        while len(frame := file.read(FRAME_HEAD_BYTES + page_bytes)) == FRAME_HEAD_BYTES + page_bytes:
            page, size, salt1, salt2, *found = _FRAME.unpack_from(frame)
            if [salt1, salt2] == salts and page:
                sums = _checksum(order, frame[FRAME_HEAD_BYTES:], *_checksum(order, frame[:8], *before))
                matches = [*sums] == found
                frames.append(LogFrame(page, at + FRAME_HEAD_BYTES, matches))
                behind += bool(broken)
                broken += not matches
                if matches and not broken and size:
                    committed = len(frames)
            else:
                broken += 1
            before = found[0], found[1]
            at += len(frame)
    return Log(not behind, page_bytes, frames, committed)


def is_page_size(size: int) -> bool:
    """Whether SQLite has pages of `size` bytes."""
    return 512 <= size <= 65536 and size & (size - 1) == 0


def _checksum(order: str, data: bytes, sum1: int, sum2: int) -> tuple[int, int]:
    for word1, word2 in struct.iter_unpack(order + "II", data):
        sum1 = (sum1 + word1 + sum2) & _MASK
        sum2 = (sum2 + word2 + sum1) & _MASK
    return sum1, sum2
