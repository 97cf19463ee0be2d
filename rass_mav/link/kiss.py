"""KISS framing: commands with their data on a serial line (M. Chepponis and P. Karn, "The KISS TNC", 1987).

A frame is FEND, a command, its data with FEND and FESC escaped, FEND. Pure: bytes in, frames out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

FEND, FESC, TFEND, TFESC = 0xC0, 0xDB, 0xDC, 0xDD
_ESCAPED = {TFEND: FEND, TFESC: FESC}


class Command(NamedTuple):
    """A frame."""

    code: int
    """0..255, except FEND."""
    data: bytes


def framed(code: int, data: bytes) -> bytes:
    """A frame as bytes."""
    escaped = data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc")
    return b"%c%c%b%c" % (FEND, code, escaped, FEND)


class Unframer:
    """Finds frames in a stream of bytes. What is between two frames, or is no valid frame, is skipped and counted."""

    def __init__(self, most: int) -> None:
        """`most`: bytes of data in a frame; a longer one is no frame."""
        self.malformed = 0
        """Frames that were too long, or had an invalid escape."""
        self._most = most
        self._inside = bytearray()
        self._in_frame = False

    def flush(self) -> None:
        """The stream begins anew: forget half a frame."""
        self._in_frame = False
        self._inside.clear()

    def feed(self, data: bytes) -> Iterator[Command]:
        """The frames that end in these bytes."""
        *ended, rest = data.split(b"%c" % FEND)
        for piece in ended:
            self._add(piece)
            if self._in_frame and self._inside:
                yield from self._frame(bytes(self._inside))
            # The end of a frame may be the beginning of the next one.
            self._in_frame = True
            self._inside.clear()
        self._add(rest)

    def _add(self, piece: bytes) -> None:
        if not self._in_frame:
            return
        self._inside += piece
        # With all data escaped, and the command.
        if len(self._inside) > 2 * self._most + 1:
            self.malformed += 1
            self._in_frame = False
            self._inside.clear()

    def _frame(self, inside: bytes) -> Iterator[Command]:
        first, *others = inside[1:].split(b"%c" % FESC)
        data = bytearray(first)
        for piece in others:
            if not piece or piece[0] not in _ESCAPED:
                self.malformed += 1
                return
            data.append(_ESCAPED[piece[0]])
            data += piece[1:]
        if len(data) > self._most:
            self.malformed += 1
        else:
            yield Command(inside[0], bytes(data))
