"""MAVLink frames: how a component writes them, in version 2, and finds them in any bytes, in version 1 and 2.

Layout (https://mavlink.io/en/guide/serialization.html), little-endian: magic 0xFD, payload length, incompatibility
flags, compatibility flags, sequence, system id, component id (one byte each), message id (3 bytes), payload
(0..255 bytes, trailing zeros trimmed), checksum (2 bytes), signature (13 bytes, only with incompatibility flag 1).
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple, TypeAlias

from .crc import crc16
from .dialect import FORMATS, MavlinkMessage, common, payload_of
from .signing import SIGNATURE_SIZE, SignatureCheck, Signer

MAGIC_V2 = 0xFD
MAGIC_V1 = 0xFE
#: Incompatibility flag: the frame carries a signature.
FLAG_SIGNED = 0x01
#: The most bytes that a TUNNEL message carries.
TUNNEL_MAX = 128

TUNNEL_ID: int = common.MAVLINK_MSG_ID_TUNNEL
TUNNEL_EXTRA = FORMATS[TUNNEL_ID].crc_extra
_TUNNEL_ID_BYTES = TUNNEL_ID.to_bytes(3, "little")

_HEADER = struct.Struct("<BBBBBBBHB")
# The header, and TUNNEL's fields before its 128 bytes: payload_type, target_system, target_component, payload_length.
_TUNNEL_FIELDS = struct.Struct("<HBBB")
_TUNNEL_HEADER = struct.Struct("<BBBBBBBHBHBBB")

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

#: System id, component id and link id: timestamps of signatures rise in each stream (0..255 each).
Stream: TypeAlias = tuple[int, int, int]


class Frame(NamedTuple):
    """A received frame with a good checksum."""

    message_id: int
    """0..2^24 - 1."""
    sequence: int
    """The sender's frame counter, 0..255."""
    system_id: int
    """0..255."""
    component_id: int
    """0..255."""
    payload: bytes
    """As on the wire: MAVLink 2 trims trailing zeros."""
    signed: bool
    """The frame carried a signature. Whether it was checked depends on the reader's `SignatureCheck`."""
    link_id: int = 0
    """Of the signature, 0..255."""
    timestamp: int = 0
    """Of the signature, 48 bits."""
    mavlink: int = 2
    """Version of MAVLink, 1 or 2. Version 1 has no signatures, whether the sender has a key or not."""

    @property
    def stream(self) -> Stream:
        """Whose timestamps those of this frame are, if it is signed."""
        return self.system_id, self.component_id, self.link_id

    @property
    def size(self) -> int:
        """Bytes on the wire, if it is a frame of MAVLink 2."""
        return _HEADER.size + len(self.payload) + 2 + (SIGNATURE_SIZE if self.signed else 0)


def timestamp_of(frame: bytes) -> int | None:
    """The timestamp of a whole frame with a signed TUNNEL message; None: it is none."""
    if frame[0] != MAGIC_V2 or not frame[2] & FLAG_SIGNED or frame[7:10] != _TUNNEL_ID_BYTES:
        return None
    return int.from_bytes(frame[-12:-6], "little")


class FrameWriter:
    """Writes the frames of one component. All messages share one sequence.

    `system_id` and `component_id` (0..255) may be changed between frames.
    """

    __slots__ = ("component_id", "flags", "sequence", "signer", "system_id", "tunnel_flags")

    def __init__(self, system_id: int, component_id: int, signer: Signer | None = None) -> None:
        """:param signer: signs each frame; None: frames are unsigned."""
        self.system_id = system_id
        self.component_id = component_id
        self.signer = signer
        self.tunnel_flags = 0 if signer is None else FLAG_SIGNED
        """Incompatibility flags of TUNNEL messages. `FLAG_SIGNED` without a signer: somebody else appends the
        signature, when the frame leaves."""
        self.flags = 0
        """Those of all other messages, where there is no signer."""
        self.sequence = 0
        """Sequence number of the next frame, 0..255."""

    def tunnel(self, data: bytes, *, payload_type: int, target_system: int = 0, target_component: int = 0) -> bytes:
        """A whole frame with a TUNNEL message (385, https://mavlink.io/en/messages/common.html#TUNNEL).

        :param data: 0..128 bytes.
        :param payload_type: 0..65535; above 32767 for local use.
        :param target_system: 0: everybody.
        :param target_component: 0: every component.
        :returns: 13..145 bytes, signed 26..158.
        :raises ValueError: more than 128 bytes.
        :raises struct.error: a number out of range.
        """
        size = len(data)
        if size > TUNNEL_MAX:
            raise ValueError(f"a TUNNEL carries at most {TUNNEL_MAX} bytes, not {size}")
        content = data.rstrip(b"\0")
        if not content:
            # Trimming continues into the fields. This is too rare to need a fast path.
            return self.frame(TUNNEL_ID, _TUNNEL_FIELDS.pack(payload_type, target_system, target_component, size))
        signer = self.signer
        sequence = self.sequence
        frame = _TUNNEL_HEADER.pack(
            MAGIC_V2, len(content) + 5, self.tunnel_flags, 0, sequence, self.system_id, self.component_id, TUNNEL_ID, 0,
            payload_type, target_system, target_component, size,
        ) + content  # fmt: skip
        frame += crc16(frame[1:] + TUNNEL_EXTRA).to_bytes(2, "little")
        self.sequence = (sequence + 1) & 0xFF
        return frame if signer is None else signer.sign(frame)

    def message(self, message: MavlinkMessage) -> bytes:
        """A whole frame with a pymavlink message object, whose fields pymavlink packs.

        :raises struct.error: a field is out of range.
        """
        return self.frame(message.get_msgId(), payload_of(message))

    def frame(self, message_id: int, payload: bytes) -> bytes:
        """A whole frame with a packed payload, which may still have trailing zeros.

        :param message_id: of the common dialect (others raise KeyError: their CRC_EXTRA is unknown).
        :param payload: 0..255 bytes.
        :raises struct.error: a longer payload.
        """
        # At least one byte stays, even if it is zero.
        payload = payload.rstrip(b"\0") or payload[:1]
        signer = self.signer
        sequence = self.sequence
        flags = self.tunnel_flags if message_id == TUNNEL_ID else self.flags if signer is None else FLAG_SIGNED
        frame = _HEADER.pack(
            MAGIC_V2, len(payload), flags, 0, sequence, self.system_id, self.component_id,
            message_id & 0xFFFF, message_id >> 16,
        ) + payload  # fmt: skip
        frame += crc16(frame[1:] + FORMATS[message_id].crc_extra).to_bytes(2, "little")
        self.sequence = (sequence + 1) & 0xFF
        return frame if signer is None else signer.sign(frame)


class FrameReader:
    """Reads the frames of one stream, or of the datagrams of one link. Never raises, whatever the bytes.

    Nothing is trusted before its checksum is verified. If a magic byte turns out not to start a frame (a false start),
    the search continues one byte after it, so garbage never hides a genuine frame.

    A frame whose message id is not in the dialect cannot be checked, because its CRC_EXTRA is unknown. It is counted
    once and not returned. Its length is not trusted either: the search continues one byte after its start, but false
    starts within the length it claims are not counted again. The price is small: if the bytes inside it are a whole
    frame with a good checksum, they are returned as a frame.

    Work is linear in the number of bytes: each byte starts at most one candidate, and a candidate is checked at most
    once, over at most 280 bytes. Between two feeds at most 279 bytes are kept: a frame whose end has not arrived.

    In a stream no genuine frame is lost, whatever comes before it; the caller limits the bytes per call. A datagram
    starts with a frame. So a datagram with too many false starts is noise or an attack, and its rest is not searched.
    """

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
