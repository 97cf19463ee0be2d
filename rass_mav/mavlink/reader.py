"""Finds MAVLink frames, version 1 and 2, in any bytes.

Nothing is trusted before its checksum is verified. If a magic byte turns out not to start a frame (a false start), the
search continues one byte after it, so garbage never hides a genuine frame.

A frame whose message id is not in the dialect cannot be checked, because its CRC_EXTRA is unknown. It is counted once
and not returned. Its length is not trusted either: the search continues one byte after its start, but false starts
within the length it claims are not counted again. The price is small: if the bytes inside it are a whole frame with a
good checksum, they are returned as a frame.

Work is linear in the number of bytes: each byte starts at most one candidate, and a candidate is checked at most once,
over at most 280 bytes. Between two feeds at most 279 bytes are kept: a frame whose end has not arrived.

In a stream no genuine frame is lost, whatever comes before it; the caller limits the bytes per call. A datagram starts
with a frame. So a datagram with too many false starts is noise or an attack, and its rest is not searched.
"""

from __future__ import annotations

import re
import struct

from .crc import crc16
from .dialect import FORMATS
from .frames import FLAG_SIGNED, MAGIC_V2, Frame
from .signing import SIGNATURE_SIZE, SignatureCheck

#: The longest frame: header 10, payload 255, checksum 2, signature 13.
MAX_FRAME = 280
#: False starts allowed in one datagram, including unknown messages, before its rest counts as garbage. A whole datagram
#: of messages from a newer dialect has a dozen by chance.
MAX_FALSE_STARTS = 32

# Magic, payload length, incompatibility flags, sequence, system, component, message id.
_HEAD = struct.Struct("<BBBxBBBHB").unpack_from
_MAGIC = re.compile(rb"[\xfd\xfe]")
_HEADER_V1 = 6
_HEADER_V2 = 10
# Size of a version 2 frame without its payload, in bytes: unsigned, signed.
_AROUND = (_HEADER_V2 + 2, _HEADER_V2 + 2 + SIGNATURE_SIZE)


class FrameReader:
    """Reads the frames of one stream, or of the datagrams of one link. Never raises, whatever the bytes."""

    __slots__ = (
        "_buffer", "_needed", "_unknown_left", "check", "frames", "garbage_bytes", "malformed", "pending", "unknown",
    )  # fmt: skip

    def __init__(self, check: SignatureCheck | None = None) -> None:
        """:param check: counts and refuses frames that are not signed rightly; None: signatures are not checked."""
        self.check = check
        # A candidate whose end has not arrived. It starts with a magic byte. `_needed`: its length, as far as known.
        self._buffer = b""
        self.pending = 0
        """Bytes that wait for the end of their frame, 0..279."""
        self._needed = 0
        # How many bytes at the start of the buffer a frame with an unknown id claims.
        self._unknown_left = 0
        self.frames = 0
        """Frames returned."""
        self.malformed = 0
        """False starts: a wrong checksum, unknown flags, or (at `flush`) no end."""
        self.garbage_bytes = 0
        """Bytes that belong to no frame, including those of false starts."""
        self.unknown = 0
        """Frames (or false starts) with a message id that is not in the dialect."""

    def feed(self, data: bytes) -> list[Frame]:
        """Take the bytes that have arrived, and return the frames that are now whole, in order.

        :param data: bytes (not a bytearray: parts of it may be kept).
        """
        if self._buffer:
            data = self._buffer + data
            if len(data) < self._needed:
                self._buffer = data
                self.pending = len(data)
                return []
        return self._scan(data)

    def datagram(self, data: bytes) -> list[Frame]:
        """The frames of a datagram. An incomplete frame at its end is garbage, and so is everything after
        `MAX_FALSE_STARTS` false starts. Nothing is kept. Do not use it on a reader that is fed a stream.
        """
        if len(data) >= _AROUND[0]:
            # A short cut for the usual datagram, exactly one whole frame. `_scan` would find the same.
            magic, length, flags, sequence, system_id, component_id, low, high = _HEAD(data)
            message_id = low | high << 16
            layout = FORMATS.get(message_id)
            if (
                layout is not None
                and magic == MAGIC_V2
                and flags <= FLAG_SIGNED
                and len(data) == _AROUND[flags] + length
            ):
                if self.check is not None or flags:
                    frame, good = self._check(data, message_id, layout.crc_extra)
                    if good:
                        return [] if frame is None else [frame]
                elif crc16(data[1:-2] + layout.crc_extra).to_bytes(2, "little") == data[-2:]:
                    self.frames += 1
                    payload = data[_HEADER_V2:-2]
                    # What `Frame(...)` does, in less time: most bytes that come in are such frames.
                    return [
                        tuple.__new__(Frame, (message_id, sequence, system_id, component_id, payload, False, 0, 0, 2))
                    ]
        frames = self._scan(data, final=True, most=MAX_FALSE_STARTS)
        self._unknown_left = 0
        return frames

    def flush(self) -> list[Frame]:
        """Stop waiting for the end of a frame, and return the frames found after its start.

        Call it at the end of a file, or when a port was lost.
        """
        frames = self._scan(self._buffer, final=True)
        self._unknown_left = 0
        return frames

    def _scan(self, data: bytes, *, final: bool = False, most: int | None = None) -> list[Frame]:
        """`final`: no more bytes will come. `most`: how many false starts are allowed; None: any number."""
        frames: list[Frame] = []
        position = 0
        size = len(data)
        self._needed = 0
        claimed = self._unknown_left  # bytes up to here belong to a frame with an unknown id
        left = size + 1 if most is None else most
        while True:
            found = _MAGIC.search(data, position)
            start = found.start() if found else size
            self.garbage_bytes += max(0, start - max(position, claimed))
            position = start
            if found is None:
                break
            if not left:
                self.garbage_bytes += size - max(start, min(claimed, size))
                position = size
                break
            header = _HEADER_V2 if data[start] == MAGIC_V2 else _HEADER_V1
            if start + header <= size:
                length, message_id = _shape(data, start)
                layout = FORMATS.get(message_id)
                if length and layout is None:
                    if start >= claimed:
                        self.unknown += 1
                        claimed = start + length
                    position += 1
                    left -= 1
                    continue
                # Version 1 neither trims nor appends, so a longer payload is impossible.
                if layout is not None and header == _HEADER_V1 and length > layout.size + _HEADER_V1 + 2:
                    length = 0
            else:
                length, message_id, layout = header, -1, None
            if length and start + length > size and not final:
                self._needed = length
                break
            if length and layout is not None and start + length <= size:
                frame, good = self._check(data[start : start + length], message_id, layout.crc_extra)
                if good:
                    position = start + length
                    claimed = 0
                    if frame is not None:
                        frames.append(frame)
                    continue
            # A false start.
            if start >= claimed:
                self.malformed += 1
                self.garbage_bytes += 1
            position += 1
            left -= 1
        self._buffer = data[position:]
        self.pending = size - position
        self._unknown_left = max(0, claimed - position)
        return frames

    def _check(self, raw: bytes, message_id: int, crc_extra: bytes) -> tuple[Frame | None, bool]:
        """The frame in `raw`, unless its signature is not good, and whether its checksum is."""
        if raw[0] == MAGIC_V2:
            header, signed = _HEADER_V2, raw[2] == FLAG_SIGNED
            sequence, system_id, component_id = raw[4], raw[5], raw[6]
        else:
            header, signed = _HEADER_V1, False
            sequence, system_id, component_id = raw[2], raw[3], raw[4]
        end = header + raw[1]
        if crc16(raw[1:end] + crc_extra) != raw[end] | raw[end + 1] << 8:
            return None, False
        if self.check is not None and not self.check.passes(raw, message_id, signed=signed):
            return None, True
        self.frames += 1
        payload = raw[header:end]
        if not signed:
            mavlink = 2 if header == _HEADER_V2 else 1
            return Frame(message_id, sequence, system_id, component_id, payload, False, 0, 0, mavlink), True
        timestamp = int.from_bytes(raw[end + 3 : end + 9], "little")
        return Frame(message_id, sequence, system_id, component_id, payload, True, raw[end + 2], timestamp), True


def _shape(data: bytes, start: int) -> tuple[int, int]:
    """Length of the frame according to the header at `start` (0: it has unknown flags), and its message id."""
    if data[start] != MAGIC_V2:
        return data[start + 1] + _HEADER_V1 + 2, data[start + 5]
    flags = data[start + 2]
    if flags & ~FLAG_SIGNED:
        return 0, -1
    message_id = int.from_bytes(data[start + 7 : start + 10], "little")
    return data[start + 1] + _AROUND[flags], message_id
