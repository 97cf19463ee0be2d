"""The write-ahead log as it is on disk (sqlite.org/fileformat2.html, section 4), read without SQLite.

SQLite uses the log up to the first frame that does not match, and reports nothing about what follows. After a torn last
write there is nothing, or frames of an earlier log, with other salts. Frames there with the present salts were written,
and perhaps committed, but SQLite no longer sees them.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

_HEADER = 32
_FRAME_HEADER = 24
_MAGIC = 0x377F0682
_MASK = 0xFFFFFFFF


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
    page_bytes: int
    """0: unknown."""
    frames: list[LogFrame]
    """All frames with the present salts, in the order of writing."""
    committed: int
    """How many of them, from the first, SQLite uses."""


def read_log(path: Path) -> Log:
    """Read a log; one that is missing or empty is intact. `OSError`."""
    if not path.exists() or not path.stat().st_size:
        return Log(True, 0, [], 0)
    with path.open("rb") as file:
        header = file.read(_HEADER)
        if len(header) < _HEADER:
            return Log(False, 0, [], 0)
        magic, _, page_bytes, _, *salts, sum1, sum2 = struct.unpack(">8I", header)
        order = ">" if magic & 1 else "<"
        valid = (
            magic & ~1 == _MAGIC and _is_page_size(page_bytes) and _checksum(order, header[:24], 0, 0) == (sum1, sum2)
        )
        if not valid:
            # What follows can still be read if it is in the form in which we write it.
            page_bytes, order = 4096, "<"
        frames: list[LogFrame] = []
        committed = broken = behind = 0
        before = (sum1, sum2)
        number = 0
        while len(frame := file.read(_FRAME_HEADER + page_bytes)) == _FRAME_HEADER + page_bytes:
            page, size, *salt, sum1, sum2 = struct.unpack(">6I", frame[:_FRAME_HEADER])
            number += 1
            if not valid and number == 1:
                salts = salt
            if salt == salts and page:
                sums = _checksum(order, frame[_FRAME_HEADER:], *_checksum(order, frame[:8], *before))
                sound = sums == (sum1, sum2)
                frames.append(LogFrame(page, _HEADER + (number - 1) * len(frame) + _FRAME_HEADER, sound))
                behind += bool(broken)
                broken += not sound
                if sound and not broken and size:
                    committed = len(frames)
            else:
                broken += 1
            before = (sum1, sum2)
    return Log(valid and not behind, page_bytes, frames, committed if valid else 0)


def _is_page_size(size: int) -> bool:
    return 512 <= size <= 65536 and size & (size - 1) == 0


def _checksum(order: str, data: bytes, sum1: int, sum2: int) -> tuple[int, int]:
    for word1, word2 in struct.iter_unpack(order + "II", data):
        sum1 = (sum1 + word1 + sum2) & _MASK
        sum2 = (sum2 + word2 + sum1) & _MASK
    return sum1, sum2
